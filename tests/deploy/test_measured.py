"""`cosim doctor --log`: each bus as measured beside its worst case."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.errors import ReportError, UsageError
from deploy.measured import Comparison, compare
from schemas.load import Run, load_robot, load_run
from schemas.messages import BusStatistics
from tests.deploy.bus_statistics import frame, statistics, write_log

BLOCKING_S = 65e-6
"""A heartbeat at 1 Mbit/s."""


@pytest.fixture
def log(run: Run, tmp_path: Path) -> Path:
    return write_log(tmp_path / "run.mcap", run, *(statistics(f"arm9-{n}") for n in range(3)))


def only(run: Run, folder: Path, message: BusStatistics) -> Comparison:
    _, (comparison,) = compare(write_log(folder / "one.mcap", run, message))
    return comparison


def test_the_worst_completions_count_a_heartbeat_before_sync_and_one_before_the_commands(log: Path) -> None:
    _, (arm, _, wrist) = compare(log)
    assert wrist.report_end_s == pytest.approx(985e-6 + BLOCKING_S)
    assert arm.report_end_s == pytest.approx(715e-6 + BLOCKING_S)
    # Commands wait for the slowest bus's reports.
    assert arm.command_end_s == pytest.approx(985e-6 + BLOCKING_S + 600e-6 + BLOCKING_S + 375e-6)


@pytest.mark.parametrize(
    ("field", "bound", "named"),
    [
        ("load_mean", 0.5476, "mean load"),
        ("load_max", 0.675, "load of the busiest cycle"),
        ("report_end_max_s", 780e-6, "last report"),
        ("command_end_max_s", 2090e-6, "last command"),
    ],
)
def test_what_exceeds_its_worst_case_is_named(field: str, bound: float, named: str, run: Run, tmp_path: Path) -> None:
    assert only(run, tmp_path, statistics("arm9-0", **{field: bound})).excesses() == ()
    (line,) = only(run, tmp_path, statistics("arm9-0", **{field: bound * 1.001})).excesses()
    assert line.startswith(f"bus arm9-0: {named} ")
    assert line.endswith("the arithmetic or the log is wrong")


def test_frames_that_the_worst_case_leaves_out_are_blamed(run: Run, tmp_path: Path) -> None:
    frames = (frame(0x080), frame(0x081, 2), frame(0x123, 3), frame(0x601, 4))
    comparison = only(run, tmp_path, statistics("arm9-0", load_max=0.9, frames=frames))
    (line,) = comparison.excesses()
    assert "9 EMCY, SDO, NMT or foreign frames" in line


def test_a_late_machine_is_blamed_in_realtime(tmp_path: Path) -> None:
    run = load_run("arm9-transition", {"clock": "realtime"})
    (line,) = only(run, tmp_path, statistics("arm9-0", command_end_max_s=0.004)).excesses()
    assert "last command 4.000 ms is above its worst case of 2.090 ms; on the realtime clock" in line


def test_nothing_bounds_a_plan_that_does_not_fit(tmp_path: Path) -> None:
    run = load_run("arm9-transition", {"robot.compute_budget_s": 0.0015, "allow_overload": True})
    assert only(run, tmp_path, statistics("arm9-0", command_end_max_s=0.004)).excesses() == ()


def test_the_doctor_shows_both_and_is_content(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", "arm9", "--log", str(log)]) == 0
    rows = [line.replace("│", " ").split() for line in capsys.readouterr().out.splitlines()]
    assert ["arm9-0", "worst", "54.8%", "67.5%", "0.780", "2.090"] in rows
    assert ["measured", "40.0%", "50.0%", "0.600", "1.500", "0", "0"] in rows
    assert main(["doctor", "--log", str(log), "--json"]) == 0
    diagnosis = json.loads(capsys.readouterr().out)
    assert diagnosis["robot"] == "arm9"
    assert diagnosis["above_worst_case"] == []
    first = diagnosis["buses"][0]
    assert first["worst_case_report_end_s"] == pytest.approx(780e-6)
    assert first["measured"]["load_mean"] == pytest.approx(0.4)
    assert [f["what"] for f in first["measured"]["frames"]] == ["SYNC", "heartbeat"]


def test_an_excess_and_a_loss_exit_with_1(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    too_long = write_log(tmp_path / "a.mcap", run, statistics("arm9-0", report_end_max_s=0.0009))
    assert main(["doctor", "--log", str(too_long)]) == 1
    assert "above worst case: bus arm9-0: last report 0.900 ms" in capsys.readouterr().out
    lost = write_log(tmp_path / "b.mcap", run, statistics("arm9-0", frames=(frame(0x201, late=3),)))
    assert main(["doctor", "--log", str(lost)]) == 1
    assert "lost: bus arm9-0: 3 late frames (RPDO1 of scapula_yaw 3 late)" in capsys.readouterr().out


def test_a_log_of_another_plan_is_refused_and_of_another_wire_is_not(log: Path) -> None:
    slower = load_robot("arm9", {"rate_hz": 250.0}).description
    with pytest.raises(UsageError, match=r"made with another plan \(arm9 at 500 Hz\) than that of arm9 at 250 Hz"):
        compare(log, slower)
    assert compare(log, load_robot("arm9", {"buses.0.channel": "elsewhere"}).description)[0].name == "arm9"


def test_a_log_without_statistics_says_so(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_log(tmp_path / "run.mcap", run)
    with pytest.raises(ReportError, match="holds no bus statistics"):
        compare(log)
    assert main(["doctor", "--robot", "arm9", "--log", str(log)]) == 1
    assert main(["doctor", "--robot", "arm9", "--log", str(tmp_path / "none.mcap")]) == 2
    assert "no log at" in capsys.readouterr().err
