"""Series of torque control through the position interface: what was estimated, and the parts of Δq."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from schemas.messages import ControllerTrace

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionSeries:
    """Algorithm 1 of [Del Prete 2016] over K cycles, n joints; all NaN without `controller.position_torque`."""

    delay_s: float
    """How long ago is what each row speaks of; 0 without."""
    position: Array
    """(K, n) [rad]."""
    velocity: Array
    acceleration: Array
    torque: Array
    """(K, n) [N·m] motor torque less friction."""


@dataclass(frozen=True, slots=True)
class OffsetSeries:
    """Parts of Δq over K cycles, each (K, n) [rad]; NaN outside torque control through the position interface."""

    position_desired: Array
    torque_desired: Array
    """[N·m]."""
    torque: Array
    friction: Array
    position: Array
    velocity: Array
    acceleration: Array
    force: Array
    integral: Array


def motion_series(traces: Sequence[ControllerTrace], n: int) -> MotionSeries:
    """Stack the estimates of n joints."""
    every, nothing = [t.estimated for t in traces], (np.nan,) * n

    def stack(name: str) -> Array:
        return rows([nothing if each is None else getattr(each, name) for each in every], n)

    delay_s = next((each.delay_s for each in every if each is not None), 0.0)
    return MotionSeries(delay_s, *(stack(name) for name in ("position", "velocity", "acceleration", "torque")))


def offset_series(traces: Sequence[ControllerTrace], n: int) -> OffsetSeries:
    """Stack the parts of Δq of n joints."""
    every, nothing = [t.offset for t in traces], (np.nan,) * n
    names = [field.name for field in fields(OffsetSeries)]
    return OffsetSeries(*(rows([nothing if o is None else getattr(o, name) for o in every], n) for name in names))


def rows(values: Sequence[tuple[float, ...]], n: int) -> Array:
    """Stack rows of n numbers; (0, n) of none."""
    return np.array(values, np.float64).reshape(len(values), n)
