"""Contacts from the estimated external joint torques: thresholds with hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller_service.errors import StateError
from controller_service.friction import refuse_unknown_joints
from controller_service.model import Array
from schemas.control_law import DisturbanceObserver
from schemas.robot import RobotDescription

END_SHARE = 0.5
"""Of the threshold: below it a joint is quiet."""
ROUNDING_S = 1e-9
"""A dwell time that is a sum of periods may miss its multiple by rounding."""


@dataclass(frozen=True, slots=True)
class ContactState:
    """What one estimate says of a contact."""

    active: bool
    """A contact lasts."""
    began: bool
    """With this estimate."""
    ended: bool
    """With this estimate."""
    joint: int
    """Index of the joint with the largest torque over its threshold, contact or not."""
    value: float
    """Its estimated external torque, signed [N·m]."""


class ContactDetector:
    """A contact begins when any |r_i| > h_i and ends when all |r_i| < h_i/2 for `dwell_s`.

    What is not known of friction, masses and torque constants is in r as well, and a threshold must lie above it; a
    push that a joint's static friction holds is seen only beyond it (`MomentumObserver.half_width`). What a contact
    does is not decided here.

    Args:
        description: names and torque limits of the joints.
        config: `threshold_share`, `thresholds` and `dwell_s`.

    Raises:
        ConfigurationError: a threshold for a joint that the robot does not have.

    """

    def __init__(self, description: RobotDescription, config: DisturbanceObserver) -> None:
        refuse_unknown_joints(description, config.thresholds, "controller.observer.thresholds")
        self.thresholds: Array = np.array(
            [
                config.thresholds.get(joint.name, config.threshold_share * joint.torque_limit)
                for joint in description.joints
            ]
        )
        """h (n,) [N·m]."""
        self.thresholds.setflags(write=False)
        self._names = description.joint_names
        self._per_threshold = 1.0 / self.thresholds
        self._dwell = config.dwell_s - ROUNDING_S
        self._active = False
        self._quiet: float | None = None
        """How long all joints have been quiet [s]; None: they are not."""

    def reset(self) -> None:
        """Forget a contact."""
        self._active, self._quiet = False, None

    def update(self, estimate: Array, elapsed_s: float) -> ContactState:
        """Take the next estimate.

        Args:
            estimate: r (n,) [N·m].
            elapsed_s: time since the last one.

        Raises:
            StateError: an estimate that is not finite.

        """
        shares = np.abs(estimate)
        shares *= self._per_threshold
        worst = int(shares.argmax())  # of a NaN, when there is one
        share, value = shares.item(worst), estimate.item(worst)
        if not share < math.inf:
            raise StateError(
                f"the external torque estimated at {self._names[worst]} is {value}: reset the observer, and look at the"
                " positions and motor torques that it was given"
            )
        began = ended = False
        if not self._active:
            began = self._active = share > 1.0
            self._quiet = None
        elif share < END_SHARE:
            self._quiet = 0.0 if self._quiet is None else self._quiet + elapsed_s
            if self._quiet >= self._dwell:
                ended, self._active = True, False
        else:
            self._quiet = None
        return ContactState(self._active, began, ended, worst, value)
