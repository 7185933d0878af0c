from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.commands.options import bus_channel, overrides
from deploy.errors import UsageError
from schemas.errors import CosimError

COMMANDS = (
    "up", "plant", "hal", "controller", "record", "stop", "doctor", "replay", "report", "experiment", "bus",
)  # fmt: skip


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
        (["up", "arm9-transition", "--bus", "can0"], 2, "3 buses"),
        (["up", "arm9-transition", "--set", "controller.lambda=500"], 2, "lambda"),
        (["report", "nosuch.mcap"], 2, "nosuch.mcap"),
        (["replay", "nosuch.mcap"], 2, "nosuch.mcap"),
        (["experiment", "nosuch"], 2, "nosuch"),
        (["hal", "--scenario", "arm9-transition", "--peers", "hal,ghost"], 2, "ghost"),
        (["nosuch"], 2, "nosuch"),
    ],
)
def test_bad_usage_is_one_short_message_without_traceback(
    arguments: list[str], code: int, named: str, runtime: Path, capfd: pytest.CaptureFixture[str]
) -> None:
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
    assert overrides(sets, seed=7, duration_s=2.0, clock="realtime", bus="can0,other") == {
        "plant.torque_scale": 0.8,
        "controller.integral": "none",
        "seed": 7,
        "robot.rate_hz": 250,
        "duration_s": 2.0,
        "clock": "realtime",
        "robot.buses.0.interface": "socketcan",
        "robot.buses.0.channel": "can0",
        "robot.buses.1.interface": "cosim",
        "robot.buses.1.channel": "other",
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
