"""Limits of torque, speed and joint range as bounds of the QP."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller_service.model import Array, Configuration
from schemas.robot import RobotDescription

BRAKING_SHARE = 0.5
"""Share of the torque left beside gravity that stopping before a range limit may count on."""
BRAKING_FLOOR = 0.1
"""The braking torque counted on is never less than this share of the limit, so that a joint can always move."""
RESPONSE_SHARE = 0.2
"""Speed bounds are reached with this share of `damper_s` as time constant: fast enough not to overshoot."""


@dataclass(frozen=True, slots=True)
class ConstraintRows:
    """l ≤ A x ≤ u, A (m, k), bounds (m,)."""

    A: Array
    lower: Array
    upper: Array


class JointLimits:
    """A robot's limits, as constraints on q̈.

    Torque, (33) of [Cisneros 2018] without contacts: u = M q̈ + h + L s must lie in ±τ_max, so
    −τ_max − h − L s ≤ M q̈ ≤ τ_max − h − L s. (The paper prints + L s on both sides, a slip of sign against its (30):
    L s is part of the torque that the motors give, so it takes away from what is left to M q̈.)

    Speed and range: with the speed allowed towards the upper limit
    v⁺ = min(q̇_max, (q_max − q)/t_d, √(2 a (q_max − q))), where a is the deceleration that a share of the torque left
    beside h can give the joint's own inertia, q̈ ≤ (v⁺ − q̇)/t_v, t_v = max(T, t_d/5): a velocity damper with
    braking. Below alike. Beyond a limit v⁺ is negative and leads back. l ≤ u always holds for these bounds.

    Args:
        description: of the robot.
        damper_s: t_d.

    """

    def __init__(self, description: RobotDescription, damper_s: float) -> None:
        joints = description.joints
        self.names = description.joint_names
        self.torque = np.array([joint.torque_limit for joint in joints])
        """(n,) [N·m]."""
        self.speed = np.array([joint.velocity_limit for joint in joints])
        self.position_min = np.array([joint.position_min for joint in joints])
        self.position_max = np.array([joint.position_max for joint in joints])
        self._torque_sides = np.stack((-self.torque, self.torque))
        self._braking_floor = BRAKING_FLOOR * self.torque
        self._damper = damper_s
        self.response_s = max(description.period_s, RESPONSE_SHARE * damper_s)
        """t_v [s]."""
        self._n = len(joints)

    def torque_bounds(self, now: Configuration, added: Array) -> Array:
        """Bounds (2, n) [N·m] of M q̈ (− Jᵀ Fʳ) beside what the law adds, (n,) [N·m]."""
        return np.asarray(self._torque_sides - (now.nonlinear + added))

    def acceleration_bounds(self, now: Configuration, caused: Array | None = None) -> Array:
        """Lower and upper bounds (2, n) [rad/s²] on q̈ʳ from range and speed, lower ≤ upper.

        By (31) of [Cisneros 2018] the robot accelerates by q̈ʳ + M⁻¹ u_K. That is so once the disturbance that the
        integral stands against is gone; while it is there, by q̈ʳ. Both must keep the bounds, so `caused` = M⁻¹ u_K (n,)
        narrows them on the side to which it points.
        """
        left = np.maximum(self.torque - np.abs(now.nonlinear), self._braking_floor)
        twice_deceleration = 2.0 * BRAKING_SHARE * left / now.mass.diagonal()
        distance = np.empty((2, self._n))
        np.subtract(now.position, self.position_min, out=distance[0])
        np.subtract(self.position_max, now.position, out=distance[1])
        outside = distance < 0.0
        if np.count_nonzero(outside):
            speed = self._speeds_outside(distance, twice_deceleration, outside)
        else:
            braking = np.sqrt(twice_deceleration * distance)
            speed = np.minimum(np.minimum(distance / self._damper, braking), self.speed)
            np.negative(speed[0], out=speed[0])
        speed -= now.velocity
        speed /= self.response_s
        if caused is not None:
            speed[0] -= np.minimum(caused, 0.0)
            speed[1] -= np.maximum(caused, 0.0)
            crossed = speed[0] > speed[1]
            if np.count_nonzero(crossed):
                speed[:, crossed] = 0.5 * (speed[0] + speed[1])[crossed]
        return speed

    def _speeds_outside(self, distance: Array, twice_deceleration: Array, outside: NDArray[np.bool_]) -> Array:
        """Speed limits (2, n), downwards and upwards, where a joint is beyond its range."""
        braking = np.sqrt(twice_deceleration * np.abs(distance))
        braking[outside] = np.inf
        speed = np.maximum(np.minimum(np.minimum(distance / self._damper, braking), self.speed), -self.speed)
        below, above = -speed[0], speed[1]
        # The way back wins over the other side's limit
        below = np.where(outside[1], np.minimum(below, above), below)
        return np.stack((below, np.maximum(above, below)))
