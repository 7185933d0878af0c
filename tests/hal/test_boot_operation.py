"""Drives in operation after the boot: simulated ones, `durand` devices and a slave by hand, moved and restarted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import can
import numpy as np
import pytest

from hal.bus.hub import serve_in_thread
from hal.bus.ports import DirectPort, open_port
from hal.master import Master
from hal.profile import objects
from hal.profile.cia402 import OperationMode
from hal.profile.frames import pack
from plant_service.plant import Plant
from schemas.load import load_run
from schemas.messages import DriveState, HalStatus
from schemas.robot import Bus, Safety
from tests.hal.durand_drive import DurandDrive
from tests.hal.foreign_device import ENABLED, FAULT, OPERATIONAL
from tests.hal.foreign_objects import Habits, Item, lely_like
from tests.hal.foreign_robot import NODES, Cycle, foreign_robot, wire

LELY = {"vendor_id": 0x360, "product_code": 1}
OUR_IDS = {"vendor_id": 0x402, "product_code": 1}
"""Those of the simulated drives, and the robot description's defaults."""
OUR_MAKERS_OBJECTS = {
    **{(index, 0): Item(4) for index in (0x2001, 0x2002, 0x2003)},
    **{(index, 0): Item(2) for index in (0x2004, 0x2005)},
    (0x2006, 0): Item(1, 0, "ro"),
}
"""As in our EDS."""
MAKERS = pytest.mark.parametrize(
    ("habits", "identity"),
    [
        (Habits(), {}),
        (lely_like(), LELY),
        (Habits(lacks=frozenset({0x603F, 0x1016, 0x6076}), samples_first=True), {}),
        (lely_like(**OUR_IDS), OUR_IDS),
        (lely_like(lacks=frozenset(), objects=OUR_MAKERS_OBJECTS, pdo_records=2, **OUR_IDS), OUR_IDS),
        (lely_like(objects={(0x2006, 0): Item(4, 1)}, **OUR_IDS), OUR_IDS),
        (lely_like(types=frozenset({0, 1, 255}), objects={(0x1801, 2): Item(1, 0, "ro")}), LELY),
    ],
    ids=["usual", "lely-like", "meagre", "our ids", "our EDS", "our ids, its own 0x2006", "never tells a change"],
)


@MAKERS
def test_is_booted_enabled_and_moved(habits: Habits, identity: dict[str, int]) -> None:
    bus = wire(habits, habits, habits)
    robot = foreign_robot(NODES, **identity)
    master = Master(robot, [bus], "test")
    master.boot(2.0)
    assert all(slave.power == ENABLED and slave.nmt == OPERATIONAL for slave in bus.slaves)
    assert [slave.commands for slave in bus.slaves] == [[0x06, 0x07, 0x0F]] * 3

    cycle = Cycle(master, robot)
    targets = (0.4, -0.3, 1.1)
    state = cycle.run(
        150, position=targets, until=lambda state: np.allclose(state.position_measured, targets, atol=1e-4)
    )
    np.testing.assert_allclose(state.position_measured, targets, atol=1e-4, err_msg=cycle.text())

    start = np.array(state.position_measured)
    state = cycle.run(20, torque=(10.0, 0.0, -10.0))
    assert [int(mode) for mode in (slave.objects[0x6061, 0] for slave in bus.slaves)] == [10, 10, 10]
    moved = np.array(state.position_measured) - start
    assert moved[0] > 0.02 > abs(moved[1])
    assert moved[2] < -0.02
    np.testing.assert_allclose(state.motor_torque_measured, (10.0, 0.0, -10.0), atol=0.05)

    cycle.run(30, position=tuple(state.position_measured))
    assert cycle.kinds() == [], cycle.text()
    assert master.core.status is HalStatus.ACTIVE


@MAKERS
def test_a_drive_that_restarts_in_operation_stops_the_robot(habits: Habits, identity: dict[str, int]) -> None:
    bus = wire(habits, habits, habits)
    robot = foreign_robot(NODES, **identity)
    master = Master(robot, [bus], "test")
    master.boot(2.0)
    cycle = Cycle(master, robot, timeout_s=0.005)
    cycle.run(20, position=(0.2, 0.2, 0.2))
    bus.slaves[1].reset()
    state = cycle.run(40, position=(0.2, 0.2, 0.2))
    assert state.status is HalStatus.SAFE_STOP
    lost = [event for event in cycle.events if event.kind == "node_lost"]
    assert (lost[0].joint, lost[0].severity) == ("joint2", "error")
    assert "the drive was reset during operation" in lost[0].text
    assert [slave.power == ENABLED for slave in bus.slaves] == [True, False, True]


def test_a_silent_drive_does_not_keep_the_heartbeat_from_the_others() -> None:
    bus = wire(Habits(), Habits())
    robot = foreign_robot(NODES[:2], safety=Safety(heartbeat_s=0.02))
    master = Master(robot, [bus], "test")
    master.boot(2.0)
    bus.STEP_S = 0.0002  # no faster than the wall clock, by which the HAL sends its heartbeats
    cycle = Cycle(master, robot, timeout_s=0.3)
    cycle.run(3, position=(0.0, 0.0))
    bus.unplugged.add(2)
    cycle.run(2, position=(0.0, 0.0))
    assert bus.slaves[0].power == ENABLED, "it misses the HAL after 60 ms"


