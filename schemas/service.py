"""What a service process is told beside its run: where to meet its peers, who they are, where to write."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from schemas.load import Run
from schemas.robot import BUS_LINES


class Service(StrEnum):
    """The processes of a run; the order is the order of their ports and of their start."""

    PLANT = "plant"
    HAL = "hal"
    CONTROLLER = "controller"
    RECORDER = "recorder"


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """Deployment of one service; nothing in it changes a message of a lockstep run."""

    base_port: int
    """First of the run's consecutive loopback TCP ports, one a service in the order of `Service`."""
    session: str
    """Identity of the run, the same for all its services."""
    peers: tuple[str, ...]
    """The services expected in the run, this one included (values of `Service`)."""
    run_directory: Path
    """Where bare bus channels have their sockets; short, since an AF_UNIX path holds 107 bytes."""
    output: Path | None = None
    """The recorder's file."""


def session_identity(run: Run) -> str:
    """Identity of a run: 12 hexadecimal digits that depend on robot, scenario and seed alone, so that logs repeat.

    The bus lines do not count: it is the same run on another wire, and only who opens a bus must know which.
    """
    robot = run.robot.description
    digest = hashlib.sha256()
    digest.update(robot.model_dump_json(by_alias=True, exclude={"buses": {"__all__": set(BUS_LINES)}}).encode())
    digest.update(run.robot.urdf.encode())
    digest.update(run.scenario.model_dump_json(by_alias=True).encode())
    return digest.hexdigest()[:12]
