"""What the HAL asks of the drives for one latch, in SI units: the value between limits and drivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from hal.errors import HalError
from hal.profile.firmware import ramp_share
from hal.profile.units import Array
from schemas.base import ControlMode, Vector
from schemas.messages import AppliedCommand

HAL_DECIDED: Final = -1
"""`sequence` of what answers no command."""


@dataclass(frozen=True, slots=True)
class Hold:
    """An offset [rad] that holds a torque in the position modes; it ramps to zero by `ramp_share` over some cycles."""

    entry: Array
    cycles: int
    left: int

    @property
    def offset(self) -> Array:
        """What is left of `entry` [rad]."""
        return self.entry * ramp_share(self.left / self.cycles)

    def advanced(self) -> Hold | None:
        """Return the next cycle's; None when nothing is left."""
        return Hold(self.entry, self.cycles, self.left - 1) if self.left > 1 else None


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One limited command; arrays over all joints."""

    sequence: int
    mode: ControlMode
    position: Array | None = None
    """[rad], in the position modes; the firmware's target less what is left of a holding offset."""
    torque: Array | None = None
    """[N·m] to be delivered, in torque mode."""
    torque_limit: Array | None = None
    """[N·m], in servo mode."""
    hold: Hold | None = None

    @property
    def target(self) -> Array:
        """The firmware's target [rad].

        Raises:
            HalError: in torque mode.
        """
        if self.position is None:
            raise HalError(f"a set-point of mode {self.mode} holds no position")
        return self.position if self.hold is None else self.position + self.hold.offset

    def applied(self) -> AppliedCommand:
        """Make the message that reports it."""
        return AppliedCommand(
            sequence=self.sequence,
            mode=self.mode,
            position=None if self.position is None else vector(self.target),
            torque=None if self.torque is None else vector(self.torque),
            torque_limit=None if self.torque_limit is None else vector(self.torque_limit),
        )


def vector(array: Array) -> Vector:
    """Copy an array into a message's tuple."""
    return tuple(array.tolist())
