"""The limits that the HAL enforces, whatever the controller says: position, velocity, torque and torque rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from hal.profile.units import Array, bounded, fixed
from schemas.robot import RobotDescription

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Limited:
    """Limited values and where each limit acted."""

    value: Array
    acted: tuple[tuple[str, Mask], ...]
    """(name of the limit, mask over the joints)."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of all joints, in rad and N·m; steps are per cycle."""

    position_min: Array
    position_max: Array
    position_step: Array
    """velocity_limit · T [rad]."""
    torque_limit: Array
    torque_step: Array
    """torque_rate_limit · T [N·m]."""

    @classmethod
    def of(cls, description: RobotDescription) -> Self:
        """Bounds of a robot."""
        joints, period = description.joints, description.period_s
        return cls(
            fixed([joint.position_min for joint in joints]),
            fixed([joint.position_max for joint in joints]),
            fixed([joint.velocity_limit * period for joint in joints]),
            fixed([joint.torque_limit for joint in joints]),
            fixed([joint.torque_rate_limit * period for joint in joints]),
        )

    def position(self, commanded: Array, previous: Array) -> Limited:
        """Clamp to the range, then to one cycle's motion from the previous target.

        The velocity limit comes last: a joint found outside its range is led back, not thrown.
        """
        in_range = bounded(commanded, self.position_min, self.position_max)
        value = bounded(in_range, previous - self.position_step, previous + self.position_step)
        return Limited(value, (("position range", in_range != commanded), ("velocity limit", value != in_range)))

    def torque(self, commanded: Array, previous: Array) -> Limited:
        """Clamp to the torque limit, then to one cycle's change from the previous torque."""
        in_range = bounded(commanded, -self.torque_limit, self.torque_limit)
        value = bounded(in_range, previous - self.torque_step, previous + self.torque_step)
        return Limited(value, (("torque limit", in_range != commanded), ("torque rate limit", value != in_range)))

    def servo_limit(self, commanded: Array) -> Limited:
        """Clamp a servo's torque limit to what the joint stands, from 0 upwards."""
        value = bounded(commanded, 0.0, self.torque_limit)
        return Limited(value, (("torque limit", value != commanded),))


class Onsets:
    """Remembers which limits act, so that each onset is told once and not every cycle."""

    def __init__(self, joints: int) -> None:
        self._joints = joints
        self._acting: dict[str, Mask] = {}

    def update(self, acted: tuple[tuple[str, Mask], ...]) -> list[tuple[str, int]]:
        """(limit, joint) of each limit that acts now and did not in the cycle before."""
        onsets = []
        for name, mask in acted:
            before = self._acting.get(name)
            if np.count_nonzero(mask):
                new = mask if before is None else mask & ~before
                onsets += [(name, int(joint)) for joint in np.flatnonzero(new)]
            self._acting[name] = mask
        return onsets
