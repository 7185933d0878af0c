"""A run whose services are started one by one on buses of the user's choosing is the run that it is anyway."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from deploy.runner import run_to_log
from deploy.session import free_base_port
from schemas.load import load_run
from schemas.log import LogReader

pytestmark = pytest.mark.processes
START_S = 120.0
COMPARED = ("state", "command", "trace", "truth", "bus/arm9-0", "bus/arm9-1", "bus/arm9-2")


def contents(log: Path) -> list[tuple[str, int, bytes]]:
    """Topics in turn: the order in which messages of different writers are logged is free."""
    records = [(record.topic, record.time_ns, record.data) for record in LogReader(log).records(COMPARED)]
    return sorted(records, key=lambda record: COMPARED.index(record[0]))


def test_services_agree_on_a_run_whose_wire_only_two_of_them_know(runtime: Path, tmp_path: Path) -> None:
    channels = ",".join(str(runtime / name) for name in ("a", "b", "c"))
    log = tmp_path / "run.mcap"
    options = ["--scenario", "arm9-transition", "--duration", "0.1", "--base-port", str(free_base_port())]
    own = {
        "plant": ["--bus", channels],
        "hal": ["--bus", channels],
        "controller": [],
        "record": ["--output", str(log)],
    }
    services = [
        subprocess.Popen([sys.executable, "-m", "deploy.cli", name, *options, *more], stderr=subprocess.PIPE, text=True)
        for name, more in own.items()
    ]
    try:
        errors = [service.communicate(timeout=START_S)[1] for service in services]
    finally:
        for service in services:
            service.kill()
            service.wait()
    assert [service.returncode for service in services] == [0, 0, 0, 0], errors
    elsewhere = load_run("arm9-transition", {"duration_s": 0.1})
    assert contents(log) == contents(run_to_log(elsewhere, tmp_path / "one-process"))
