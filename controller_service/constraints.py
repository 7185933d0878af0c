"""Limits of torque, speed and joint range as one block l ≤ A q̈ ≤ u."""

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
    """2n rows: first the n accelerations themselves (A = I), then the n joint torques (A = M)."""

    A: Array
    lower: Array
    upper: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.lower) // 2

    def without_kinematics(self) -> ConstraintRows:
        """Only the torque rows bound: q̈ = M⁻¹(τ − h − L s) satisfies them, so they are feasible by themselves."""
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[: self.n] = -np.inf
        upper[: self.n] = np.inf
        return ConstraintRows(self.A, lower, upper)


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
        self.torque = np.array([joint.torque_limit for joint in joints])
        """(n,) [N·m]."""
        self.speed = np.array([joint.velocity_limit for joint in joints])
        self.position_min = np.array([joint.position_min for joint in joints])
        self.position_max = np.array([joint.position_max for joint in joints])
        self._torque_sides = np.stack((-self.torque, self.torque))
        self._braking_floor = BRAKING_FLOOR * self.torque
        self._damper = damper_s
        self._response = max(description.period_s, RESPONSE_SHARE * damper_s)
        self._n = len(joints)
        self._A = np.vstack((np.eye(self._n), np.zeros((self._n, self._n))))

    def rows(self, now: Configuration, integral: Array) -> ConstraintRows:
        """Constraints at a configuration with the integral torque L s (n,) [N·m]."""
        n = self._n
        A = self._A.copy()
        A[n:] = now.mass
        bounds = np.empty((2, 2 * n))
        bounds[:, :n] = self.acceleration_bounds(now)
        np.subtract(self._torque_sides, now.nonlinear + integral, out=bounds[:, n:])
        return ConstraintRows(A, bounds[0], bounds[1])

    def acceleration_bounds(self, now: Configuration) -> Array:
        """Lower and upper bounds (2, n) [rad/s²] on q̈ from range and speed, lower ≤ upper."""
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
        speed /= self._response
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
