"""Velocity from measured positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller_service.model import Array


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the controller believes of the joints: positions [rad] as measured, velocities [rad/s] filtered."""

    position: Array
    velocity: Array


class VelocityEstimator:
    """Backward difference and first-order low-pass.

    q̇_k = α q̇_{k−1} + (1 − α) (q_k − q_{k−1}) / T with the exact discrete pole α = exp(−2π f_c T). The estimate is late
    by T/2 (the difference) + T α/(1 − α) (the filter; about 1/(2π f_c) for f_c well below the rate): 2.8 ms at
    500 Hz and 60 Hz. The torque loop's crossover, about λ + K_v [rad/s], times this plus the command's delay is the
    phase it costs. The delay is not compensated: a prediction would need the friction, which is not known.

    Args:
        period_s: T.
        cutoff_hz: f_c.

    """

    def __init__(self, period_s: float, cutoff_hz: float) -> None:
        self._period = period_s
        self._rate = 2.0 * math.pi * cutoff_hz
        self._last: Array | None = None
        self._velocity: Array | None = None

    def estimate(self, position: Array, cycles: int = 1) -> Estimate:
        """Positions (n,) measured `cycles` periods after the last ones; the first call gives zero velocity."""
        if self._last is None or self._velocity is None:
            self._velocity = np.zeros_like(position)
        else:
            elapsed = cycles * self._period
            pole = math.exp(-self._rate * elapsed)
            self._velocity = pole * self._velocity + ((1.0 - pole) / elapsed) * (position - self._last)
        self._last = position
        return Estimate(position, self._velocity)
