"""arm9 with all nodes on one bus at 500 Hz: refused, and when forced the summary says what was lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from deploy.cli import main
from deploy.inprocess import InProcess
from deploy.measured import compare
from deploy.metrics import summarize
from deploy.series import read_series
from schemas.errors import ConfigurationError
from schemas.fingerprint import fingerprint
from schemas.load import load_run
from schemas.log import LogWriter

ROBOT = Path(__file__).parents[1] / "data" / "robots" / "arm9-one-bus.yaml"
OVERRIDES = {"robot": str(ROBOT), "duration_s": 0.2}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A forced run in one process, short enough for no heartbeat to be missed."""
    run = load_run("arm9-transition", {**OVERRIDES, "allow_overload": True})
    path = tmp_path_factory.mktemp("overload") / "run.mcap"
    with LogWriter(path, run, fingerprint(run)) as writer:
        InProcess(run, writer.write).run()
    return path


def test_it_is_refused_with_the_arithmetic_unless_forced() -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_run("arm9-transition", dict(OVERRIDES))
    text = str(caught.value)
    assert "bus arm9-0 is overloaded: 1×SYNC(55 bit) + 9×TPDO1(135 bit)" in text
    assert "= 3430 bit in 2 ms at 1 Mbit/s = 171.5%" in text
    assert "--allow-overload" in text


def test_a_forced_run_counts_what_was_late_and_replaced_by_cob_id(log: Path) -> None:
    metrics = summarize(read_series(log))
    assert not metrics.plan_fits
    (bus,) = metrics.buses
    assert bus.load_mean > 0.99
    assert bus.late > 0
    assert bus.replaced > 0
    late = {frame.what for frame in bus.frames if frame.late}
    assert late <= {"RPDO1", "RPDO2"}
    assert late
    # The bus starves from the lowest priority upwards: SYNC and the first node's report always get through.
    counts = {frame.name: frame for frame in bus.frames}
    assert counts["SYNC"].replaced == counts["TPDO1 of scapula_yaw"].replaced == 0
    assert counts["TPDO1 of scapula_yaw"].frames >= counts["RPDO1 of wrist_roll"].frames


def test_report_and_doctor_say_so(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(log), "--out", str(tmp_path)]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "the buses cannot carry this plan" in words
    assert "bus arm9-0: " in words
    (bus,) = json.loads((tmp_path / "metrics.json").read_text())["buses"]
    assert sum(frame["late"] for frame in bus["frames"]) == bus["late"] > 0
    assert main(["doctor", "--log", str(log)]) == 1
    text = capsys.readouterr().out
    assert "lost: bus arm9-0: " in text
    assert "is overloaded, 172.2%" in text
    assert "above worst case" not in text  # nothing bounds an overloaded bus


def test_the_same_arm_on_three_buses_keeps_to_its_worst_case(
    fresh_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--robot", "arm9", "--log", str(fresh_log)]) == 0
    text = capsys.readouterr().out
    assert "lost" not in text
    assert "above worst case" not in text


@pytest.mark.parametrize("scenario", ["stilt-step", "feather-wave", "crane-transition"])
def test_other_robots_keep_to_theirs(scenario: str, tmp_path: Path) -> None:
    """Drives of one mode, whose first reports the plan leaves out; commands of two cycles' delay."""
    run = load_run(str(ROBOT.with_name(f"{scenario}.yaml")), {"duration_s": 0.15})
    path = tmp_path / "run.mcap"
    with LogWriter(path, run, {}) as writer:
        InProcess(run, writer.write).run()
    _, comparisons = compare(path)
    assert [line for each in comparisons for line in (*each.excesses(), each.measured.complaint()) if line] == []


@pytest.mark.processes
def test_a_forced_run_that_fails_is_summed_up_all_the_same(
    runtime: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """No heartbeat gets through: after 0.3 s the drives stop the run."""
    line = ["up", "arm9-transition", "--set", f"robot={ROBOT}", "--allow-overload", "--duration", "0.5"]
    assert main([*line, "--no-plots", "--json", "--out", str(tmp_path / "out")]) == 1
    captured = capfd.readouterr()
    result = json.loads(captured.out)
    (bus,) = result["metrics"]["buses"]
    assert bus["late"] > 0
    assert bus["replaced"] > 0
    assert "HEARTBEAT_LOST" in result["failure"]
    assert "cosim: hal ended with exit code 1" in captured.err
