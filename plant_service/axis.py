"""What a simulated CiA 402 device may do to its joint, and what it may know of it: drive units only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class AxisGains:
    """Firmware parameters of one axis, set by SDO; None leaves a parameter as it is.

    Gains, dead zone and torque act at the joint; the rated torque is the motor's own.
    """

    position_gain: float | None = None
    """k_p [N·m/rad] at the joint."""
    velocity_gain: float | None = None
    """k_d [N·m·s/rad] at the joint."""
    torque_limit: float | None = None
    """Largest motor torque at the joint [N·m]; limits on the bus act below it."""
    hold_ramp_s: float | None = None
    """Time over which the offset of a held torque goes to zero [s]."""
    rated_motor_torque: float | None = None
    """Torque of the motor that is 1000 ‰ [N·m], object 0x6076."""


class Axis(Protocol):
    """The motor, encoder and power stage of one joint as its drive's communication side sees them."""

    def position_counts(self) -> int:
        """Give the encoder position, sampled at this SYNC [counts]."""
        ...

    def torque_per_mille(self) -> int:
        """Give the motor torque from the current [‰ of the rated torque]."""
        ...

    def power_off(self) -> None:
        """Power stage off, holding brake on."""
        ...

    def follow_position(self, target_counts: int, max_torque_per_mille: int) -> None:
        """Latched at SYNC, mode 8: the position to reach one period from now, within a torque limit."""
        ...

    def follow_torque(self, per_mille: int, max_torque_per_mille: int) -> None:
        """Latched at SYNC, mode 10: the motor torque to give from now on, within a torque limit."""
        ...

    def hold(self) -> None:
        """Hold the joint where it is by the drive's own means, starting from the torque now acting."""
        ...

    def configure(self, gains: AxisGains) -> None:
        """Set firmware parameters."""
        ...
