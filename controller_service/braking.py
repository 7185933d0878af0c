"""The end of torque mode: from the last torque to one that carries and brakes the robot, then the error."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from controller_service.errors import ControllerError
from controller_service.model import Array, Configuration

STOP_S: Final = 0.1
"""Time from the failure of torque mode to the controller's end."""
STOP_DECAY_S: Final = 0.025
"""Time constant with which the last torque goes over into a braking one meanwhile."""
STOP_DAMPING: Final = 10.0
"""[1/s] of that braking: with the joints' inertia it stops them in some 100 ms where the torque limits allow it."""


class Braking:
    """Why torque mode ends, and the torques until it has ended.

    Args:
        torque_limit: (n,) [N·m].

    """

    def __init__(self, torque_limit: Array) -> None:
        self._limit = torque_limit
        self.error: ControllerError | None = None
        """Why; None: torque mode goes on."""
        self._since_s = 0.0

    def begin(self, error: ControllerError) -> None:
        """Bring the robot to rest before the error is raised."""
        self.error, self._since_s = error, 0.0

    def torque(self, last: Array, now: Configuration, elapsed_s: float) -> Array:
        """τ ← τ_b + (τ − τ_b) e^(−t/`STOP_DECAY_S`) with τ_b = g − `STOP_DAMPING` diag(M) q̇, (n,) [N·m], limited.

        Raises:
            ControllerError: the error that ended torque mode, after `STOP_S`.

        """
        assert self.error is not None
        if self._since_s >= STOP_S:
            raise self.error
        self._since_s += elapsed_s
        braking = now.gravity - STOP_DAMPING * now.mass.diagonal() * now.velocity
        torque = braking + math.exp(-elapsed_s / STOP_DECAY_S) * (last - braking)
        limited: Array = np.minimum(np.maximum(torque, -self._limit), self._limit)
        return limited
