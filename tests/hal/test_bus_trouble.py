"""Master, core and the simulated robot through an outage: stop, hold on the other buses, recovery."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from hal.bus.errors import BusDownError
from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile import objects
from hal.profile.cia402 import OperationMode
from hal.profile.frames import can_ids, pack, unpack
from hal.profile.identifiers import HEARTBEAT, SDO_RX, SYNC
from plant_service.plant import Plant, SyncOrderError
from schemas.base import ControlMode
from schemas.load import load_run
from schemas.messages import DriveState, Event, HalStatus, JointCommand, RobotState
from tests.hal.robots import report

BUS_OFF = pack(0x20000040, bytes(8))
RESTARTED = pack(0x20000100, bytes(8))
PASSIVE = pack(0x20000004, bytes.fromhex("0020000000008000"))
ACTIVE = pack(0x20000004, bytes.fromhex("0040000000000000"))
LEFT_OUT = 1
"""Index of the bus in trouble."""


class Interface(DirectPort):
    """A bus of the plant behind an interface that can be taken down."""

    def __init__(self, name: str, deliver: Callable[[bytes], bytes]) -> None:
        super().__init__(name, deliver)
        self.is_down = False

    @property
    def down(self) -> str | None:  # type: ignore[override]  # a state here
        return f"bus {self.name}: interface can7 is down" if self.is_down else None

    def send(self, frames: bytes) -> None:
        if self.is_down:
            raise BusDownError(f"bus {self.name}: interface can7 is down")
        super().send(frames)

    def receive(self, timeout_s: float) -> bytes:
        return b"" if self.is_down else super().receive(timeout_s)

    def inject(self, frames: bytes) -> None:
        """Let the controller say something."""
        self._waiting += frames


class Robot:
    """arm9 with its master, in position mode unless told otherwise."""

    def __init__(self) -> None:
        self.run = load_run("arm9-transition", {"duration_s": 60.0})
        description = self.run.robot.description
        self.plant = Plant(self.run)
        self.ports = [Interface(bus.name, partial(self._deliver, index)) for index, bus in enumerate(description.buses)]
        self.master = Master(description, self.ports, "me")
        self.core = self.master.core
        self.joints = [
            index for index, joint in enumerate(description.joints) if joint.drive.bus == self.ports[LEFT_OUT].name
        ]
        self.sequence = 0
        self.events: list[Event] = []
        self.master.boot(5.0)
        self.sent = [b"", b"", b""]

    def _deliver(self, index: int, packet: bytes) -> bytes:
        try:
            return self.plant.deliver(index, packet)
        except SyncOrderError:
            self.plant.advance()
            return self.plant.deliver(index, packet)

    def cycle(self, torque: tuple[float, ...] | None = None) -> RobotState:
        """One period, commanded to stay, or in torque mode to give a torque [N·m]."""
        self.master.sync(self.sequence)
        state = self.master.gather(self.sequence, 0.0)
        self.truth = self.plant.truth()
        if self.plant.sync_complete:
            self.plant.advance()
        command = JointCommand(
            session="me",
            sequence=self.sequence,
            time_ns=0,
            mode=ControlMode.POSITION if torque is None else ControlMode.TORQUE,
            position=state.applied.position or state.position_measured,
            torque=torque,
        )
        self.master.apply(command)
        self.sequence += 1
        self.events += self.core.drain_events()
        self.sent = [frames.sent for frames in self.master.frames(self.sequence - 1)]
        return state

    def cycles(self, count: int) -> RobotState:
        for _ in range(count):
            state = self.cycle()
        return state

    @property
    def nodes(self) -> list[int]:
        """Node ids on the bus in trouble."""
        return [self.run.robot.description.joints[joint].drive.node_id for joint in self.joints]

    def commanded(self) -> list[int]:
        """Nodes that the last cycle's RPDOs on the bus in trouble were for."""
        return [can_id & 0x7F for can_id, _ in unpack(self.sent[LEFT_OUT]) if can_id & ~0x7F in (0x200, 0x300)]

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@pytest.fixture
def robot() -> Robot:
    robot = Robot()
    robot.cycles(20)
    assert robot.kinds() == []
    return robot


def test_a_bus_that_goes_down_stops_the_robot_and_comes_back(robot: Robot) -> None:
    before = np.array(robot.cycle().position_measured)
    robot.ports[LEFT_OUT].is_down = True
    robot.cycle()
    assert robot.core.status is HalStatus.SAFE_STOP
    assert robot.kinds() == ["bus_down", "safe_stop"]
    assert robot.events[0].text == "bus arm9-1: interface can7 is down"
    assert robot.core.cause is not None
    assert robot.core.troubled_buses == ("arm9-1",)
    # The others go on and hold; nothing is awaited of the one that is down, and nothing more told of its drives.
    for _ in range(40):
        assert robot.core.expected_reports[LEFT_OUT] == frozenset()
        assert robot.core.expected_reports[0]
        robot.cycle()
        assert SYNC in can_ids(robot.sent[0])
        assert robot.sent[LEFT_OUT] == b""
    assert robot.kinds() == ["bus_down", "safe_stop"]
    robot.ports[LEFT_OUT].is_down = False
    for _ in range(60):
        state = robot.cycle()
    assert robot.core.troubled_buses == ()
    recovered = [event for event in robot.events if event.kind == "bus_recovered"]
    assert [event.text for event in recovered] == ["bus arm9-1: works again, and its drives report and hold"]
    assert set(state.drive_state) == {DriveState.OPERATION_ENABLED}
    assert np.abs(np.array(state.position_measured) - before).max() < np.radians(1.0)
    # Its drives had been left alone: they say so, and that is not laid to the other buses.
    told = {event.joint for event in robot.events if event.kind == "drive_emergency"}
    assert told == {robot.run.robot.description.joint_names[joint] for joint in robot.joints}
    assert "mode_refused" not in robot.kinds()
    assert "node_lost" not in robot.kinds()


