from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.commands.options import bus_channel, overrides, resolve_run
from deploy.errors import UsageError
from schemas.errors import CosimError
from schemas.load import Run
from schemas.service import session_identity

COMMANDS = (
    "up", "plant", "hal", "controller", "record", "stop", "doctor", "replay", "report", "experiment",
    "sweep", "bus",
)  # fmt: skip


PAIRED = ["up", "arm9-transition", "--bus", "can0,can2,can4"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_has_an_example_of_that_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert f"Example: cosim {command} " in " ".join(capsys.readouterr().out.split())


def test_help_names_all_commands_and_loads_no_heavy_library(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(command in text for command in COMMANDS)
    heavy = "{'mujoco', 'pinocchio', 'zenoh', 'numpy', 'matplotlib', 'can', 'pydantic'}"
    code = f"import sys, deploy.cli; deploy.cli.main(['--help']); sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["doctor", "--robot", "nosuch"], 2, "nosuch"),
        (["doctor"], 2, "--robot"),
        (["up", "nosuch"], 2, "nosuch"),
        (["up", "arm9-transition", "--set", "plant.nosuch=1"], 2, "plant.nosuch"),
        (["up", "arm9-transition", "--set", "seed"], 2, "PATH=VALUE"),
        (["up", "arm9-transition", "--clock", "sundial"], 2, "clock"),
        (["up", "arm9-transition", "--duration", "nan"], 2, "duration_s"),
        (["up", "arm9-transition", "--bus", "can0"], 2, "1 channels; robot arm9 has 3 buses"),
        (["up", "arm9-transition", "--bus", ""], 2, "3 buses"),
        (["up", "arm9-transition", "--bus", "can0,can1,can2,can3"], 2, "4 channels; robot arm9 has 3 buses"),
        (["up", "arm9-transition", "--bus", "can0,,can2"], 2, "--bus can0,,can2: a channel is empty"),
        (["up", "arm9-transition", "--bus", "can0,can1,can0"], 2, "'socketcan:can0' is given twice"),
        (["up", "arm9-transition", "--bus", "can0,can1,:x"], 2, "a channel is empty"),
        (["up", "arm9-transition", "--plant-bus", "a,b,c"], 2, "bus arm9-0 is virtual"),
        ([*PAIRED, "--plant-bus", "can1,can3"], 2, "--plant-bus can1,can3: 2 channels"),
        ([*PAIRED, "--plant-bus", "can1,can3,can0"], 2, "'socketcan:can0' is given twice"),
        ([*PAIRED, "--plant-bus", "can1,can3,pcan:x"], 2, "x is of interface pcan, but bus arm9-2"),
        ([*PAIRED, "--plant-bus", "can1,can3,can5", "--no-plant"], 2, "with --no-plant there is no plant"),
        (["hal", "--scenario", "arm9-transition", "--bus", "can0,can0,can1"], 2, "is given twice"),
        (["up", "arm9-transition", "--set", "robot.rate_hz=1000"], 2, "bus arm9-2 is overloaded"),
        (["up", "arm9-transition", "--set", "robot.compute_budget_s=0.0007"], 2, "2.060 ms > 2.000 ms"),
        (["plant", "--scenario", "arm9-transition", "--set", "robot.rate_hz=1000"], 2, "--allow-overload"),
        (["experiment", "transition", "--set", "robot.rate_hz=1000"], 2, "overloaded"),
        (["up", "arm9-transition", "--set", "controller.lambda=500"], 2, "lambda"),
        (["report", "nosuch.mcap"], 2, "nosuch.mcap"),
        (["replay", "nosuch.mcap"], 2, "nosuch.mcap"),
        (["experiment", "nosuch"], 2, "nosuch"),
        (["experiment", "null-space", "--set", "duration_s=5"], 2, "--set duration_s=17 or more"),
        (["experiment", "null-space", "--set", "seedling=5"], 2, "seedling"),
        (["experiment", "null-space", "--set", "plant.world.events=[]"], 2, "the experiment sets it itself"),
        (["experiment", "null-space", "--seeds", "2", "--set", "controller.null_space=null"], 2, "sets it itself"),
        (["sweep", "nosuch"], 2, "transition"),
        (["sweep", "transition", "--jobs", "0"], 2, "--jobs"),
        (["sweep", "transition", "--seeds", "0"], 2, "--seeds"),
        (["sweep", "transition", "--set", "seed"], 2, "PATH=VALUE"),
        (["hal", "--scenario", "arm9-transition", "--peers", "hal,ghost"], 2, "ghost"),
        (["nosuch"], 2, "nosuch"),
    ],
)
def test_bad_usage_is_one_short_message_without_traceback(
    arguments: list[str],
    code: int,
    named: str,
    runtime: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)  # experiments make room in runs/ below it
    assert main(arguments) == code
    captured = capfd.readouterr()
    assert named in captured.err
    assert "Traceback" not in captured.err
    if captured.err.startswith("cosim:"):
        assert len(captured.err.splitlines()) <= 2
    assert captured.out == ""


def test_debug_shows_the_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", "nosuch", "--debug"]) == 2
    assert "Traceback" in capfd.readouterr().err


