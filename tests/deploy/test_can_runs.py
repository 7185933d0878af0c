"""Whole runs on kernel CAN, in the CAN machine: the same states, commands and frames as without it.

One boot serves all: `tests.deploy.can_runs` runs inside, what it left is judged here.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from schemas.messages import BusFrames, JointCommand, RobotState
from tests.deploy.can_logs import frames_of, log, messages, names, run_inside, said
from tests.deploy.can_runs import BUSES

pytestmark = [pytest.mark.can_machine, pytest.mark.timeout(2400)]
STATES = 250


@pytest.fixture(scope="module")
def folder(can_machine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_inside(tmp_path_factory.mktemp("can"), "direct", "vcan", "kvaser", "alone")


def is_heartbeat(frame: str) -> bool:
    return frame.startswith("7")


def dumped(path: Path) -> dict[str, list[str]]:
    """Frames of each bus in a file of `candump -L`."""
    frames: dict[str, list[str]] = {bus: [] for bus in BUSES}
    bus_of = {interface: bus for bus, interface in BUSES.items()}
    for line in path.read_text().splitlines():
        _, interface, frame = line.split()[:3]
        frames[bus_of[interface]].append(frame)
    return frames


@pytest.mark.parametrize("name", ["direct", "vcan", "kvaser"])
def test_a_run_ends_well(folder: Path, name: str) -> None:
    (result,) = said(folder, name)
    assert result["code"] == 0, result["out"]
    assert len(messages(folder, name, RobotState)) == STATES


@pytest.mark.parametrize("name", ["vcan", "kvaser"])
@pytest.mark.parametrize("kind", [RobotState, JointCommand])
def test_states_and_commands_are_those_of_one_process(folder: Path, name: str, kind: Any) -> None:
    assert messages(folder, name, kind) == messages(folder, "direct", kind)


@pytest.mark.parametrize("name", ["vcan", "kvaser"])
@pytest.mark.parametrize("direction", ["sent", "received"])
def test_frames_are_those_of_one_process(folder: Path, name: str, direction: str) -> None:
    kernel, reference = (frames_of(log(folder, each), direction) for each in (name, "direct"))
    for bus in BUSES:
        shorter, longer = sorted((kernel[bus], reference[bus]), key=len)
        assert longer[: len(shorter)] == shorter
        # What the drives said after the HAL had left, it has not read.
        assert all(map(is_heartbeat, longer[len(shorter) :]))


def test_only_the_bus_lines_differ(folder: Path) -> None:
    runs = [log(folder, name).run for name in ("direct", "vcan", "kvaser")]
    without = [run.robot.description.model_copy(update={"buses": ()}) for run in runs]
    assert without[0] == without[1] == without[2]
    assert runs[0].scenario == runs[1].scenario == runs[2].scenario


def test_candump_shows_the_frames_of_the_log(folder: Path) -> None:
    # The log tells sent and received apart, the wire has them in one order.
    on_wire = dumped(folder / "candump.log")
    for bus in BUSES:
        logged: Counter[str] = Counter()
        for message in log(folder, "vcan").messages(BusFrames, bus=bus):
            logged.update(names(message.sent) + names(message.received))
        assert not logged - Counter(on_wire[bus])
        assert all(map(is_heartbeat, Counter(on_wire[bus]) - logged))
    for direction, prefix in (("sent", "20"), ("received", "18")):
        after_boot = frames_of(log(folder, "vcan"), direction)
        for bus in BUSES:
            wanted = [frame for frame in after_boot[bus] if frame.startswith(prefix)]
            assert [frame for frame in on_wire[bus] if frame.startswith(prefix)] == wanted


def test_a_hal_without_drives_lists_what_is_missing(folder: Path) -> None:
    (result,) = said(folder, "alone")
    assert result["code"] == 1
    last = result["out"].strip().splitlines()[-1]
    assert "9 of 9 drives" in last
    for joint in log(folder, "direct").run.robot.description.joint_names:
        assert joint in last
