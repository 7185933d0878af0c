"""Joint friction of geared motors: Coulomb, Stribeck breakaway, and the holding brake of a drive without power.

The laws hold at the motor, [Cisneros 2018] Table I, and reach the joint through the gear N: torques × N, viscous
coefficient × N², velocities ÷ N. Dry friction is MuJoCo's friction constraint, which finds at every step the force
within ±F(q̇) that stops the joint, so a joint at rest stays at rest without chattering; only the bound F is ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas.scenario import Friction

Array = NDArray[np.float64]

FRICTION_STREAM = 4
"""Of the seed, beside those of masses, motors and sensors."""

BRAKE_FACTOR = 10.0
"""Torque of the holding brake over the joint's torque limit."""


def friction_factors(count: int, error: float, seed: int) -> Array:
    """Draw true over given friction of n joints, shape (n,): uniform within 1 ± error, from the seed."""
    draws = np.random.default_rng([seed, FRICTION_STREAM]).uniform(-1.0, 1.0, count)
    factors: Array = 1.0 + error * draws
    return factors


class DryFriction:
    """The bound of dry friction of n joints as a function of their velocities.

    F(q̇) = N (c + (b − c) exp(−(N q̇ / v_s)²)) + brake. The magnitude is even in q̇; the constraint gives the sign.

    Args:
        friction: Parameters at the motor.
        gear_ratio: N, shape (n,).
        torque_limit: [N·m] at the joint, shape (n,), from which the brake's torque follows.
        factor: true over given friction of each joint, shape (n,); the brake is not part of it.

    """

    def __init__(self, friction: Friction, gear_ratio: Array, torque_limit: Array, factor: Array | float = 1.0) -> None:
        self._coulomb = friction.coulomb * gear_ratio * factor
        self._excess = (friction.breakaway - friction.coulomb) * gear_ratio * factor
        self._exponent = -np.square(gear_ratio / friction.stribeck_velocity)
        self._brake_torque = BRAKE_FACTOR * torque_limit
        self._offset = self._coulomb + self._brake_torque
        self.set_brakes(np.ones(len(gear_ratio), dtype=bool))

    def set_brakes(self, engaged: NDArray[np.bool_]) -> None:
        """Engage or release the holding brakes, shape (n,)."""
        np.add(self._coulomb, np.where(engaged, self._brake_torque, 0.0), out=self._offset)

    def bound(self, velocity: Array) -> Array:
        """F [N·m] at joint velocities [rad/s], shape (n,)."""
        bound: Array = np.exp(velocity * velocity * self._exponent) * self._excess + self._offset
        return bound
