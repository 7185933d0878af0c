"""Hand-made statistics of arm9's buses and a log that holds them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from schemas.base import ControlMode
from schemas.load import Run
from schemas.log import LogWriter
from schemas.messages import AppliedCommand, BusStatistics, FrameStatistics, HalStatus, RobotState

ONE_SECOND = 500
"""Cycles."""


def frame(can_id: int, frames: int = ONE_SECOND, **fields: Any) -> FrameStatistics:
    return FrameStatistics(can_id=can_id, frames=frames, **fields)


def statistics(bus: str, **fields: Any) -> BusStatistics:
    """A quiet second of a bus that keeps to its worst case."""
    return BusStatistics(
        **{
            "sequence": ONE_SECOND,
            "time_ns": 1_000_000_000,
            "bus": bus,
            "cycles": ONE_SECOND,
            "load_mean": 0.4,
            "load_max": 0.5,
            "report_end_max_s": 0.0006,
            "command_end_max_s": 0.0015,
            "frames": (frame(0x080), frame(0x701, 10)),
        }
        | fields
    )


def write_log(path: Path, run: Run, *messages: BusStatistics) -> Path:
    """A log with one state and the messages."""
    count = len(run.robot.description.joints)
    state = RobotState(
        sequence=0,
        time_ns=0,
        status=HalStatus.ACTIVE,
        position_measured=(0.0,) * count,
        motor_torque_measured=(0.0,) * count,
        drive_state=(4,) * count,
        mode=(ControlMode.POSITION,) * count,
        error_code=(0,) * count,
        applied=AppliedCommand(sequence=-1, mode=ControlMode.POSITION, position=(0.0,) * count),
    )
    with LogWriter(path, run, {}) as log:
        log.write("state", state)
        for message in messages:
            log.write(f"load/{message.bus}", message)
    return path
