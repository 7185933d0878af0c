"""Whole runs as separate processes, from the command line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from deploy.session import running_sessions
from schemas.log import LogReader
from schemas.messages import RobotState

pytestmark = pytest.mark.processes
START_S = 60.0


def command_line(directory: Path, duration_s: float) -> list[str]:
    up = [sys.executable, "-m", "deploy.cli", "up", "arm9-transition", "--duration", str(duration_s)]
    return [*up, "--out", str(directory), "--no-plots", "--json"]


@contextmanager
def going(directory: Path) -> Iterator[subprocess.Popen[str]]:
    """A long run whose recorder has put something on the disk."""
    up = subprocess.Popen(
        command_line(directory, 600.0), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0
    )
    try:
        log, deadline = directory / "run.mcap", time.monotonic() + START_S
        while not (log.exists() and log.stat().st_size > 100_000):
            assert up.poll() is None, up.communicate()[1]
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield up
    finally:
        up.kill() if up.poll() is None else None
        up.wait()


def service_pid(up: subprocess.Popen[str], service: str) -> int:
    children = Path(f"/proc/{up.pid}/task/{up.pid}/children").read_text().split()
    for child in children:
        if f"deploy.services\0{service}\0".encode() in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    raise AssertionError(f"no {service} among {children}")


def is_going(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_a_run_ends_with_its_log_and_summary(runtime: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = subprocess.run(command_line(out, 0.5), capture_output=True, text=True, timeout=START_S, check=False)
    assert done.returncode == 0, done.stderr
    metrics = json.loads(done.stdout)["metrics"]
    assert (metrics["states"], metrics["commands"], metrics["missed_commands"]) == (250, 250, 0)
    assert metrics["clock"] == "lockstep"
    assert json.loads((out / "metrics.json").read_text()) == metrics
    reader = LogReader(out / "run.mcap")
    assert reader.complete
    assert [state.sequence for state in reader.messages(RobotState)] == list(range(250))
    assert running_sessions() == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_everything_in_time_and_leaves_a_readable_log(
    number: signal.Signals, runtime: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with going(out) as up:
        pids = [service_pid(up, service) for service in ("plant", "hal", "controller", "recorder")]
        begun = time.monotonic()
        up.send_signal(number)
        while any(is_going(pid) for pid in pids):
            assert time.monotonic() - begun < 2.0
            time.sleep(0.02)
        output, errors = up.communicate(timeout=START_S)
    assert up.returncode == 1
    assert "interrupted" in errors
    assert json.loads(output)["interrupted"] is True
    assert LogReader(out / "run.mcap").complete


@pytest.mark.parametrize("service", ["plant", "hal", "controller"])
def test_a_killed_service_is_named_and_ends_the_run(service: str, runtime: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with going(out) as up:
        os.kill(service_pid(up, service), signal.SIGKILL)
        output, errors = up.communicate(timeout=20.0)
    assert up.returncode == 1
    assert f"cosim: {service} was killed by SIGKILL" in errors
    assert "Traceback" not in errors
    result = json.loads(output)  # what the log holds up to there is summed up all the same
    assert result["failure"].startswith(f"{service} was killed by SIGKILL")
    assert result["metrics"]["states"] > 0
    assert LogReader(out / "run.mcap").counts()["state"] > 0


def test_the_run_survives_its_recorder(runtime: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with going(out) as up:
        os.kill(service_pid(up, "recorder"), signal.SIGKILL)
        time.sleep(1.0)
        assert up.poll() is None
        up.send_signal(signal.SIGINT)
        output, errors = up.communicate(timeout=START_S)
    assert "recorder was killed by SIGKILL" in errors
    assert json.loads(output)["recorder_lost"] is True
    reader = LogReader(out / "run.mcap")
    assert not reader.complete
    assert reader.counts()["state"] > 0
