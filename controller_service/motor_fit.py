"""Gains of one joint's motor model from samples: [Del Prete 2016] (6) to (9) and the two stages of 3.3.1.

Drive and gear do not obey the linear model exactly. A gain that asks for more Δq than the joint needs makes torque
control unstable without any feedback; one that asks for less only leaves work to the feedback. So over-estimation of
|Δq| weighs w times as much as under-estimation: with s = sign(Δq), ā = s a, b̄ = s Δq = |Δq|,

    min Σ Φ(r),   r = ā x − b̄,   Φ(r) = w r² for r > 0, else r².                                            (8)

A sample with Δq = 0, of which the paper does not speak, is over-estimated by any model torque: r = |a x|, weight w.
Gains are not bounded: one that comes out negative says that data or signs are wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

import numpy as np

from controller_service.asymmetric_penalty import Minimum, minimise, solve_qp
from controller_service.model import Array
from controller_service.motor_samples import (
    DEFAULT_BOUNDS,
    Fault,
    IdentificationError,
    MotorSamples,
    Regression,
    SampleBounds,
    check_samples,
    sign_beyond,
)

GRADIENT_TOLERANCE: Final = 1e-9
"""Of `MotorFit.gradient_residual`, for `converged`."""
QP_SAMPLES: Final = 10_000
"""Most samples of the QP, whose variables and rows grow with them."""


class Method(StrEnum):
    """How a fit was made."""

    LEAST_SQUARES = "least squares"
    NEWTON = "newton"
    QP = "qp"
    TWO_STAGE = "two-stage"


@dataclass(frozen=True, slots=True)
class FitStatistics:
    """How a model meets the samples it was fitted to; r as in (8), positive where the model over-estimates |Δq|."""

    rms_residual: float
    """√mean r² [rad]."""
    over_estimation_rate: float
    """Share of samples with r > 0."""
    largest_over_estimation: float
    """Largest r [rad], 0 where none is positive."""
    over_estimation_95: float
    """95th percentile of max(r, 0) over all samples [rad]."""
    largest_over_estimation_relative: float
    over_estimation_95_relative: float
    """As above, over the largest |Δq|."""
    r_squared: float
    """1 − Σ r²/Σ Δq²: not about the mean, as the model has no constant."""


@dataclass(frozen=True, slots=True)
class MotorFit:
    """Identified gains of (6) and how they were found."""

    torque_gain: float
    """k_τ [rad/(N·m)]."""
    velocity_gain: float
    """k_v [s]."""
    coulomb: float
    """k_c [rad]; 0 where it was not fitted."""
    sign_velocity: float
    """|q̇| [rad/s] below which sign(q̇) was taken for 0."""
    method: Method
    weight: float
    """w; 1 for least squares."""
    samples: int
    iterations: int
    """Of Newton's method (both stages together) or of the QP's solver."""
    converged: bool
    gradient_residual: float
    """Largest |Σ φ'(r_i) a_ij| over its bound by Cauchy, ‖√W a_j‖ ‖√W b‖, of the gains fitted: 0 at the optimum."""
    statistics: FitStatistics
    standard_errors: tuple[float, ...] | None = None
    """Of k_τ, k_v (and k_c) by (7), σ̂ √diag (AᵀA)⁻¹, for errors independent between samples; else None."""

    def offset(self, torque: Array, velocity: Array) -> Array:
        """Give the model's Δq [rad] at τ [N·m] and q̇ [rad/s], by (6)."""
        gains = (self.torque_gain, self.velocity_gain, self.coulomb)
        return _model(gains, self.sign_velocity, torque, velocity)

    def over_estimation(self, samples: MotorSamples) -> Array:
        """Give r (m,) [rad] of any samples, see `FitStatistics`: abscissa of Fig. 3, right."""
        return _over_estimation(self.offset(samples.torque, samples.velocity), samples.offset)


def fit_least_squares(
    samples: MotorSamples,
    *,
    coulomb: bool = False,
    sign_velocity: float = 0.0,
    joint: str = "joint",
    bounds: SampleBounds = DEFAULT_BOUNDS,
) -> MotorFit:
    """Least squares, (7).

    Args:
        samples: of one joint.
        coulomb: fit k_c too.
        sign_velocity: |q̇| [rad/s] below which sign(q̇) is taken for 0.
        joint: its name, for errors.
        bounds: what is asked of the samples.

    Raises:
        IdentificationError: see `check_samples`.

    """
    check_samples(joint, samples, coulomb=coulomb, sign_velocity=sign_velocity, bounds=bounds)
    problem = Regression(samples, coulomb, sign_velocity)
    k = problem.unknowns
    minimum = minimise(problem, 1.0, range(k), np.zeros(k), 1)
    variance = minimum.cost / (len(samples) - k)
    errors = np.sqrt(variance * np.linalg.inv(problem.gram()[:k, :k]).diagonal())
    return _fit(problem, minimum, Method.LEAST_SQUARES, 1.0, tuple(errors.tolist()))


