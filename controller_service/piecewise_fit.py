"""Δq as a piecewise-linear function of τ, one for each sign of the velocity: [Del Prete 2016] 3.2.

A dead zone in the drive's current makes Δq leap by twice the dead zone over k_p where τ changes sign: a steep line
between two flat ones,

    f(τ) = k_1 τ + q_1 for τ ≤ τ_1,   k_2 τ + q_2 for τ_1 ≤ τ ≤ τ_2,   k_3 τ + q_3 for τ ≥ τ_2.

The lines are fitted to the samples of their segments and the switching points moved to where they intersect, until
these stay. The result is continuous by construction. The function is neither convex nor concave, and the iteration
finds a good fit from a good start only. The paper gave the model up for control (3.2.3): it is a picture of the drive.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from controller_service.model import Array
from controller_service.motor_samples import Fault, IdentificationError, MotorSamples, SampleBounds, check_samples

START: Final = (-0.5, 0.5)
"""First τ_1 and τ_2 [N·m], the paper's; it names no unit, and its other figures of torque are in N·m."""
ITERATIONS: Final = 10
"""The paper's bound."""
SAME: Final = 1e-9
"""Move of a switching point, over the range of τ, that counts for none."""
PARALLEL: Final = 1e-9
"""Difference of two slopes, over the larger, below which their lines do not meet."""
_BOUNDS: Final = SampleBounds(sign_share=0.0)