def test_a_fault_in_operation_is_not_reset_by_the_cycle() -> None:
    bus = wire(Habits(), Habits())
    robot = foreign_robot(NODES[:2])
    master = Master(robot, [bus], "test")
    master.boot(2.0)
    cycle = Cycle(master, robot, timeout_s=0.005)
    cycle.run(5, position=(0.0, 0.0))
    bus.slaves[0].power = FAULT
    state = cycle.run(30, position=(0.0, 0.0))
    assert (state.status, state.drive_state[0]) == (HalStatus.SAFE_STOP, DriveState.FAULT)
    assert "drive_fault" in cycle.kinds()
    master.boot(2.0)
    assert [slave.power for slave in bus.slaves] == [ENABLED, ENABLED]


@pytest.fixture(params=["cosim", "virtual"])
def bus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bus]:
    path = str(tmp_path / "bus")
    with serve_in_thread(path) if request.param == "cosim" else nullcontext():
        yield Bus(name="right", interface=request.param, channel=path)


@pytest.fixture
def operated(bus: Bus) -> Iterator[tuple[list[DurandDrive], Cycle, can.BusABC]]:
    """Three devices, the cycle that the HAL runs with them, and a bus for somebody else."""
    description = foreign_robot((1, 2, 3), buses=(bus,))
    buses = [can.Bus(interface=bus.interface, channel=bus.channel) for _ in range(4)]
    drives = [DurandDrive(each, node) for node, each in zip((1, 2, 3), buses, strict=False)]
    master = Master(description, [open_port(bus)], "test")
    try:
        master.boot(5.0)
        yield drives, Cycle(master, description), buses[-1]
    finally:
        master.close()
        for drive in drives:
            drive.stop()
        for each in buses:
            each.shutdown()


Operated = tuple[list[DurandDrive], Cycle, can.BusABC]


def test_the_cycle_moves_devices_in_both_modes(operated: Operated) -> None:
    drives, cycle, _ = operated
    targets = (0.3, -0.2, 0.1)
    state = cycle.run(
        120, position=targets, until=lambda state: np.allclose(state.position_measured, targets, atol=1e-4)
    )
    np.testing.assert_allclose(state.position_measured, targets, atol=1e-4, err_msg=cycle.text())

    state = cycle.run(5, torque=(5.0, 0.0, -5.0))
    assert [drive.read(objects.MODE_DISPLAY) for drive in drives] == [OperationMode.CST] * 3
    np.testing.assert_allclose(state.motor_torque_measured, (5.0, 0.0, -5.0), atol=0.05)

    cycle.run(5, position=targets)
    assert [drive.read(objects.MODE_DISPLAY) for drive in drives] == [OperationMode.CSP] * 3
    assert [drive.state for drive in drives] == [DriveState.OPERATION_ENABLED] * 3
    assert cycle.kinds() == [], cycle.text()


def test_a_device_that_is_reset_in_operation_stops_the_robot(operated: Operated) -> None:
    drives, cycle, somebody = operated
    cycle.timeout_s = 0.2
    cycle.run(10, position=(0.1, 0.1, 0.1))
    somebody.send(can.Message(arbitration_id=0x000, data=b"\x81\x02", is_extended_id=False))
    state = cycle.run(20, position=(0.1, 0.1, 0.1))
    assert state.status is HalStatus.SAFE_STOP
    reset = [event for event in cycle.events if "was reset during operation" in event.text]
    assert (reset[0].kind, reset[0].joint) == ("node_lost", "joint2")
    assert [drive.state for drive in (drives[0], drives[2])] == [DriveState.OPERATION_ENABLED] * 2
    assert drives[1].node.nmt.state != 5, "nobody starts it again"


@pytest.mark.parametrize("reset", [0x81, 0x82], ids=["node", "communication"])
def test_a_drive_that_is_reset_in_operation_stops_the_robot(reset: int) -> None:
    run = load_run("arm9-transition")
    robot, simulated = run.robot.description, Plant(run)
    ports = [
        DirectPort(bus.name, lambda frames, bus=index: simulated.deliver(bus, frames))
        for index, bus in enumerate(robot.buses)
    ]
    master = Master(robot, ports, "test")
    master.boot(1.0)
    cycle = Cycle(master, robot, timeout_s=0.0)
    target = cycle.run(1).position_measured
    simulated.advance()

    def pass_cycles(count: int) -> None:
        for _ in range(count):
            cycle.run(1, position=target)
            simulated.advance()

    pass_cycles(10)
    victim = robot.joints[4]
    bus = robot.bus_index(victim.drive.bus)
    ports[bus].send(pack(0x000, bytes([reset, victim.drive.node_id])))
    pass_cycles(40)
    assert master.core.status is HalStatus.SAFE_STOP
    lost = next(event for event in cycle.events if event.kind == "node_lost")
    assert lost.joint == victim.name
    assert "was reset during operation" in lost.text
    enabled = [drive.state is DriveState.OPERATION_ENABLED for drive in simulated.drives]
    # A drive that only forgot its communication goes on holding by its own means.
    assert enabled == [index != 4 or reset == 0x82 for index in range(9)]
    assert [drive.nmt.state == 5 for drive in simulated.drives] == [index != 4 for index in range(9)]
