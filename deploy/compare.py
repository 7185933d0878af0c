"""The first difference between what a log holds and what a replay makes of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from schemas.base import Model
from schemas.topics import decode, encode

Tolerances = Mapping[str, float]
"""Greatest absolute difference by the name of a field, for all numbers below it; what is not named must be equal."""

CONTROLLER: Final[Tolerances] = {"position": 1e-6, "torque": 5e-2, "torque_limit": 1e-6}
"""Commands [rad, N·m] from the same states. Rounding of 1e-12 rad in the estimates comes out as 1e-11 rad and 1e-6 N·m;
the rest is room for another version of a solver, which stops at another point within its accuracy."""
HAL: Final[Tolerances] = {
    "position_measured": 1e-9, "motor_torque_measured": 1e-6, "position": 1e-6, "torque": 1e-3, "torque_limit": 1e-6,
    "force_in_sensor": 1e-9, "torque_in_sensor": 1e-9,
    "angular_velocity_in_imu": 1e-9, "acceleration_in_imu": 1e-9, "orientation_imu_to_world": 1e-9,
}  # fmt: skip
"""States [rad, N·m, N, rad/s, m/s²] from the same frames: integers times a unit, so rounding alone; what was applied
passed the limits and the holding law in floating point as well."""
PLANT: Final[Tolerances] = {
    "position_measured": 1e-3, "motor_torque_measured": 1.0, "position": 1e-3, "torque": 1e-3, "torque_limit": 1e-6,
    "force_in_sensor": 1.0, "torque_in_sensor": 0.2,
    "angular_velocity_in_imu": 0.02, "acceleration_in_imu": 0.2, "orientation_imu_to_world": 1e-3,
}  # fmt: skip
"""States decoded from a plant that was driven by the logged frames. Rounding moves a reading by one count of its
encoder or sensor at first (6e-6 rad, 0.02 N; the current follows the position loop), and in torque mode, where nothing
but friction brings the two motions together again, farther with time: a millimetre at the hand is allowed."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a replay leaves the log."""

    tick: int
    """Sequence number."""
    field: str
    logged: Any
    replayed: Any

    def __str__(self) -> str:
        return f"tick {self.tick}, {self.field}: logged {self.logged}, replayed {self.replayed}"


def compare(tick: int, name: str, logged: Model, replayed: Model, tolerances: Tolerances | None) -> Difference | None:
    """First field in which two messages differ, in the order of the fields; None when they agree.

    Args:
        tick: sequence number to report.
        name: what the messages are called in the report, e.g. `command`.
        logged: as read from the log.
        replayed: as made again.
        tolerances: None asks for equal bytes.

    """
    data = encode(replayed)
    if encode(logged) == data:
        return None
    again = decode(type(logged), data)
    found = _first(name, "", logged.model_dump(mode="json"), again.model_dump(mode="json"), tolerances or {})
    return None if found is None else Difference(tick, *found)


def _first(path: str, field: str, logged: Any, replayed: Any, allowed: Tolerances) -> tuple[str, Any, Any] | None:
    if isinstance(logged, dict) and isinstance(replayed, dict):
        for key in logged.keys() | replayed.keys() if logged.keys() != replayed.keys() else logged:
            if (found := _first(f"{path}.{key}", key, logged.get(key), replayed.get(key), allowed)) is not None:
                return found
        return None
    if isinstance(logged, list) and isinstance(replayed, list) and len(logged) == len(replayed):
        for index, (one, other) in enumerate(zip(logged, replayed, strict=True)):
            if (found := _first(f"{path}[{index}]", field, one, other, allowed)) is not None:
                return found
        return None
    if isinstance(logged, float) and isinstance(replayed, float):
        if logged == replayed and math.copysign(1.0, logged) == math.copysign(1.0, replayed):
            return None
        return None if abs(logged - replayed) <= allowed.get(field, -1.0) else (path, logged, replayed)
    return None if logged == replayed else (path, logged, replayed)
