"""`cosim bus` from the outside."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.report import write_report
from schemas.log import LogReader
from schemas.messages import BusFrames, RobotState
from tests.deploy.conftest import GOLDEN
from tests.deploy.running import cosim_up

LOG = str(GOLDEN)
NAMES = ("x.log", "x.blf")


def run(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    """Run `cosim bus`; what it printed, on standard error where it failed."""
    found = main(["bus", *arguments])
    captured = capsys.readouterr()
    assert found == code, captured
    return captured.err if code else captured.out


def test_a_log_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(capsys, LOG, "--only", "wrist_roll", "--only", "F/T", "--bus", "arm9-2").splitlines()
    assert any("TPDO1" in line and "wrist_roll" in line and " rad, " in line for line in lines)
    assert any("torque (" in line for line in lines)
    assert not any(" wrist_yaw " in line for line in lines)


def test_json_is_one_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(capsys, LOG, "--only", "RPDO2", "--count", "3", "--json").splitlines()
    assert [json.loads(line)["what"] for line in lines] == ["RPDO2"] * 3
    assert "target_torque_nm" in json.loads(lines[0])["values"]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc"])
def test_to_another_tools_file_and_back_is_the_same_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    file, back = tmp_path / f"run{suffix}", tmp_path / "back.mcap"
    told = json.loads(run(capsys, LOG, "--to", str(file), "--json"))
    assert told["channels"] == "arm9-0 arm9-1 arm9-2"
    run(capsys, str(file), "--scenario", "arm9-transition", "--to", str(back))
    original, copy = LogReader(GOLDEN), LogReader(back)
    assert list(copy.messages(BusFrames)) == list(original.messages(BusFrames))
    states = {state.sequence: state for state in copy.messages(RobotState)}
    for state in original.messages(RobotState):
        changed = {"applied": state.applied, "status": state.status}
        assert states[state.sequence].model_copy(update=changed) == state
    assert copy.fingerprint["frames_of"] == file.name
    assert write_report(back, tmp_path / "report", plots=False).metrics.states == len(states)


def test_channels_may_be_renamed_both_ways(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"--channel=arm9-{i}=can{i}" for i in range(3)]
    told = run(capsys, LOG, "--to", str(tmp_path / "x.log"), *names)
    assert told.rstrip().endswith("channels can0 can1 can2")
    assert " can1 184#" in (tmp_path / "x.log").read_text()
    out = run(capsys, str(tmp_path / "x.log"), "--robot", "arm9", "--only", "TPDO1", "--count", "9", *names)
    assert {line.split()[1] for line in out.splitlines()} == {"arm9-0", "arm9-1", "arm9-2"}


def test_a_capture_of_one_bus_shows_that_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "x.csv")
    run(capsys, LOG, "--bus", "arm9-1", "--to", path)
    out = run(capsys, path, "--robot", "arm9", "--bus", "arm9-1", "--only", "TPDO1", "--count", "3")
    assert [line.split()[2] for line in out.splitlines()] == ["shoulder_roll", "shoulder_yaw", "elbow_pitch"]


def test_one_bus_of_a_file_and_a_channel_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "x.asc")
    run(capsys, LOG, "--to", path)
    out = run(capsys, path, "--robot", "arm9", "--bus", "arm9-1", "--only", "TPDO1", "--count", "3")
    assert [line.split()[2] for line in out.splitlines()] == ["shoulder_roll", "shoulder_yaw", "elbow_pitch"]
    told = run(capsys, path, "--robot", "arm9", "--channel", "arm9-1=9", code=2)
    assert "no frames of bus arm9-1; give --channel" in told


def test_one_tools_file_to_anothers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = (str(tmp_path / name) for name in NAMES)
    run(capsys, LOG, "--to", first)
    run(capsys, first, "--robot", "arm9", "--to", second)
    both = [run(capsys, str(tmp_path / name), "--robot", "arm9", "--only", "EMCY", "--only", "NMT") for name in NAMES]
    assert both[0] == both[1] != ""


def test_statistics_of_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    text = run(capsys, LOG, "--stats", "--bus", "arm9-0")
    assert "bus arm9-0: load " in text
    assert "│ 181 │ TPDO1     │ scapula_yaw" in text
    (bus,) = json.loads(run(capsys, LOG, "--stats", "--bus", "arm9-0", "--json"))
    assert 0.2 < bus["load_mean"] < bus["load_max"] < 1.0


def test_a_robot_whose_buses_are_overloaded_can_be_watched(capsys: pytest.CaptureFixture[str]) -> None:
    robot = str(Path(__file__).parents[1] / "data" / "robots" / "arm9-one-bus.yaml")
    assert "BO_ 393 wrist_roll_TPDO1" in run(capsys, "--dbc", "--robot", robot)


def test_a_dbc_is_printed_or_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "--dbc", "--robot", "arm9", "--bus", "arm9-0")
    assert "BO_ 385 scapula_yaw_TPDO1: 8 scapula_yaw" in printed
    run(capsys, LOG, "--dbc", "--bus", "arm9-0", "--to", str(tmp_path / "x.dbc"))
    assert (tmp_path / "x.dbc").read_text() == printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LOG, "--to", "x.foo"), "known are .log, .asc, .blf, .trc, .csv"),
        ((LOG, "--to", "x.mcap"), "is a log already"),
        ((LOG, "--to", "x.csv"), "holds no channels; choose one of"),
        ((LOG, "--robot", "arm9"), "holds its own robot"),
        ((LOG, "--bus", "can0"), "robot arm9 has arm9-0"),
        ((LOG, "--only", "elbow"), "--only elbow"),
        ((LOG, "--stats", "--dbc"), "give one of"),
        ((LOG, "--only", "hal", "--to", "x.log"), "give one of"),
        (("--dbc", "--robot", "arm9"), "a DBC file is of one bus; choose by --bus"),
        (("--robot", "arm9", "--scenario", "arm9-transition"), "--robot or --scenario"),
        (("x.log",), "give --robot or --scenario"),
        (("x.log", "--robot", "arm9", "--to", "x.mcap"), "give --scenario instead of --robot"),
        (("--robot", "arm9"), "no run is going on"),
        ((), "no run is going on"),
    ],
)
def test_usage_errors_name_the_way_out(
    arguments: tuple[str, ...], message: str, runtime: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in run(capsys, *arguments, code=2)


@pytest.mark.processes
def test_the_live_buses_of_a_run(tmp_path: Path) -> None:
    with cosim_up(tmp_path, "arm9-transition", "--duration", "30") as running:
        running.wait_for_sequence(50)
        lines = running.cli("bus", "--only", "TPDO1", "--count", "40", "--json").splitlines()
        assert {json.loads(line)["bus"] for line in lines} == {"arm9-0", "arm9-1", "arm9-2"}
        (bus,) = json.loads(running.cli("bus", "--stats", "--bus", "arm9-0", "--count", "300", "--json"))
        assert 0.2 < bus["load_mean"] < 0.6
        running.cli("bus", "--to", str(tmp_path / "live.log"), "--count", "500")
        assert len((tmp_path / "live.log").read_text().splitlines()) == 500
        running.interrupt()
        running.end()
