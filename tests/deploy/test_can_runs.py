"""Whole runs on kernel CAN, in the CAN machine: the same states and commands as on the virtual bus, and bus trouble.

One boot serves all: `tests.deploy.can_runs` runs inside, what it left is judged here.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from deploy.can_vm import run_in_machine
from hal.profile.frames import unpack
from schemas.log import LogReader
from schemas.messages import BusFrames, JointCommand, RobotState
from schemas.topics import encode
from tests.deploy.can_runs import BUSES, RUNS

pytestmark = [pytest.mark.can_machine, pytest.mark.timeout(2400)]
REPOSITORY = Path(__file__).parents[2]
STATES = 250


@pytest.fixture(scope="module")
def folder(can_machine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("can")
    command = ["python", "-m", "tests.deploy.can_runs", str(folder), *RUNS]
    completed = run_in_machine(command, timeout_s=2300, directory=REPOSITORY)
    assert completed.code == 0, completed.stdout + completed.stderr
    return folder


def said(folder: Path, name: str) -> list[dict[str, Any]]:
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def log(folder: Path, name: str) -> LogReader:
    return LogReader(folder / name / "run.mcap")


def messages(folder: Path, name: str, kind: Any) -> list[bytes]:
    return [encode(message) for message in log(folder, name).messages(kind)]


def frames_of(reader: LogReader) -> dict[str, list[str]]:
    """Every frame of each bus, as candump writes it, cycle by cycle."""
    frames: dict[str, list[str]] = {bus: [] for bus in BUSES}
    for message in reader.messages(BusFrames):
        frames[message.bus] += names(message.sent) + names(message.received)
    return frames


def names(packet: bytes) -> list[str]:
    return [f"{can_id:03X}#{data.hex().upper()}" for can_id, data in unpack(packet)]


def dumped(path: Path) -> dict[str, list[str]]:
    """Frames of each bus in a file of `candump -L`."""
    frames: dict[str, list[str]] = {bus: [] for bus in BUSES}
    bus_of = {interface: bus for bus, interface in BUSES.items()}
    for line in path.read_text().splitlines():
        _, interface, frame = line.split()[:3]
        frames[bus_of[interface]].append(frame)
    return frames


@pytest.mark.parametrize("name", ["virtual", "vcan", "kvaser"])
def test_a_run_ends_well(folder: Path, name: str) -> None:
    (result,) = said(folder, name)
    assert result["code"] == 0, result["out"]
    assert len(messages(folder, name, RobotState)) == STATES


@pytest.mark.parametrize("name", ["vcan", "kvaser"])
@pytest.mark.parametrize("kind", [RobotState, JointCommand])
def test_states_and_commands_are_those_of_the_virtual_bus(folder: Path, name: str, kind: Any) -> None:
    assert messages(folder, name, kind) == messages(folder, "virtual", kind)


@pytest.mark.parametrize("name", ["vcan", "kvaser"])
def test_frames_are_those_of_the_virtual_bus(folder: Path, name: str) -> None:
    assert frames_of(log(folder, name)) == frames_of(log(folder, "virtual"))


def test_only_the_bus_lines_differ(folder: Path) -> None:
    runs = [log(folder, name).run for name in ("virtual", "vcan", "kvaser")]
    without = [run.robot.description.model_copy(update={"buses": ()}) for run in runs]
    assert without[0] == without[1] == without[2]
    assert runs[0].scenario == runs[1].scenario == runs[2].scenario


def test_candump_shows_the_frames_of_the_log(folder: Path) -> None:
    # The log tells sent and received apart, the wire has them in one order: what was on it is the same.
    on_wire, logged = dumped(folder / "candump.log"), frames_of(log(folder, "vcan"))
    for bus in BUSES:
        assert Counter(on_wire[bus]) == Counter(logged[bus])
        answers = [frame for frame in on_wire[bus] if frame.startswith("18")]
        assert answers == [frame for frame in logged[bus] if frame.startswith("18")]


def test_a_hal_without_drives_lists_what_is_missing(folder: Path) -> None:
    (result,) = said(folder, "alone")
    assert result["code"] == 1
    last = result["out"].strip().splitlines()[-1]
    assert "9 of 9 drives" in last
    for joint in log(folder, "virtual").run.robot.description.joint_names:
        assert joint in last


def test_the_kernels_can_is_told_of_recovered_from_and_serves_all_ports(folder: Path) -> None:
    (result,) = said(folder, "kernel_tests")
    assert result["code"] == 0, result["out"]
    assert "passed" in result["out"]
    assert "skipped" not in result["out"]