def test_stop_without_a_run_says_so(runtime: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["stop"]) == 2
    assert "no run is going on" in capfd.readouterr().err


def test_a_report_of_something_else_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"not a log")
    assert main(["report", str(path)]) == 1
    error = capfd.readouterr().err
    assert str(path) in error
    assert len(error.splitlines()) <= 2


def test_set_values_are_yaml_and_later_options_win() -> None:
    sets = ["plant.torque_scale=0.8", "controller.integral=none", "seed=1", "robot.rate_hz=250"]
    assert overrides(sets, seed=7, duration_s=2.0, clock="realtime", allow_overload=True) == {
        "plant.torque_scale": 0.8,
        "controller.integral": "none",
        "seed": 7,
        "robot.rate_hz": 250,
        "duration_s": 2.0,
        "clock": "realtime",
        "allow_overload": True,
    }


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("can0", ("socketcan", "can0")),
        ("vcan12", ("socketcan", "vcan12")),
        ("arm", ("cosim", "arm")),
        ("can", ("cosim", "can")),
        ("/run/cosim/arm", ("cosim", "/run/cosim/arm")),
        ("pcan:PCAN_USBBUS1", ("pcan", "PCAN_USBBUS1")),
    ],
)
def test_bus_channels(text: str, expected: tuple[str, str]) -> None:
    assert bus_channel(text) == expected


def buses(**options: str) -> list[tuple[str, str, str | None]]:
    run = resolve_run("arm9-transition", None, **options)
    return [(bus.interface, bus.channel, bus.plant_channel) for bus in run.robot.description.buses]


def test_each_side_of_a_bus_may_have_its_channel() -> None:
    assert buses(bus="can0,can2,can4", plant_bus="can1,can3,can5") == [
        ("socketcan", "can0", "can1"),
        ("socketcan", "can2", "can3"),
        ("socketcan", "can4", "can5"),
    ]
    assert buses(bus="vcan0,arm,pcan:X") == [("socketcan", "vcan0", None), ("cosim", "arm", None), ("pcan", "X", None)]


def test_a_given_bus_is_both_sides_of_it_and_a_given_side_leaves_the_other(robot_file: Path) -> None:
    text = robot_file.read_text()
    for n in range(3):
        pair = f"interface: socketcan, channel: can{2 * n}, plant_channel: can{2 * n + 1}"
        text = text.replace(f"channel: arm9-{n}", pair)
    robot_file.write_text(text)

    def lines(**options: str) -> list[tuple[str, str | None]]:
        run = resolve_run("arm9-transition", [f"robot={robot_file}"], **options)
        return [(bus.channel, bus.plant_channel) for bus in run.robot.description.buses]

    assert lines() == [("can0", "can1"), ("can2", "can3"), ("can4", "can5")]
    assert lines(bus="vcan0,vcan1,vcan2") == [("vcan0", None), ("vcan1", None), ("vcan2", None)]
    assert lines(plant_bus="can7,can8,can9") == [("can0", "can7"), ("can2", "can8"), ("can4", "can9")]


def test_the_services_of_a_run_agree_whatever_wire_each_is_told_of() -> None:
    runs = [
        resolve_run("arm9-transition", None, bus=bus) for bus in (None, "can0,can2,can4", "can1,can3,can5", "a,b,c")
    ]
    assert len({session_identity(run) for run in runs}) == 1


@pytest.mark.parametrize("service", ["plant", "hal", "controller", "record"])
def test_every_service_can_be_forced_onto_buses_that_are_too_slow(
    service: str, runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    runs: list[Run] = []
    monkeypatch.setattr("deploy.services.run_service", lambda _service, run, _options: runs.append(run) or 0)
    monkeypatch.chdir(tmp_path)
    line = [service, "--scenario", "arm9-transition", "--set", "robot.rate_hz=1000", "--bus", "can0,can2,can4"]
    assert main(line) == 2
    assert "bus arm9-2 is overloaded" in capfd.readouterr().err
    assert main([*line, "--allow-overload"]) == 0
    assert [bus.channel for bus in runs[0].robot.description.buses] == ["can0", "can2", "can4"]


def test_usage_errors_exit_with_2() -> None:
    assert issubclass(UsageError, CosimError)
    assert UsageError("x").exit_code == 2


def test_doctor_json_is_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", "arm9", "--json"]) == 0
    diagnosis = json.loads(capsys.readouterr().out)
    assert diagnosis["robot"] == "arm9"
    assert diagnosis["fits"] is True
    assert len(diagnosis["joints"]) == 9
    assert [bus["name"] for bus in diagnosis["buses"]] == ["arm9-0", "arm9-1", "arm9-2"]


def test_record_overwrites_no_log(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("deploy.services.run_service", lambda *_: 0)
    monkeypatch.chdir(tmp_path)
    line = ["record", "--scenario", "arm9-transition"]
    for path, option in ((tmp_path / "mine.mcap", ["--output", "mine.mcap"]), (tmp_path / "arm9-transition.mcap", [])):
        assert main([*line, *option]) == 0
        path.write_bytes(b"log")
        assert main([*line, *option]) == 2
        assert f"{path.name}: exists" in capfd.readouterr().err
        assert path.read_bytes() == b"log"
