"""Drives of another maker in a process of their own, on a virtual bus, from the robot's file alone."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.bus.hub import serve_in_thread
from hal.bus.ports import open_port
from hal.errors import BootError
from hal.master import Master
from schemas.load import load_robot
from schemas.messages import HalStatus
from schemas.robot import RobotDescription
from tests.hal.foreign_objects import Habits
from tests.hal.foreign_robot import Cycle
from tests.hal.foreign_slave import slaves_of_robot

ROBOT = Path("tests/data/robots/visitor.yaml")


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[RobotDescription]:
    channel = str(tmp_path / "bus")
    description = load_robot(str(ROBOT)).description
    line = description.buses[0].model_copy(update={"interface": "cosim", "channel": channel})
    # The cycles here wait for slaves that a busy machine may have put aside: they must not miss the HAL meanwhile.
    safety = description.safety.model_copy(update={"heartbeat_s": 1.5})
    with serve_in_thread(channel):
        yield description.model_copy(update={"buses": (line,), "safety": safety})


def slave_process(robot: RobotDescription, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.hal.foreign_slave", "--interface", "cosim"]
    process = subprocess.Popen(
        [*command, "--channel", robot.buses[0].channel, *options], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("nodes 1, 2, 3 on ")
    return process


def test_a_process_of_slaves_is_booted_moved_and_lost(robot: RobotDescription) -> None:
    with slave_process(robot, "--robot", str(ROBOT), "--bus", "guests", "--lely") as process:
        master = Master(robot, [open_port(robot.buses[0])], "test")
        try:
            master.find(10.0)
            notes = master.boot(10.0)
            assert [note.split(":")[0] for note in notes] == [
                f"joint {joint.name} (node {joint.drive.node_id} on bus guests)" for joint in robot.joints
            ]
            cycle = Cycle(master, robot, timeout_s=5.0)
            targets = (0.3, -0.4, 0.5)
            state = cycle.run(
                100, position=targets, until=lambda state: np.allclose(state.position_measured, targets, atol=1e-4)
            )
            np.testing.assert_allclose(state.position_measured, targets, atol=1e-4)
            assert cycle.kinds() == [], cycle.text()

            process.kill()
            process.wait()
            cycle.timeout_s = 0.01
            cycle.run(10, position=targets)
            assert master.core.status is HalStatus.SAFE_STOP
            assert "node_lost" in cycle.kinds()
        finally:
            process.kill()
            master.close()


def test_slaves_of_another_maker_are_refused(robot: RobotDescription) -> None:
    with slave_process(robot, "--nodes", "1,2,3") as process:
        master = Master(robot, [open_port(robot.buses[0])], "test")
        try:
            with pytest.raises(
                BootError, match=r"^3 of 3 drives cannot be used: .*vendor_id is 0x00001234, .*0x00000360"
            ):
                master.find(10.0)
        finally:
            process.kill()
            master.close()


def test_the_drives_of_one_bus_are_taken_from_the_robots_file() -> None:
    by_name, by_channel = (slaves_of_robot(ROBOT, bus, Habits()) for bus in ("guests", "vcan0"))
    assert [slave.node for slave in by_name] == [slave.node for slave in by_channel] == [1, 2, 3]
    assert {(slave.habits.vendor_id, slave.habits.product_code) for slave in by_name} == {(0x360, 1)}
    assert slaves_of_robot(ROBOT, "can7", Habits()) == []
