"""Master, core and the simulated robot through an outage: stop, hold on the other buses, recovery."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from hal.bus.errors import BusDownError
from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile.frames import can_ids, pack, unpack
from hal.profile.identifiers import HEARTBEAT, SDO_RX, SYNC
from plant_service.plant import Plant, SyncOrderError
from schemas.base import ControlMode
from schemas.load import load_run
from schemas.messages import DriveState, Event, HalStatus, JointCommand, RobotState

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
    """arm9 with its master, in torque mode at the torques that hold it."""

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

    def cycle(self) -> RobotState:
        self.master.sync(self.sequence)
        state = self.master.gather(self.sequence, 0.0)
        if self.plant.sync_complete:
            self.plant.advance()
        command = JointCommand(
            session="me",
            sequence=self.sequence,
            time_ns=0,
            mode=ControlMode.POSITION,
            position=state.applied.position or state.position_measured,
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
    for _ in range(10):
        robot.cycle()
        asked += [can_id for can_id, _ in unpack(robot.sent[LEFT_OUT]) if can_id & 0x780 == SDO_RX]
        assert not any(can_id & 0x780 == SDO_RX for can_id, _ in unpack(robot.sent[0]))
    nodes = [robot.run.robot.description.joints[joint].drive.node_id for joint in robot.joints]
    assert sorted(asked) == sorted(2 * [SDO_RX + node for node in nodes])


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
    words = {
        int.from_bytes(data[:2], "little")
        for can_id, data in unpack(robot.sent[LEFT_OUT])
        if can_id in (0x200 + node, 0x300 + node)
    }
    assert words == {0x00}


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
