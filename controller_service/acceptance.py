"""Whether a robot's state is fit to be answered, and what can be taken from it before anything is computed."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from controller_service.errors import StateError
from controller_service.estimation import Estimate
from controller_service.model import Array
from schemas.base import Vector
from schemas.messages import RobotState

TORQUE_SAMPLES: Final = 8
"""Measured motor torques averaged for the transition, at rest."""
REST_SPEED: Final = 0.02
"""[rad/s] Faster than this on any joint, the transition takes the last torque alone."""


class StateOrder:
    """Takes the states of one robot in their order.

    Args:
        names: of its joints.

    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._sequence: int | None = None

    def accept(self, state: RobotState) -> tuple[Array, int]:
        """Give the measured positions (n,) [rad], and the cycles since the last state.

        Raises:
            StateError: wrong number of joints, not finite, out of sequence.

        """
        if len(state.position_measured) != len(self._names):
            raise StateError(
                f"state {state.sequence} has {len(state.position_measured)} positions, the robot has"
                f" {len(self._names)} joints: is another robot running under the same namespace?"
            )
        measured = np.array(state.position_measured)
        if not all(map(math.isfinite, state.position_measured)):
            worst = int(np.argmin(np.isfinite(measured)))
            raise StateError(f"state {state.sequence}: position of {self._names[worst]} is {measured[worst]}")
        cycles = 1 if self._sequence is None else state.sequence - self._sequence
        if cycles < 1:
            raise StateError(
                f"state {state.sequence} came after state {self._sequence}; states must be in order, each once."
                " Is there a second HAL under the same namespace?"
            )
        self._sequence = state.sequence
        return measured, cycles


class GivenTorque:
    """What the position loop was giving, from the motor currents of the last states."""

    def __init__(self) -> None:
        self._torques: deque[Vector] = deque(maxlen=TORQUE_SAMPLES)

    def note(self, state: RobotState) -> None:
        """Take a state's report, if there is one."""
        if state.motor_torque_measured is not None:
            self._torques.append(state.motor_torque_measured)

    def forget(self) -> None:
        """Forget all: they were not the position loop's."""
        self._torques.clear()

    def torque(self, state: RobotState, estimate: Estimate) -> Array:
        """Give it (n,) [N·m]: the mean at rest, the last one in motion.

        Raises:
            StateError: the drives report none.

        """
        if state.motor_torque_measured is None:
            raise StateError(
                f"state {state.sequence}: the drives report no motor torque, which torque mode starts from."
                " Use position mode, or set controller.initialize_integral to false."
            )
        if np.abs(estimate.velocity).max() > REST_SPEED:
            return np.array(self._torques[-1])
        mean: Array = np.mean(self._torques, axis=0)
        return mean
