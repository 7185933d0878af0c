"""The holding rule: how the HAL takes a robot from torque to position without a step in the motor torque.

At the latch of the first position target the firmware gives D(k_p (q_t − q) − k_d q̇). With

    q_t = q + (e + k_d q̇) / k_p

its argument equals e, the effort last asked of it in torque mode: D⁻¹(τ), as rounded on the bus. So the motor torque
stays what it was, whatever the true dead zone is. q_t less the commanded position is an offset that then ramps to zero.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from hal.profile.firmware import SMOOTHING, FirmwareGains, inverse_dead_zone
from hal.profile.units import Array, DriveUnits, fixed
from schemas.robot import RobotDescription

HISTORY: Final = 8
"""Measured positions that the prediction looks back on."""


class Predictor:
    """Position and velocity some cycles ahead: a least-squares parabola through the last `HISTORY` measured positions.

    The fit trades noise for lag: over 8 samples the encoder's rounding enters the position one cycle ahead 1.4-fold and
    two cycles ahead 2.1-fold, where 3 samples would give 4.4 and 10.
    """

    def __init__(self, positions: Array, period_s: float) -> None:
        self._history = deque([positions] * HISTORY, maxlen=HISTORY)
        self._period = period_s
        times = np.arange(1 - HISTORY, 1, dtype=np.float64)
        self._fit = np.linalg.pinv(np.vander(times, 3, increasing=True))

    def update(self, positions: Array, elapsed: int = 1) -> None:
        """Append the positions [rad] of this cycle, `elapsed` periods after those before: kept, not copied.

        SYNCs that were left out are filled in along the line between both, so that the samples keep their distance.
        """
        if elapsed > 1:
            before = self._history[-1]
            for missed in range(max(1, elapsed - HISTORY), elapsed):
                self._history.append(before + (positions - before) * (missed / elapsed))
        self._history.append(positions)

    @property
    def mean_velocity(self) -> Array:
        """Over the last `HISTORY` samples (n,) [rad/s]."""
        velocity: Array = (self._history[-1] - self._history[0]) / ((HISTORY - 1) * self._period)
        return velocity

    def ahead(self, cycles: int) -> tuple[Array, Array]:
        """Position [rad] and velocity [rad/s] at `cycles` after the last update."""
        latest = self._history[-1]
        constant, slope, curvature = self._fit @ (np.array(self._history) - latest)
        position = latest + constant + slope * cycles + curvature * cycles**2
        return position, (slope + 2.0 * curvature * cycles) / self._period


class HoldingRule:
    """The rule for one robot's drives."""

    def __init__(self, description: RobotDescription) -> None:
        self._units = DriveUnits.of(description)
        self._gains = FirmwareGains.of(description)
        self.cycles = max(1, round(description.safety.hold_ramp_s * description.rate_hz))

    def effort(self, torque: Array) -> Array:
        """Effort e [N·m]: what the torque driver put on the bus so that the drive delivers `torque` [N·m]."""
        asked = inverse_dead_zone(torque, self._gains.dead_zone, SMOOTHING)
        return self._units.torque_from_per_mille(self._units.per_mille_from_torque(asked))

    def target(self, torque: Array, position: Array, velocity: Array) -> Array:
        """q_t [rad] of the module's equation.

        Args:
            torque: last applied in torque mode [N·m].
            position: at the latch of the target [rad].
            velocity: at the latch [rad/s].
        """
        gains = self._gains
        return fixed(position + (self.effort(torque) + gains.velocity_gain * velocity) / gains.position_gain)
