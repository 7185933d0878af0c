from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from deploy.supervisor import ONE_THREAD, Supervisor, service_environment
from schemas.service import Service

SLEEP = "import time; time.sleep(60)"
DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True); time.sleep(60)"
NOTED = (
    "import signal, sys, time\n"
    "def stop(*_):\n"
    "    print(time.monotonic_ns(), flush=True); sys.exit(0)\n"
    "signal.signal(signal.SIGTERM, stop); print('up', flush=True); time.sleep(60)"
)


def start(supervisor: Supervisor, service: Service, code: str, directory: Path) -> None:
    supervisor.start(service, ["-c", code], directory / f"{service}.txt", service_environment(directory))


def wait_for_output(path: Path, count: int = 1) -> None:
    deadline = time.monotonic() + 10.0
    while len(path.read_text().splitlines()) < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_stop_ends_the_hal_before_the_others_and_the_recorder_last(tmp_path: Path) -> None:
    with Supervisor() as supervisor:
        for service in Service:
            start(supervisor, service, NOTED, tmp_path)
        for service in Service:
            wait_for_output(tmp_path / f"{service}.txt")
        begun = time.monotonic()
        assert supervisor.stop() == ()
        assert time.monotonic() - begun < 2.0
    at = {service: int((tmp_path / f"{service}.txt").read_text().splitlines()[1]) for service in Service}
    assert at[Service.HAL] < min(at[Service.PLANT], at[Service.CONTROLLER])
    assert at[Service.RECORDER] == max(at.values())


def test_what_does_not_listen_is_killed_within_two_seconds(tmp_path: Path) -> None:
    with Supervisor() as supervisor:
        start(supervisor, Service.PLANT, DEAF, tmp_path)
        wait_for_output(tmp_path / "plant.txt")
        begun = time.monotonic()
        assert supervisor.stop() == (Service.PLANT,)
        assert time.monotonic() - begun < 2.0
        assert supervisor.running() == ()
        assert supervisor.children[Service.PLANT].ending() == "was killed by SIGKILL"


def test_a_child_that_fails_is_named_with_what_it_printed(tmp_path: Path) -> None:
    with Supervisor() as supervisor:
        start(supervisor, Service.PLANT, "import sys; print('no such bus', file=sys.stderr); sys.exit(3)", tmp_path)
        start(supervisor, Service.HAL, "", tmp_path)
        assert supervisor.wait([Service.PLANT, Service.HAL], 10.0)
        first, second = supervisor.ended()
        assert first.epitaph() == "plant ended with exit code 3; it printed: no such bus"
        assert second.epitaph() == "hal ended with exit code 0; it printed nothing"


def test_leaving_the_block_leaves_no_process(tmp_path: Path) -> None:
    with Supervisor() as supervisor:
        start(supervisor, Service.CONTROLLER, SLEEP, tmp_path)
        pid = supervisor.children[Service.CONTROLLER].process.pid
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_services_compute_in_one_thread(tmp_path: Path) -> None:
    environment = service_environment(tmp_path)
    assert {environment[name] for name in ONE_THREAD} == {"1"}
    assert environment["COSIM_RUN_DIR"] == str(tmp_path)