@pytest.mark.parametrize(
    ("trouble", "end", "kind"),
    [(BUS_OFF, RESTARTED, "bus_off"), (PASSIVE, ACTIVE, "bus_error_passive"), (BUS_OFF, b"", "bus_off")],
)
def test_error_frames_stop_the_robot(robot: Robot, trouble: bytes, end: bytes, kind: str) -> None:
    robot.ports[LEFT_OUT].inject(trouble)
    state = robot.cycle()
    assert robot.kinds() == [kind, "safe_stop"]
    assert robot.core.troubled_buses == ("arm9-1",)
    assert state.status is HalStatus.ACTIVE, "the stop acts from the answer on, as an operator's"
    robot.ports[LEFT_OUT].inject(end)
    for _ in range(20):
        robot.cycle()
    assert robot.kinds() == [kind, "safe_stop", "bus_recovered"]
    assert robot.core.status is HalStatus.SAFE_STOP


def test_modes_are_asked_for_when_a_bus_works_again(robot: Robot) -> None:
    robot.ports[LEFT_OUT].is_down = True
    robot.cycles(3)
    robot.ports[LEFT_OUT].is_down = False
    asked: list[int] = []
    for _ in range(40):
        robot.cycle()
        now = [can_id for can_id, _ in unpack(robot.sent[LEFT_OUT]) if can_id & 0x780 == SDO_RX]
        assert len(now) == len(set(now)), "an SDO server takes one request at a time"
        asked += now
        assert not any(can_id & 0x780 == SDO_RX for can_id, _ in unpack(robot.sent[0]))
    assert sorted(asked) == sorted(2 * [SDO_RX + node for node in robot.nodes])


def test_a_drive_that_was_reset_is_not_enabled_again(robot: Robot) -> None:
    joint = robot.joints[0]
    node = robot.run.robot.description.joints[joint].drive.node_id
    robot.ports[LEFT_OUT].is_down = True
    robot.cycles(3)
    robot.plant.deliver(LEFT_OUT, pack(0x000, bytes((0x81, node))))
    robot.ports[LEFT_OUT].is_down = False
    robot.ports[LEFT_OUT].inject(pack(HEARTBEAT + node, b"\0"))
    robot.cycles(100)
    assert "node_lost" in robot.kinds()
    assert "bus_recovered" not in robot.kinds()
    assert robot.core.troubled_buses == ("arm9-1",)
    assert robot.commanded() == [each for each in robot.nodes if each != node], "it does not report"
    # Somebody starts it: it reports, and is told to stay off.
    robot.ports[LEFT_OUT].inject(report(node, statusword=0x0250))
    robot.cycle()
    words = {
        int.from_bytes(data[:2], "little")
        for can_id, data in unpack(robot.sent[LEFT_OUT])
        if can_id in (0x200 + node, 0x300 + node)
    }
    assert words == {0x00}


def test_a_bus_that_comes_back_gets_no_command_before_its_drives_have_reported(robot: Robot) -> None:
    robot.ports[LEFT_OUT].is_down = True
    robot.cycles(3)
    robot.master.sync(robot.sequence)
    robot.master.gather(robot.sequence, 0.0)
    robot.ports[LEFT_OUT].is_down = False
    robot.master.apply(None)
    sent = robot.master.frames(robot.sequence)[LEFT_OUT].sent
    assert [can_id for can_id, _ in unpack(sent)] == []
    robot.plant.advance()
    robot.sequence += 1
    robot.cycle()
    assert robot.commanded() == robot.nodes


def test_a_joint_that_moved_unheard_is_held_where_it_is_found(robot: Robot) -> None:
    """Drives without a watchdog of their own go on with the last torque while nobody hears them."""
    joint = robot.joints[-1]
    for each in robot.joints:
        robot.plant.drives[each].dictionary.write(objects.WATCHDOG_CYCLES, 0, bytes(2))
    steady = np.array(robot.cycle().motor_torque_measured)
    steady[joint] += 5.0
    for _ in range(30):
        robot.cycle(tuple(steady.tolist()))
    lost_at = robot.truth.position[joint]
    robot.ports[LEFT_OUT].is_down = True
    robot.cycles(60)
    robot.ports[LEFT_OUT].is_down = False
    robot.cycle()
    found_at = robot.truth.position[joint]
    assert abs(found_at - lost_at) > np.radians(0.5)
    torques = []
    for _ in range(100):
        robot.cycle()
        torques.append(robot.truth.motor_torque[joint])
    assert robot.truth.mode[joint] == OperationMode.CSP
    assert max(np.abs(torques)) < 40.0, "no more than what stops it; the target from before asks for 160 N·m"
    assert abs(robot.truth.position[joint] - found_at) < np.radians(0.1)


def test_all_buses_down_and_up_again(robot: Robot) -> None:
    for port in robot.ports:
        port.is_down = True
    robot.cycles(5)
    assert robot.core.expected_reports == (frozenset(),) * 3
    assert robot.core.troubled_buses == ("arm9-0", "arm9-1", "arm9-2")
    for port in robot.ports:
        port.is_down = False
    robot.cycles(60)
    assert robot.core.troubled_buses == ()
    assert robot.kinds().count("bus_recovered") == 3
    assert robot.kinds().count("safe_stop") == 1
