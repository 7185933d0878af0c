"""The drive firmware's position law and its inverse, all joints at once. Torques in N·m, angles in rad, at the joint.

    τ = D(k_p (q_t − q) + k_d (q̇_t − q̇)) clipped to ± torque limit,   D(x) = sign(x) max(|x| − d, 0)

D is the dead zone that drive and motor current leave around zero [Del Prete 2016]. While q_t moves between two
set-points q̇_t is its slope, or zero for drives whose law has none (`Drive.velocity_reference`); the master's holding
target has q̇_t = 0 either way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from hal.profile.units import Array, bounded, fixed
from schemas.robot import RobotDescription

SMOOTHING = 0.05
"""Half width, as a fraction of d, of the band around zero torque over which `inverse_dead_zone` goes from −d to d."""
NARROWEST_BAND = 1e-200
"""[N·m]: a torque divided by it is still a number."""

_UNIT = fixed(-1.0), fixed(1.0)


@dataclass(frozen=True, slots=True)
class FirmwareGains:
    """Parameters of the law, arrays over the joints."""

    position_gain: Array
    """k_p [N·m/rad]."""
    velocity_gain: Array
    """k_d [N·m·s/rad]."""
    dead_zone: Array
    """d [N·m]."""
    torque_limit: Array
    """[N·m]."""

    @classmethod
    def of(cls, description: RobotDescription) -> Self:
        """Nominal parameters of a robot's drives."""
        joints = description.joints
        return cls(
            fixed([j.drive.position_gain for j in joints]),
            fixed([j.drive.velocity_gain for j in joints]),
            fixed([j.drive.dead_zone for j in joints]),
            fixed([j.torque_limit for j in joints]),
        )

    def select(self, joints: npt.NDArray[np.intp] | slice) -> FirmwareGains:
        """Parameters of some joints, in the order of the indices given."""
        return FirmwareGains(
            fixed(self.position_gain[joints]),
            fixed(self.velocity_gain[joints]),
            fixed(self.dead_zone[joints]),
            fixed(self.torque_limit[joints]),
        )


def dead_zone(x: Array, width: Array) -> Array:
    """D(x) = sign(x) max(|x| − d, 0)."""
    result: Array = x - bounded(x, -width, width)
    return result


def inverse_dead_zone(torque: Array, width: Array, smoothing: float = 0.0) -> Array:
    """D⁻¹(τ) = τ + d sign(τ).

    Args:
        torque: τ to be delivered.
        width: d.
        smoothing: 0 is the exact inverse, 0 at zero torque. For a command given every cycle, whose sign may change
            from one to the next, `SMOOTHING` replaces sign(τ) by τ / (smoothing · d) clipped to ±1: continuous, so it
            cannot chatter, exact for |τ| ≥ smoothing · d, and short by less than smoothing · d below.
    """
    if smoothing > 0.0:
        return inverse_with_band(torque, width, smoothing_band(width, smoothing))
    return torque + width * np.sign(torque)


def smoothing_band(width: Array, smoothing: float) -> Array:
    """Half width [N·m] of the band in which `inverse_dead_zone` is smoothed, never zero."""
    band: Array = np.maximum(smoothing * width, NARROWEST_BAND)
    return band


def inverse_with_band(torque: Array, width: Array, band: Array) -> Array:
    """`inverse_dead_zone` with its `smoothing_band` given, for every cycle."""
    return torque + width * bounded(torque / band, *_UNIT)


def position_torque(
    target: Array, target_velocity: Array, position: Array, velocity: Array, gains: FirmwareGains
) -> Array:
    """Motor torque at the joint [N·m] of the firmware in its position modes (module's equation)."""
    effort = gains.position_gain * (target - position) + gains.velocity_gain * (target_velocity - velocity)
    return bounded(dead_zone(effort, gains.dead_zone), -gains.torque_limit, gains.torque_limit)


def holding_offset(torque: Array, velocity: Array, gains: FirmwareGains) -> Array:
    """(D⁻¹(τ) + k_d q̇) / k_p [rad]: from the position to the target at which the firmware gives τ, with q̇_t = 0."""
    return (inverse_dead_zone(torque, gains.dead_zone) + gains.velocity_gain * velocity) / gains.position_gain


def ramp_share(remaining: float) -> float:
    """Share of a holding offset that is left when a share `remaining` of its ramp's time is left: r² (3 − 2r).

    It starts and ends without slope: the position loop's damping answers a target's slope with torque, and a linear
    ramp would put that into one cycle.
    """
    bounded_remaining = min(max(remaining, 0.0), 1.0)
    return bounded_remaining**2 * (3.0 - 2.0 * bounded_remaining)
