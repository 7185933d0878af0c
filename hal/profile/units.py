"""Drive units ↔ SI: the only place where counts and per mille of rated torque meet radians and newton metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from schemas.robot import RobotDescription

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int32]
PerMille = npt.NDArray[np.int16]
PerMilleLimit = npt.NDArray[np.uint16]

INT32_MAX = 2**31 - 1
INT16_MAX = 2**15 - 1
UINT16_MAX = 2**16 - 1


def fixed(values: npt.ArrayLike) -> Array:
    """Copy into a read-only float array."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def bounded(values: Array, low: Array | float, high: Array | float) -> Array:
    """Clip to [low, high]: as `np.clip`, at a third of its cost for arrays of a robot's size."""
    result: Array = np.minimum(np.maximum(values, low), high)
    return result


# Arrays, because numpy takes a Python number at twice the cost.
_INT32 = fixed(-INT32_MAX), fixed(INT32_MAX)
_INT16 = fixed(-INT16_MAX), fixed(INT16_MAX)
_UINT16 = fixed(0), fixed(UINT16_MAX)


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """Scales of all joints, in the order of the description; `direction` is part of both signed scales.

    position [rad] = zero_offset + counts · radian_per_count, torque [N·m at the joint] = ‰ ·
    newton_metre_per_mille, with radian_per_count = direction · 2π / (gear_ratio · encoder_counts) and
    newton_metre_per_mille = direction · gear_ratio · rated_motor_torque / 1000. Every method works on whole arrays;
    numbers beyond the bus's integers saturate.
    """

    radian_per_count: Array
    zero_offset: Array
    newton_metre_per_mille: Array

    @classmethod
    def of(cls, description: RobotDescription) -> Self:
        """Scales of a robot's joints."""
        joints = description.joints
        return cls(
            fixed([j.direction * 2.0 * np.pi / (j.gear_ratio * j.encoder_counts) for j in joints]),
            fixed([j.zero_offset for j in joints]),
            fixed([j.direction * j.gear_ratio * j.drive.rated_motor_torque / 1000.0 for j in joints]),
        )

    def select(self, joints: npt.NDArray[np.intp] | slice) -> DriveUnits:
        """Scales of some joints, in the order of the indices given."""
        return DriveUnits(
            fixed(self.radian_per_count[joints]),
            fixed(self.zero_offset[joints]),
            fixed(self.newton_metre_per_mille[joints]),
        )

    def position_from_counts(self, counts: npt.NDArray[np.integer]) -> Array:
        """Joint angles [rad] of 0x6064 or 0x607A."""
        return self.zero_offset + counts * self.radian_per_count

    def counts_from_position(self, position: Array) -> Counts:
        """Nearest counts of joint angles [rad], saturated to 32 bits."""
        counts = np.rint((position - self.zero_offset) / self.radian_per_count)
        return bounded(counts, *_INT32).astype(np.int32)

    def torque_from_per_mille(self, per_mille: npt.NDArray[np.integer]) -> Array:
        """Torques at the joint [N·m] of 0x6071 or 0x6077."""
        return per_mille * self.newton_metre_per_mille

    def per_mille_from_torque(self, torque: Array) -> PerMille:
        """Nearest ‰ of rated torque for torques at the joint [N·m], saturated to 16 bits."""
        per_mille = np.rint(torque / self.newton_metre_per_mille)
        return bounded(per_mille, *_INT16).astype(np.int16)

    def limit_from_per_mille(self, per_mille: npt.NDArray[np.integer]) -> Array:
        """Torque limits at the joint [N·m], of 0x6072: magnitudes, free of direction."""
        limit: Array = np.multiply(per_mille, np.abs(self.newton_metre_per_mille), dtype=np.float64)
        return limit

    def per_mille_from_limit(self, torque_limit: Array) -> PerMilleLimit:
        """0x6072 of torque limits at the joint [N·m], rounded down to ‰ so that a limit is never exceeded."""
        per_mille = np.floor(torque_limit / np.abs(self.newton_metre_per_mille) * (1.0 + 1e-12))
        return bounded(per_mille, *_UINT16).astype(np.uint16)