class PiecewiseStatus(StrEnum):
    """How a piecewise fit ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "its switching points still moving"
    EMPTY_SEGMENT = "a segment without two different torques"
    PARALLEL_LINES = "parallel neighbours"
    CROSSED = "its switching points crossed"


@dataclass(frozen=True, slots=True)
class PiecewiseLines:
    """Three lines that meet at the switching points."""

    slopes: tuple[float, float, float]
    """k_1, k_2, k_3 [rad/(N·m)]."""
    intercepts: tuple[float, float, float]
    """q_1, q_2, q_3 [rad]."""
    switching: tuple[float, float]
    """τ_1 ≤ τ_2 [N·m]."""

    def offset(self, torque: Array) -> Array:
        """Give f(τ) [rad] for torques [N·m] of any shape."""
        segment = np.searchsorted(self.switching, torque)
        offset: Array = np.array(self.slopes)[segment] * torque + np.array(self.intercepts)[segment]
        return offset


@dataclass(frozen=True, slots=True)
class PiecewiseFit:
    """Outcome of the iteration."""

    lines: PiecewiseLines | None
    """Of the last iteration that gave three lines meeting in order; None where the first did not."""
    status: PiecewiseStatus
    iterations: int
    """Begun, the one that failed included."""
    slope_bounded: bool
    """The central slope of `lines` lies at its bound."""
    samples: int
    rms_residual: float
    """√mean (f(τ) − Δq)² [rad] of `lines`; infinite without."""

    @property
    def converged(self) -> bool:
        """The switching points stay."""
        return self.status is PiecewiseStatus.CONVERGED


@dataclass(frozen=True, slots=True)
class PiecewiseModel:
    """f_p and f_n of 3.2.1."""

    positive: PiecewiseFit
    negative: PiecewiseFit
    joint: str = "joint"
    """Its name, for errors."""

    def offset(self, torque: Array, sign: Array | float) -> Array:
        """Give Δq [rad] at τ [N·m] and the velocity's sign; a sign between −1 and 1 mixes both, half and half at 0.

        The paper smooths the sign in control "to avoid discontinuities" (3.2.3).

        Raises:
            IdentificationError: one of the fits has no lines.

        """
        share = 0.5 * (1.0 + np.asarray(sign))
        positive, negative = self._lines(self.positive), self._lines(self.negative)
        offset: Array = share * positive.offset(torque) + (1.0 - share) * negative.offset(torque)
        return offset

    def _lines(self, fit: PiecewiseFit) -> PiecewiseLines:
        if fit.lines is None:
            part = " at positive velocity" if fit is self.positive else " at negative velocity"
            raise IdentificationError(self.joint, Fault.NO_MODEL, fit.iterations, 2, fit.status.value, part)
        return fit.lines


def fit_piecewise(
    offset: Array,
    torque: Array,
    *,
    start: tuple[float, float] = START,
    iterations: int = ITERATIONS,
    slope_bound: float,
    joint: str = "joint",
) -> PiecewiseFit:
    """Fit three lines to samples of one sign of velocity, by the algorithm of 3.2.2.

    A fit that does not converge is no error: `status` says how it ended. A segment has its ends in it; where the two
    lines of a switching point are the same line, any point is their intersection, and they count as parallel.

    Args:
        offset: Δq (m,) [rad].
        torque: τ (m,) [N·m].
        start: first τ_1 < τ_2 [N·m]; within the data, which may need another than the paper's for each joint.
        iterations: bound.
        slope_bound: least central slope k_2 [rad/(N·m)]; −inf for none. Where the line of least squares is flatter its
            slope is the bound, and its intercept the best for that slope.
        joint: its name, for errors.

    Raises:
        IdentificationError: samples few, not finite or without spread; a start out of order; a NaN or +inf bound.

    """
    _check_arguments(joint, start, iterations, slope_bound)
    samples = MotorSamples(offset, torque, np.zeros(np.shape(torque)))
    check_samples(joint, samples, moving=False, bounds=_BOUNDS)
    return _fit(samples, start, iterations, slope_bound)


def fit_both_signs(
    samples: MotorSamples,
    *,
    still_velocity: float,
    slope_bound: float,
    start: tuple[float, float] = START,
    iterations: int = ITERATIONS,
    joint: str = "joint",
) -> PiecewiseModel:
    """Fit f_p to the samples with q̇ > `still_velocity` ≥ 0 [rad/s] and f_n to those with q̇ < −`still_velocity`.

    The paper pushes nearly static joints, and takes all samples (0). The other arguments are those of `fit_piecewise`.

    Raises:
        IdentificationError: see `fit_piecewise`, of each sign; a negative `still_velocity`.

    """
    _check_arguments(joint, start, iterations, slope_bound)
    if not still_velocity >= 0.0:
        raise IdentificationError(joint, Fault.ARGUMENT, still_velocity, 0.0, "still_velocity")
    check_samples(joint, samples, moving=False, bounds=_BOUNDS)
    fits = []
    for sign, name in ((1.0, " at positive velocity"), (-1.0, " at negative velocity")):
        part = samples.where(sign * samples.velocity > still_velocity)
        check_samples(joint, part, moving=False, bounds=_BOUNDS, part=name)
        fits.append(_fit(part, start, iterations, slope_bound))
    return PiecewiseModel(fits[0], fits[1], joint)


def _fit(samples: MotorSamples, start: tuple[float, float], iterations: int, slope_bound: float) -> PiecewiseFit:
    order = np.argsort(samples.torque, kind="stable")
    tau, dq = samples.torque[order], samples.offset[order]
    same = SAME * float(tau[-1] - tau[0])
    lines, bounded, switching = None, False, start
    status, done = PiecewiseStatus.ITERATION_LIMIT, 0
    while done < iterations and status is PiecewiseStatus.ITERATION_LIMIT:
        done += 1
        found = _iterate(tau, dq, switching, slope_bound)
        if isinstance(found, PiecewiseStatus):
            status = found
            break
        if max(abs(found.switching[0] - switching[0]), abs(found.switching[1] - switching[1])) <= same:
            status = PiecewiseStatus.CONVERGED
        lines, switching = found, found.switching
        bounded = found.slopes[1] == slope_bound
    rms = np.inf if lines is None else float(np.sqrt(np.square(lines.offset(tau) - dq).mean()))
    return PiecewiseFit(lines, status, done, bounded, len(tau), rms)


def _iterate(
    tau: Array, dq: Array, switching: tuple[float, float], slope_bound: float
) -> PiecewiseLines | PiecewiseStatus:
    """Give the lines of the three segments of samples in order of τ, and where they meet."""
    first, last = np.searchsorted(tau, switching[0], side="right"), np.searchsorted(tau, switching[1], side="left")
    between = slice(np.searchsorted(tau, switching[0], side="left"), np.searchsorted(tau, switching[1], side="right"))
    one = _line(tau[:first], dq[:first])
    two = _line(tau[between], dq[between], slope_bound)
    three = _line(tau[last:], dq[last:])
    if one is None or two is None or three is None:
        return PiecewiseStatus.EMPTY_SEGMENT
    left, right = _meet(one, two), _meet(two, three)
    if left is None or right is None:
        return PiecewiseStatus.PARALLEL_LINES
    if left > right:
        return PiecewiseStatus.CROSSED
    return PiecewiseLines((one[0], two[0], three[0]), (one[1], two[1], three[1]), (left, right))


def _line(tau: Array, dq: Array, least: float = -np.inf) -> tuple[float, float] | None:
    """Slope and intercept of least squares, the slope at least `least`; None where all τ are the same.

    With the best intercept for each slope the sum of squares is a parabola of the slope, so the bound is the best slope
    where that of least squares is below it.
    """
    if len(tau) < 2 or tau[0] == tau[-1]:
        return None
    mean_tau, mean_dq = float(tau.mean()), float(dq.mean())
    away = tau - mean_tau
    slope = max(float((away * (dq - mean_dq)).sum() / (away * away).sum()), least)
    return slope, mean_dq - slope * mean_tau


def _meet(one: tuple[float, float], two: tuple[float, float]) -> float | None:
    difference = one[0] - two[0]
    if abs(difference) <= PARALLEL * max(abs(one[0]), abs(two[0])):
        return None
    return (two[1] - one[1]) / difference


def _check_arguments(joint: str, start: tuple[float, float], iterations: int, slope_bound: float) -> None:
    if not start[0] < start[1]:
        raise IdentificationError(joint, Fault.ARGUMENT, start[0], start[1], "start τ_1")
    if not slope_bound < np.inf:
        raise IdentificationError(joint, Fault.ARGUMENT, slope_bound, np.inf, "slope_bound")
    if iterations < 1:
        raise IdentificationError(joint, Fault.ARGUMENT, iterations, 1, "iterations")
