"""The base of every model that crosses a process boundary or is read from a file."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict

Vector = tuple[float, ...]
"""One number a joint, in the order of `RobotDescription.joints`."""

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Unit quaternion, scalar first: (w, x, y, z)."""


class Model(BaseModel):
    """Frozen, SI units, unknown fields refused, NaN and infinity refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)


class ControlMode(StrEnum):
    """What a joint command asks of the drives."""

    POSITION = "position"
    """Firmware position PD follows a position (CiA 402 mode 8, CSP)."""
    TORQUE = "torque"
    """Motor torque from the host (mode 10, CST)."""
    SERVO = "servo"
    """Position PD with a torque limit set every cycle (mode 8 and object 0x6072)."""


class Clock(StrEnum):
    """Who says when the next cycle starts."""

    LOCKSTEP = "lockstep"
    """The next SYNC follows the command; time is simulated and runs repeat bit for bit."""
    REALTIME = "realtime"
    """SYNC on an absolute timer of the wall clock; late commands are counted."""
