"""The recorder in its own process writes all that is published, until the others are gone or it is told to end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from deploy.run_file import write_run
from deploy.services import arguments
from deploy.session import free_base_port
from schemas.load import Run, load_run
from schemas.log import LogReader
from schemas.messages import Event
from schemas.service import Service, ServiceOptions
from schemas.transport import Transport, open_service

pytestmark = pytest.mark.processes
COUNT = 3000


@pytest.fixture(scope="module")
def run() -> Run:
    return load_run("arm9-transition")


def _event(sequence: int, kind: str = "note") -> Event:
    return Event(sequence=sequence, time_ns=sequence * 1000, service="hal", kind=kind, severity="info", text="x" * 500)


@contextmanager
def recorder(run: Run, folder: Path) -> Iterator[tuple[subprocess.Popen[str], Transport]]:
    """A recorder that expects the HAL, and this process in the HAL's place."""
    options = ServiceOptions(free_base_port(), "s", ("hal", "recorder"), folder, folder / "run.mcap")
    write_run(run, folder / "run.json")
    line = [sys.executable, *arguments(Service.RECORDER, folder / "run.json", options)]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    try:
        with open_service("hal", run, options) as hal:
            hal.join(["recorder"], 30.0)
            yield process, hal
    finally:
        process.kill()
        process.communicate(timeout=10.0)


def _ends(process: subprocess.Popen[str], code: int) -> str:
    _, errors = process.communicate(timeout=20.0)
    assert process.returncode == code, errors
    return errors


def _await_writing(log: Path) -> None:
    size, deadline = log.stat().st_size, time.monotonic() + 20.0
    while log.stat().st_size == size:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_records_all_until_the_last_word(run: Run, tmp_path: Path) -> None:
    with recorder(run, tmp_path) as (process, hal):
        for k in range(COUNT):
            hal.publish(hal.keys.event, _event(k))
        hal.publish(hal.keys.event, _event(COUNT, "service_stopped"))
        assert _ends(process, 0) == ""
    log = LogReader(tmp_path / "run.mcap")
    assert log.complete
    assert log.run == run
    assert log.fingerprint["seed"] == str(run.scenario.seed)
    heard = [event for event in log.messages(Event) if event.service == "hal"]
    assert [event.sequence for event in heard] == list(range(COUNT + 1))
    assert [record.time_ns for record in log.records({"event"})][: COUNT + 1] == [k * 1000 for k in range(COUNT + 1)]


def test_ends_with_a_lost_peer(run: Run, tmp_path: Path) -> None:
    with recorder(run, tmp_path) as (process, hal):
        hal.publish(hal.keys.event, _event(1))
        _await_writing(tmp_path / "run.mcap")  # one that is gone before all are ready never began
        hal.close()
        assert _ends(process, 0) == ""
    assert [event.sequence for event in LogReader(tmp_path / "run.mcap").messages(Event)] == [1]


def test_ends_when_told(run: Run, tmp_path: Path) -> None:
    with recorder(run, tmp_path) as (process, hal):
        hal.publish(hal.keys.event, _event(1))
        process.send_signal(signal.SIGTERM)
        assert _ends(process, 0) == ""
    assert LogReader(tmp_path / "run.mcap").complete


def test_killed_recorder_leaves_all_but_the_last_second(run: Run, tmp_path: Path) -> None:
    with recorder(run, tmp_path) as (process, hal):
        for k in range(10):
            hal.publish(hal.keys.event, _event(k))
        time.sleep(1.3)
        process.kill()
        process.wait(10.0)
        deadline = time.monotonic() + 0.5
        while hal.lost != ("recorder",) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert hal.lost == ("recorder",)
    log = LogReader(tmp_path / "run.mcap")
    assert not log.complete
    assert [event.sequence for event in log.messages(Event)] == list(range(10))


def test_what_is_no_message_is_left_out_and_reported(run: Run, tmp_path: Path) -> None:
    with recorder(run, tmp_path) as (process, hal):
        hal.publish_bytes(hal.keys.event, b"{", 0, 0)
        hal.publish(f"{hal.keys.root}/gossip", _event(0))
        hal.publish(hal.keys.event, _event(1, "service_stopped"))
        errors = _ends(process, 1)
    assert "recorder: left out: Event: message" in errors
    assert "has no topic 'gossip'" in errors
    assert [event.sequence for event in LogReader(tmp_path / "run.mcap").messages(Event)] == [1]


def test_full_disk_is_one_line_and_exit_1(run: Run, tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.fail("this test needs Linux's /dev/full")
    (tmp_path / "run.mcap").symlink_to("/dev/full")
    options = ServiceOptions(free_base_port(), "s", ("recorder",), tmp_path, tmp_path / "run.mcap")
    write_run(run, tmp_path / "run.json")
    line = [sys.executable, *arguments(Service.RECORDER, tmp_path / "run.json", options)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 1
    assert "cannot write the log: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
