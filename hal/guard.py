"""The HAL's watch over a robot in torque mode, where no clamped target bounds its motion."""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from hal.decode import Notice
from hal.profile.units import Array, fixed
from schemas.robot import RobotDescription

OVERSPEED: Final = 1.2
"""Measured speed over the limit at which the robot is stopped; the controller's own constraint acts at 1."""
RANGE_MARGIN: Final = 0.02
"""Share of a joint's range by which it may be beyond its end before the robot is stopped."""


class MotionGuard:
    """Finds joints in torque mode that are too fast or have left their range."""

    KINDS: ClassVar[frozenset[str]] = frozenset({"overspeed", "out_of_range"})
    """Of its notices."""

    def __init__(self, robot: RobotDescription) -> None:
        self._joints = robot.joint_names
        self._speed = OVERSPEED * fixed([joint.velocity_limit for joint in robot.joints])
        low = fixed([joint.position_min for joint in robot.joints])
        high = fixed([joint.position_max for joint in robot.joints])
        margin = RANGE_MARGIN * (high - low)
        self._low, self._high = low - margin, high + margin

    def review(self, position: Array, velocity: Array) -> list[Notice]:
        """List what must stop the robot.

        Args:
            position: measured (n,) [rad].
            velocity: mean over the last samples (n,) [rad/s].
        """
        fast = np.abs(velocity) > self._speed
        outside = (position < self._low) | (position > self._high)
        if not (fast.any() or outside.any()):
            return []
        notices = []
        for joint in np.flatnonzero(fast).tolist():
            text = (
                f"joint {self._joints[joint]}: {velocity[joint]:.3g} rad/s in torque mode, more than"
                f" {self._speed[joint]:.3g} rad/s ({OVERSPEED:g} × velocity_limit)"
            )
            notices.append(Notice("overspeed", "error", text, joint, stops=True))
        for joint in np.flatnonzero(outside).tolist():
            text = (
                f"joint {self._joints[joint]}: {position[joint]:.3g} rad in torque mode, outside"
                f" {self._low[joint]:.3g} … {self._high[joint]:.3g} rad (its range and a margin)"
            )
            notices.append(Notice("out_of_range", "error", text, joint, stops=True))
        return notices