def fit_asymmetric(
    samples: MotorSamples,
    *,
    weight: float = 100.0,
    coulomb: bool = False,
    sign_velocity: float = 0.0,
    method: Literal["newton", "qp"] = "newton",
    iterations: int = 50,
    joint: str = "joint",
    bounds: SampleBounds = DEFAULT_BOUNDS,
) -> MotorFit:
    """Least squares with the asymmetric penalty of w = `weight` ≥ 1: (8) by Newton's method, or (9) by OSQP.

    Both give the one minimum. Newton's method takes any number of samples and mostly 5 to 10 of its `iterations`. The
    QP is the paper's other form, for at most `QP_SAMPLES`; its solver ends after `QP_ITERATIONS`. The other arguments
    are those of `fit_least_squares`.

    Raises:
        IdentificationError: see `check_samples`; w < 1; too many samples for the QP.

    """
    _check_weight(joint, weight)
    check_samples(joint, samples, coulomb=coulomb, sign_velocity=sign_velocity, bounds=bounds)
    problem = Regression(samples, coulomb, sign_velocity)
    k = problem.unknowns
    if method == "newton":
        return _fit(problem, minimise(problem, weight, range(k), np.zeros(k), iterations), Method.NEWTON, weight)
    if len(samples) > QP_SAMPLES:
        raise IdentificationError(joint, Fault.TOO_MANY, len(samples), QP_SAMPLES)
    solution = solve_qp(problem, weight)
    sums = problem.penalty(solution.gains, weight, problem.gram())
    minimum = Minimum(solution.gains, solution.iterations, sums.cost, sums.residual(np.arange(k)))
    return _fit(problem, minimum, Method.QP, weight)


def fit_two_stage(
    samples: MotorSamples,
    *,
    still_velocity: float,
    weight: float = 100.0,
    coulomb: bool = False,
    iterations: int = 50,
    joint: str = "joint",
    bounds: SampleBounds = DEFAULT_BOUNDS,
) -> MotorFit:
    """Fit k_τ to the samples at rest, then k_v (and k_c) to the others with that k_τ, both by (8): 3.3.1.

    Where a joint moves most of Δq is friction, which leaves k_τ poorly determined. A joint rests where |q̇| is below
    `still_velocity` [rad/s]. The other arguments are those of `fit_asymmetric`; the bounds hold for each stage.

    Raises:
        IdentificationError: see `check_samples`, of each stage; w < 1; `still_velocity` not positive.

    """
    _check_weight(joint, weight)
    if not still_velocity > 0.0:
        raise IdentificationError(joint, Fault.ARGUMENT, still_velocity, 0.0, "still_velocity")
    check_samples(joint, samples, moving=False, bounds=bounds)
    still = np.abs(samples.velocity) < still_velocity
    resting, moving = samples.where(still), samples.where(~still)
    check_samples(joint, resting, moving=False, bounds=bounds, part=" at rest")
    check_samples(joint, moving, coulomb=coulomb, sign_velocity=still_velocity, bounds=bounds, part=" in motion")
    whole = Regression(samples, coulomb, still_velocity)
    k = whole.unknowns
    first = minimise(Regression(resting), weight, (0,), np.zeros(2), iterations)
    start = np.zeros(k)
    start[0] = first.gains[0]
    second = minimise(Regression(moving, coulomb, still_velocity), weight, range(1, k), start, iterations)
    residual = max(first.gradient_residual, second.gradient_residual)
    minimum = Minimum(second.gains, first.iterations + second.iterations, first.cost + second.cost, residual)
    return _fit(whole, minimum, Method.TWO_STAGE, weight)


def over_estimation_table(
    samples: MotorSamples,
    weights: Sequence[float] = (1.0, 10.0, 100.0, 1e3, 1e4),
    *,
    coulomb: bool = False,
    sign_velocity: float = 0.0,
    joint: str = "joint",
) -> tuple[MotorFit, ...]:
    """Give a fit (8) for each w, to choose one by what it over-estimates and what it costs in the residual."""
    return tuple(
        fit_asymmetric(samples, weight=weight, coulomb=coulomb, sign_velocity=sign_velocity, joint=joint)
        for weight in weights
    )


def _fit(
    problem: Regression, minimum: Minimum, method: Method, weight: float, errors: tuple[float, ...] | None = None
) -> MotorFit:
    samples = problem.samples
    torque_gain, velocity_gain, coulomb = gains = (*minimum.gains.tolist(), 0.0)[:3]
    model = _model(gains, problem.sign_velocity, samples.torque, samples.velocity)
    residual = _over_estimation(model, samples.offset)
    square, m = float(np.square(residual).sum()), len(samples)
    over = np.maximum(residual, 0.0)
    largest, common, span = float(over.max()), float(np.quantile(over, 0.95)), float(np.abs(samples.offset).max())
    statistics = FitStatistics(
        rms_residual=float(np.sqrt(square / m)),
        over_estimation_rate=int(np.count_nonzero(over)) / m,
        largest_over_estimation=largest,
        over_estimation_95=common,
        largest_over_estimation_relative=largest / span,
        over_estimation_95_relative=common / span,
        r_squared=1.0 - square / float(np.square(samples.offset).sum()),
    )
    return MotorFit(
        torque_gain,
        velocity_gain,
        coulomb,
        sign_velocity=problem.sign_velocity,
        method=method,
        weight=weight,
        samples=m,
        iterations=minimum.iterations,
        converged=minimum.gradient_residual <= GRADIENT_TOLERANCE,
        gradient_residual=minimum.gradient_residual,
        statistics=statistics,
        standard_errors=errors,
    )


def _model(gains: Sequence[float], sign_velocity: float, torque: Array, velocity: Array) -> Array:
    offset = gains[0] * torque + gains[1] * velocity
    if gains[2] != 0.0:
        offset += gains[2] * sign_beyond(velocity, sign_velocity)
    return offset


def _over_estimation(model: Array, offset: Array) -> Array:
    """Give r = sign(Δq) (a x − Δq), |a x| where Δq = 0."""
    error = model - offset
    return np.where(offset == 0.0, np.abs(error), error * np.sign(offset))


def _check_weight(joint: str, weight: float) -> None:
    if not 1.0 <= weight < np.inf:
        raise IdentificationError(joint, Fault.ARGUMENT, weight, 1.0, "weight")
