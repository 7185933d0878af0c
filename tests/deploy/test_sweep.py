from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from deploy.cli import main
from deploy.errors import UsageError
from deploy.experiment import ExperimentResult, FailedRun, Outcome, seed_requests
from deploy.supervisor import ONE_THREAD
from deploy.sweep import Progress, SweepError, sweep, usable_cpus
from deploy.variation import vary
from experiments import transition
from tests.deploy import tiny_experiment

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
CRANE = ROOT / "tests" / "data" / "robots" / "crane.yaml"
LONG_S = 300.0
SWEEP_OF_SLEEPERS = f"""
from pathlib import Path
from deploy.experiment import seed_requests
from deploy.sweep import sweep
from tests.deploy.tiny_experiment import run
requests = seed_requests(range(4), {{"sleep_s": dict.fromkeys(range(4), {LONG_S})}}, Path("out"), vary=False)
sweep(run, requests, 2)
"""


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers find modules where this process does: let them find the one of the tests."""
    monkeypatch.syspath_prepend(str(ROOT))


def tiny(tmp_path: Path, count: int, jobs: int = 2, keep_logs: bool = False, **what: Any) -> tuple[Outcome, ...]:
    requests = seed_requests(range(count), what, tmp_path, vary=False)
    return sweep(tiny_experiment.run, requests, jobs, keep_logs=keep_logs)


def test_outcomes_come_in_the_order_of_the_seeds_whoever_is_first(tmp_path: Path) -> None:
    requests = seed_requests(range(4), {"sleep_s": {0: 1.0}, "stop": [2]}, tmp_path, vary=False)
    heard: list[Progress] = []
    finished: list[int] = []
    outcomes = sweep(
        tiny_experiment.run, requests, 2, progress=heard.append, done=lambda outcome: finished.append(outcome.seed)
    )
    assert [outcome.seed for outcome in outcomes] == [0, 1, 2, 3]
    assert sorted(finished) == [0, 1, 2, 3]
    assert finished[-1] == 0
    assert {(each.seed, each.what) for each in heard} == {(seed, w) for seed in range(4) for w in ("starting", "half")}
    assert outcomes[2] == FailedRun(2, "stopped at sequence 7: joint too fast", requests[2].overrides)
    assert [outcome.passed for outcome in outcomes] == [True, True, False, True]


def test_logs_are_kept_of_seeds_that_do_not_pass(tmp_path: Path) -> None:
    tiny(tmp_path, 3, stop=[1], miss=[2])
    assert {path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("run.mcap")} == {"seed-1", "seed-2"}
    assert len(list(tmp_path.rglob("plot.png"))) == 6
    tiny(tmp_path, 3, keep_logs=True)
    assert len(list(tmp_path.rglob("run.mcap"))) == 6


def test_workers_have_one_blas_thread_and_this_process_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ONE_THREAD[0], "7")
    monkeypatch.delenv(ONE_THREAD[1], raising=False)
    (outcome,) = tiny(tmp_path, 1)
    assert isinstance(outcome, ExperimentResult)
    assert outcome.metrics["threads"] == [1.0] * len(ONE_THREAD)
    assert os.environ[ONE_THREAD[0]] == "7"
    assert ONE_THREAD[1] not in os.environ
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        ({"bug": [1]}, SweepError, "seed 1: internal error: ValueError: shapes do not match"),
        ({"refuse": [1]}, UsageError, "^--set seed: the experiment sets it itself"),
        ({"die": [1]}, SweepError, "a worker died.* seeds ran: .*1"),
    ],
)
def test_what_no_other_seed_would_mend_ends_the_sweep_at_once(
    what: dict[str, list[int]], error: type[Exception], words: str, tmp_path: Path
) -> None:
    started = time.monotonic()
    with pytest.raises(error, match=words):
        tiny(tmp_path, 4, sleep_s={0: LONG_S, 2: LONG_S}, **what)
    assert time.monotonic() - started < 0.1 * LONG_S


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_a_sweep_that_is_stopped(how: signal.Signals, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", SWEEP_OF_SLEEPERS], cwd=tmp_path, env=environment, start_new_session=True,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        files = [tmp_path / "out" / f"seed-{seed}" / "pid" for seed in (0, 1)]
        wait_until(lambda: all(path.is_file() and path.read_text() for path in files))
        pids = [int(path.read_text()) for path in files]
        assert all(map(lives, pids))
        if how is signal.SIGINT:
            os.killpg(process.pid, how)  # a terminal's Ctrl-C reaches all of them
        else:
            process.send_signal(how)
        _, error = process.communicate(timeout=30.0)
        assert process.returncode != 0
        assert error.count("Traceback") == (how is signal.SIGINT)
        wait_until(lambda: not any(map(lives, pids)))
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition: Any) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_real_sweep_has_the_results_of_the_same_runs_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in tiny_experiment.SHORT:
        monkeypatch.setattr(transition, name, getattr(transition, name))  # puts it back
    requests = seed_requests(range(2), {"robot": str(CRANE)}, tmp_path, vary=True)
    outcomes = sweep(tiny_experiment.short_transition, requests, 2)
    assert [outcome.passed for outcome in outcomes] == [True, True]
    alone = tiny_experiment.short_transition(requests[1])
    assert outcomes[1] == replace(alone, overrides=vary(1) | {"robot": str(CRANE)})
    assert outcomes[0].as_json()["metrics"] != outcomes[1].as_json()["metrics"]
    assert len(list(tmp_path.rglob("*.png"))) == 4
    assert not list(tmp_path.rglob("seed-0/**/run.mcap"))


@pytest.fixture
def tiny_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.experiment.find_experiment", lambda _: tiny_experiment.run)


def test_the_json_of_the_command_and_its_files(
    tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["sweep", "tiny", "--seed", "4", "--seeds", "3", "--jobs", "2", "--out", str(tmp_path), "--json"]
    assert main(line) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "metrics.json").read_text())
    assert [run["seed"] for run in printed["runs"]] == [4, 5, 6]
    assert [run["metrics"]["torque_scale"] for run in printed["runs"]] == [
        vary(seed)["plant.torque_scale"] for seed in (4, 5, 6)
    ]
    assert [run["overrides"] for run in printed["runs"]] == [vary(seed) for seed in (4, 5, 6)]
    del printed["runs"]
    bar = {
        "name": "seed", "limit": 1000.0, "at_least": False, "holds_count": 3,
        "worst": 6.0, "worst_seed": 6, "median": 5.0,
    }  # fmt: skip
    counts = {"seeds": 3, "seeds_passed": 3, "passed": True}
    assert printed == {"experiment": "tiny", "robot": "arm9", **counts, "bars": [bar]}
    assert json.loads((tmp_path / "seed-5" / "metrics.json").read_text())["seed"] == 5
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")

    assert main([*line, "--nominal", "--set", "stop=[5]", "--set", "miss=[6]"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert (printed["seeds_passed"], printed["passed"], printed["bars"][0]["holds_count"]) == (1, False, 1)
    assert printed["runs"][0]["metrics"]["torque_scale"] is None
    failed = {"seed": 5, "error": "stopped at sequence 7: joint too fast", "overrides": {"stop": [5], "miss": [6]}}
    assert printed["runs"][1] == failed
    assert json.loads((tmp_path / "seed-5" / "metrics.json").read_text()) == printed["runs"][1]


def test_the_table_of_the_command(tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["sweep", "tiny", "--seeds", "3", "--jobs", "3", "--out", str(tmp_path)]
    assert main([*line, "--set", "stop=[1]", "--set", "plant.torque_scale=0.5"]) == 1
    captured = capsys.readouterr()
    assert "tiny on arm9, 3 seeds" in captured.out
    assert "2/3" in captured.out
    assert "seed 1: stopped at sequence 7: joint too fast" in captured.out
    assert "2 of 3 seeds pass" in captured.out
    assert captured.err == ""
    assert json.loads((tmp_path / "seed-0" / "metrics.json").read_text())["metrics"]["torque_scale"] == 0.5

    assert main([*line, "--set", "stop=[0, 1, 2]"]) == 1
    assert "0 of 3 seeds pass" in capsys.readouterr().out


def test_experiment_repeats_a_run_of_a_sweep_and_sums_up_several(
    tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def scales(*options: str) -> list[float | None]:
        assert main(["experiment", "tiny", "--out", str(tmp_path), "--json", *options]) == 0
        printed = json.loads(capsys.readouterr().out)
        return [run["metrics"]["torque_scale"] for run in printed.get("runs", [printed])]

    assert scales("--seed", "5", "--vary") == [vary(5)["plant.torque_scale"]]
    assert scales("--seed", "5") == [None]
    assert scales("--seed", "4", "--seeds", "2", "--vary") == [vary(seed)["plant.torque_scale"] for seed in (4, 5)]
    assert scales("--seed", "4", "--seeds", "2") == [None, None]
    assert main(["experiment", "tiny", "--out", str(tmp_path), "--seeds", "2", "--set", "miss=[1]"]) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 seeds pass" in printed
    assert "1/2" in printed


def test_a_seed_that_fails_does_not_end_an_experiment_of_several(
    tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["experiment", "tiny", "--out", str(tmp_path), "--seeds", "3", "--set", "stop=[0]", "--set", "miss=[2]"]
    assert main([*line, "--json"]) == 1
    captured = capsys.readouterr()
    printed = json.loads(captured.out)
    assert captured.err == ""
    assert printed == json.loads((tmp_path / "metrics.json").read_text())
    assert (printed["seeds"], printed["seeds_passed"], printed["passed"]) == (3, 1, False)
    failed = {"seed": 0, "error": "stopped at sequence 7: joint too fast", "overrides": {"stop": [0], "miss": [2]}}
    assert printed["runs"][0] == failed == json.loads((tmp_path / "seed-0" / "metrics.json").read_text())
    assert printed["runs"][1]["overrides"] == failed["overrides"]

    assert main(line) == 1
    table = capsys.readouterr().out
    assert "seed 0: stopped at sequence 7: joint too fast" in table
    assert "1 of 3 seeds pass" in table
    assert main([*line, "--set", "stop=[0, 1, 2]"]) == 1
    assert "0 of 3 seeds pass" in capsys.readouterr().out


def test_one_seed_that_fails_is_an_error_and_leaves_it_in_its_file(
    tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["experiment", "tiny", "--out", str(tmp_path), "--json"]
    assert main(line) == 0
    passed = json.loads(capsys.readouterr().out)
    assert passed == json.loads((tmp_path / "metrics.json").read_text())
    assert main([*line, "--set", "stop=[0]"]) == 1
    captured = capsys.readouterr()
    assert captured.err == "cosim: stopped at sequence 7: joint too fast\n"
    failed = {"seed": 0, "error": "stopped at sequence 7: joint too fast", "overrides": {"stop": [0]}}
    assert json.loads(captured.out) == failed == json.loads((tmp_path / "metrics.json").read_text())


def test_a_run_that_comes_to_no_end_leaves_no_older_results(
    tiny_for_all: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["experiment", "tiny", "--out", str(tmp_path)]
    assert main([*line, "--json"]) == 0
    (tmp_path / "null-space.svg").write_text("old")
    assert main([*line, "--json", "--set", "bug=[0]"]) == 1
    assert "internal error" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.json")) + list(tmp_path.glob("*.svg"))


def test_a_configuration_that_no_seed_can_run_with_is_bad_usage(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    line = ["sweep", "transition", "--seeds", "2", "--out", str(tmp_path), "--set", "robot.rate_hz=1000"]
    assert main(line) == 2
    captured = capfd.readouterr()
    assert "overloaded" in captured.err
    assert captured.out == ""
    assert "Traceback" not in captured.err


def test_usable_cpus_are_those_of_this_process() -> None:
    assert 1 <= usable_cpus() <= (os.cpu_count() or 1)
