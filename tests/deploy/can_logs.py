"""Runs of `tests.deploy.can_runs` in the CAN machine, and what they left."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from deploy.can_vm import run_in_machine
from hal.profile.frames import unpack
from schemas.log import LogReader
from schemas.messages import BusFrames
from schemas.topics import encode
from tests.deploy.can_runs import BUSES

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 2300.0


def run_inside(folder: Path, *runs: str) -> Path:
    """Boot the machine once for several runs; they leave their logs and what they said in `folder`."""
    command = ["python", "-m", "tests.deploy.can_runs", str(folder), *runs]
    completed = run_in_machine(command, timeout_s=PATIENCE_S, directory=REPOSITORY)
    assert completed.code == 0, completed.stdout + completed.stderr
    return folder


def said(folder: Path, name: str) -> list[dict[str, Any]]:
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def log(folder: Path, name: str) -> LogReader:
    return LogReader(folder / name / "run.mcap")


def messages(folder: Path, name: str, kind: Any) -> list[bytes]:
    return [encode(message) for message in log(folder, name).messages(kind)]


def frames_of(reader: LogReader, direction: str) -> dict[str, list[str]]:
    """All `sent` or `received` frames of each bus after the boot, as candump writes them, in their order.

    The boot depends on who is up first. To which cycle a frame is booked that the HAL does not wait for, a heartbeat,
    depends on the kernel.
    """
    frames: dict[str, list[str]] = {bus: [] for bus in BUSES}
    for message in reader.messages(BusFrames):
        if message.sequence >= 0:
            frames[message.bus] += names(getattr(message, direction))
    return frames


def names(packet: bytes) -> list[str]:
    return [f"{can_id:03X}#{data.hex().upper()}" for can_id, data in unpack(packet)]


def check_tests(folder: Path, name: str) -> None:
    """Tests that ran inside have passed, all of them."""
    (result,) = said(folder, name)
    assert result["code"] == 0, result["out"]
    assert " passed" in result["out"]
    assert " skipped" not in result["out"]
