"""Identification of the linear motor model: what is true is found, the asymmetric fit is the minimum by every way."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller_service.asymmetric_penalty import AsymmetricQp, solve_qp
from controller_service.model import Array
from controller_service.motor_fit import (
    QP_SAMPLES,
    Method,
    MotorFit,
    fit_asymmetric,
    fit_least_squares,
    fit_two_stage,
    over_estimation_table,
)
from controller_service.motor_samples import Fault, IdentificationError, MotorSamples, Regression, SampleBounds

TRUE = np.array([2e-4, 7e-3, 1.5e-3])
STILL = 0.02


def linear(m: int = 1000, noise: float = 0.0, seed: int = 1, coulomb: bool = True) -> MotorSamples:
    generator = np.random.default_rng(seed)
    torque, velocity = generator.uniform(-60.0, 60.0, m), generator.normal(0.0, 1.0, m)
    offset = TRUE[0] * torque + TRUE[1] * velocity + coulomb * TRUE[2] * np.sign(velocity)
    return MotorSamples(offset + noise * generator.standard_normal(m), torque, velocity)


def drive(seed: int = 5) -> MotorSamples:
    """Samples of a drive with a dead zone, whose gain depends on the direction, before a gear that sticks.

    First torques up to 60 N·m on the joint at rest, where friction takes any value that it can; then a sinusoid of
    growing amplitude.
    """
    generator = np.random.default_rng(seed)
    rest, m = 8000, 16000
    time = np.arange(m - rest) * 1e-3
    velocity = np.concatenate([1e-3 * generator.standard_normal(rest), (0.1 + 0.3 * time) * np.cos(7.0 * time)])
    torque = np.concatenate(
        [60.0 * np.sin(np.arange(rest) * 2e-3), 12.0 * np.sin(7.0 * time) + 5.0 * np.sin(1.3 * time)]
    )
    moving = np.abs(velocity) > STILL
    friction = np.where(moving, 6.0 * np.sign(velocity) + 4.0 * velocity, generator.uniform(-8.0, 8.0, m))
    motor = torque + friction
    gain = np.where(velocity > 0.0, 9000.0, 7500.0)
    offset = (motor + 5.0 * np.sign(motor) + 40.0 * velocity) / gain
    return MotorSamples(offset + 2e-5 * generator.standard_normal(m), torque, velocity)


def gains(fit: MotorFit) -> Array:
    return np.array([fit.torque_gain, fit.velocity_gain, fit.coulomb])


def matrix(samples: MotorSamples, coulomb: bool = False) -> Array:
    columns = [samples.torque, samples.velocity, np.sign(samples.velocity)]
    return np.column_stack(columns[: 2 + coulomb])


def residual(samples: MotorSamples, x: Array) -> Array:
    """ā x − b̄ of (8), as the paper builds it: rows of negative Δq negated."""
    A, b = matrix(samples, len(x) == 3), samples.offset
    sign = np.where(b < 0.0, -1.0, 1.0)
    return (A * sign[:, np.newaxis]) @ x - b * sign


def penalty(samples: MotorSamples, x: Array, weight: float) -> float:
    r = residual(samples, x)
    return float(np.where(r > 0.0, weight, 1.0) @ r**2)


def reweighted(samples: MotorSamples, weight: float, coulomb: bool = False) -> Array:
    """Iteratively reweighted least squares by orthogonal factors."""
    A = matrix(samples, coulomb)
    x = np.zeros(A.shape[1])
    for _ in range(100):
        root = np.sqrt(np.where(residual(samples, x) > 0.0, weight, 1.0))
        x = np.linalg.lstsq(A * root[:, np.newaxis], samples.offset * root)[0]
    return x


@pytest.mark.parametrize("fit", [fit_least_squares, fit_asymmetric])
def test_exact_data_give_the_true_gains(fit: Callable[..., MotorFit]) -> None:
    found = fit(linear(), coulomb=True)
    assert gains(found) == pytest.approx(TRUE, rel=1e-11)
    assert found.converged
    assert found.statistics.rms_residual < 1e-15
    assert found.statistics.r_squared == pytest.approx(1.0, abs=1e-12)
    assert gains(fit(linear(coulomb=False))) == pytest.approx([*TRUE[:2], 0.0], rel=1e-11)


def test_noise_moves_the_gains_by_their_standard_errors() -> None:
    deviations = []
    for seed in range(200):
        fit = fit_least_squares(linear(300, noise=2e-3, seed=seed), coulomb=True)
        assert fit.standard_errors is not None
        deviations.append((gains(fit) - TRUE) / fit.standard_errors)
    assert np.abs(deviations).max() < 4.5
    assert np.mean(deviations, axis=0) == pytest.approx([0.0] * 3, abs=4.0 / math.sqrt(200))
    assert np.std(deviations, axis=0) == pytest.approx([1.0] * 3, abs=0.2)


def test_least_squares_is_the_pseudo_inverse() -> None:
    data = drive()
    expected = np.linalg.pinv(matrix(data, True)) @ data.offset
    assert gains(fit_least_squares(data, coulomb=True)) == pytest.approx(expected, rel=1e-10)


def test_equal_weights_are_least_squares() -> None:
    data = drive()
    symmetric = fit_asymmetric(data, weight=1.0, coulomb=True)
    assert gains(symmetric) == pytest.approx(gains(fit_least_squares(data, coulomb=True)), rel=1e-12)


@pytest.mark.parametrize("coulomb", [False, True])
@pytest.mark.parametrize("weight", [2.0, 100.0, 1e5])
def test_the_fit_is_the_minimum(weight: float, coulomb: bool) -> None:
    data = drive()
    fit = fit_asymmetric(data, weight=weight, coulomb=coulomb)
    assert fit.converged
    assert fit.iterations < 20
    x = gains(fit)[: 2 + coulomb]
    least = penalty(data, x, weight)
    for index in range(len(x)):
        for step in (1e-4, -1e-4):
            moved = x.copy()
            moved[index] *= 1.0 + step
            assert penalty(data, moved, weight) > least
        # A central difference of a C¹ piecewise quadratic; its scale is the curvature times the gain
        ahead, behind = x.copy(), x.copy()
        ahead[index] *= 1.0 + 1e-6
        behind[index] *= 1.0 - 1e-6
        slope = (penalty(data, ahead, weight) - penalty(data, behind, weight)) / 2e-6
        assert abs(slope) < 1e-6 * least


def test_derivatives_are_those_of_the_penalty_and_its_curvature_is_not_negative() -> None:
    data, weight = drive(), 100.0
    problem = Regression(data, coulomb=True)
    x = np.array([1.5e-4, 5e-3, 1e-3])
    sums = problem.penalty(x, weight, problem.gram())
    assert sums.cost == pytest.approx(penalty(data, x, weight), rel=1e-12)
    assert np.array_equal(sums.over, residual(data, x) > 0.0)
    for index, step in enumerate((1e-9, 1e-7, 1e-7)):
        ahead, behind = x.copy(), x.copy()
        ahead[index] += step
        behind[index] -= step
        slope = (penalty(data, ahead, weight) - penalty(data, behind, weight)) / (2.0 * step)
        assert 2.0 * sums.gradient[index] == pytest.approx(slope, rel=1e-5)
    assert np.linalg.eigvalsh(sums.weighted[:3, :3]).min() > 0.0


@pytest.mark.parametrize("coulomb", [False, True])
def test_newton_reweighting_and_the_qp_agree(coulomb: bool) -> None:
    data = drive().thinned(1000)
    newton = fit_asymmetric(data, coulomb=coulomb)
    qp = fit_asymmetric(data, coulomb=coulomb, method="qp")
    assert newton.converged
    assert qp.converged
    assert (newton.method, qp.method) == (Method.NEWTON, Method.QP)
    assert gains(qp) == pytest.approx(gains(newton), rel=1e-6)
    assert gains(newton)[: 2 + coulomb] == pytest.approx(reweighted(data, 100.0, coulomb), rel=1e-9)


def optimality(data: MotorSamples, solution: AsymmetricQp, weight: float) -> Array:
    """Largest violations of the conditions of Karush, Kuhn and Tucker of (9), over their scales."""
    r = residual(data, solution.gains)
    over, under, scale = solution.over, solution.under, float(np.abs(data.offset).max())
    above, below, over_sign, under_sign = solution.multipliers
    A = matrix(data, len(solution.gains) == 3)
    signed = A * np.where(data.offset < 0.0, -1.0, 1.0)[:, np.newaxis]
    slack = np.array([over - r, under + r, over, under])
    return np.array(
        [
            np.abs(2.0 * weight * over - above - over_sign).max() / (weight * scale),
            np.abs(2.0 * under - below - under_sign).max() / scale,
            np.abs(signed.T @ (above - below)).max() / (np.abs(A).max() * np.abs(above).sum()),
            -slack.min() / scale,
            -solution.multipliers.min() / (weight * scale),
            np.abs(slack * solution.multipliers).max() / (weight * scale**2),
        ]
    )


def test_the_qp_meets_its_conditions_and_over_and_under_estimates_exclude_each_other() -> None:
    data = drive().thinned(1000)
    solution = solve_qp(Regression(data), 100.0)
    assert solution.solved
    assert optimality(data, solution, 100.0).max() < 1e-8
    r = residual(data, solution.gains)
    size = float(np.abs(data.offset).max())
    assert solution.over == pytest.approx(np.maximum(r, 0.0), abs=1e-8 * size)
    assert solution.under == pytest.approx(np.maximum(-r, 0.0), abs=1e-8 * size)
    assert abs(solution.over @ solution.under) < 1e-10 * size**2


def test_the_qp_refuses_what_is_too_large_for_it() -> None:
    with pytest.raises(IdentificationError, match="method newton") as caught:
        fit_asymmetric(linear(QP_SAMPLES + 1), method="qp", joint="knee")
    assert (caught.value.joint, caught.value.reason) == ("knee", Fault.TOO_MANY)
    assert (caught.value.value, caught.value.bound) == (QP_SAMPLES + 1, QP_SAMPLES)


def test_a_target_at_the_angle_is_over_estimated_by_any_torque_in_both_forms() -> None:
    data = drive().thinned(400)
    offset = data.offset.copy()
    offset[::5] = 0.0
    zeros = MotorSamples(offset, data.torque, data.velocity)
    newton, qp = fit_asymmetric(zeros), fit_asymmetric(zeros, method="qp")
    assert gains(qp) == pytest.approx(gains(newton), rel=1e-6)
    r = newton.over_estimation(zeros)
    assert np.array_equal(r[::5], np.abs(newton.offset(zeros.torque, zeros.velocity)[::5]))
    assert gains(fit_asymmetric(mirrored(zeros))) == pytest.approx(gains(newton), rel=1e-12)


def mirrored(samples: MotorSamples) -> MotorSamples:
    return MotorSamples(-samples.offset, -samples.torque, -samples.velocity)


def test_a_mirrored_joint_has_the_same_gains() -> None:
    data = drive()
    for fit in (fit_least_squares, fit_asymmetric):
        assert gains(fit(mirrored(data), coulomb=True)) == pytest.approx(gains(fit(data, coulomb=True)), rel=1e-12)


def test_units_scale_the_gains() -> None:
    data = drive()
    scaled = MotorSamples(1e3 * data.offset, 1e-2 * data.torque, 50.0 * data.velocity)
    expected = gains(fit_asymmetric(data, coulomb=True)) * np.array([1e5, 20.0, 1e3])
    assert gains(fit_asymmetric(scaled, coulomb=True)) == pytest.approx(expected, rel=1e-10)


def test_the_order_of_samples_does_not_matter_and_a_repeated_fit_is_equal_to_the_bit() -> None:
    data = drive()
    shuffled = data.where(np.random.default_rng(0).permutation(len(data)))
    assert gains(fit_asymmetric(shuffled)) == pytest.approx(gains(fit_asymmetric(data)), rel=1e-11)
    assert fit_asymmetric(data) == fit_asymmetric(data)


def test_a_larger_weight_over_estimates_less() -> None:
    """The sum of squared over-estimates cannot rise with w, as at any minimum of w P + N; here the rate falls too."""
    data = drive()
    fits = over_estimation_table(data)
    assert [fit.weight for fit in fits] == [1.0, 10.0, 100.0, 1e3, 1e4]
    assert all(fit.converged for fit in fits)
    squares = [float(np.square(np.maximum(fit.over_estimation(data), 0.0)).sum()) for fit in fits]
    rates = [fit.statistics.over_estimation_rate for fit in fits]
    largest = [fit.statistics.largest_over_estimation for fit in fits]
    rms = [fit.statistics.rms_residual for fit in fits]
    assert squares == sorted(squares, reverse=True)
    assert rates == sorted(rates, reverse=True)
    assert largest == sorted(largest, reverse=True)
    assert rms == sorted(rms)
    assert rates[-1] < 0.1 * rates[0]


def test_a_real_drive_is_almost_never_over_estimated() -> None:
    """Fig. 3: the symmetric penalty over-estimates much of the motion, w = 100 at most a tenth."""
    data = drive()
    symmetric, asymmetric = fit_least_squares(data), fit_asymmetric(data)
    assert symmetric.statistics.over_estimation_rate > 0.3
    assert asymmetric.statistics.over_estimation_rate <= 0.1
    assert 0.0 < asymmetric.torque_gain < symmetric.torque_gain
    assert asymmetric.velocity_gain > 0.0


def test_statistics_are_those_of_the_residual() -> None:
    data = drive()
    fit = fit_asymmetric(data, weight=10.0)
    r = residual(data, gains(fit)[:2])
    over, span = np.maximum(r, 0.0), np.abs(data.offset).max()
    assert fit.over_estimation(data) == pytest.approx(r, abs=1e-15)
    found = fit.statistics
    assert found.rms_residual == pytest.approx(math.sqrt(np.mean(r**2)))
    assert found.over_estimation_rate == np.mean(r > 0.0)
    assert found.largest_over_estimation == pytest.approx(over.max())
    assert found.over_estimation_95 == pytest.approx(np.percentile(over, 95.0))
    assert found.largest_over_estimation_relative == pytest.approx(over.max() / span)
    assert found.over_estimation_95_relative == pytest.approx(np.percentile(over, 95.0) / span)
    assert found.r_squared == pytest.approx(1.0 - np.sum(r**2) / np.sum(data.offset**2))
    assert fit.samples == len(data)


def test_too_few_iterations_are_told() -> None:
    data = drive()
    fit = fit_asymmetric(data, weight=1e5, iterations=1)
    assert (fit.iterations, fit.converged) == (1, False)
    assert fit.gradient_residual > 1e-9
    assert penalty(data, gains(fit)[:2], 1e5) < penalty(data, gains(fit_least_squares(data))[:2], 1e5)


def test_two_stages_find_the_true_gains() -> None:
    data = linear(2000)
    velocity = np.where(np.arange(2000) < 800, 0.0, data.velocity + STILL * np.sign(data.velocity))
    offset = TRUE[0] * data.torque + TRUE[1] * velocity + TRUE[2] * np.sign(velocity)
    fit = fit_two_stage(MotorSamples(offset, data.torque, velocity), still_velocity=STILL, coulomb=True)
    assert gains(fit) == pytest.approx(TRUE, rel=1e-11)
    assert fit.method == Method.TWO_STAGE
    assert fit.converged


def test_each_stage_is_the_minimum_over_its_samples_and_gains() -> None:
    data = drive()
    fit = fit_two_stage(data, still_velocity=STILL)
    still = np.abs(data.velocity) < STILL
    at_rest, moving = data.where(still), data.where(~still)
    for part, index in ((at_rest, 0), (moving, 1)):
        x = gains(fit)[:2] * (1.0, 0.0 if index == 0 else 1.0)
        least = penalty(part, x, 100.0)
        for factor in (1.0 - 1e-4, 1.0 + 1e-4):
            moved = x.copy()
            moved[index] *= factor
            assert penalty(part, moved, 100.0) > least
    assert fit.converged
    assert fit.statistics.over_estimation_rate <= 0.1


def test_two_stages_keep_the_torque_gain_from_what_the_motion_does_to_it() -> None:
    """3.3.1: friction that is no part of the model, and goes with the torque, spoils k_τ of a fit in one."""
    data = linear(4000, noise=1e-4, coulomb=False)
    velocity = np.where(np.arange(4000) < 2000, 1e-3 * data.velocity, data.velocity)
    drag = 4e-3 * np.tanh(data.torque / 20.0) * (np.abs(velocity) > STILL)
    spoilt = MotorSamples(TRUE[0] * data.torque + TRUE[1] * velocity + drag, data.torque, velocity)
    together = fit_asymmetric(spoilt, weight=1.0)
    apart = fit_two_stage(spoilt, still_velocity=STILL, weight=1.0)
    assert abs(apart.torque_gain / TRUE[0] - 1.0) < 0.01 < abs(together.torque_gain / TRUE[0] - 1.0)


def test_a_stage_without_samples_is_refused_by_its_name() -> None:
    data = linear(2000)
    with pytest.raises(IdentificationError, match=r"^knee at rest: 0 samples") as caught:
        fit_two_stage(
            MotorSamples(data.offset, data.torque, np.sign(data.velocity)), still_velocity=STILL, joint="knee"
        )
    assert (caught.value.joint, caught.value.reason) == ("knee", Fault.TOO_FEW)
    with pytest.raises(IdentificationError, match=r"^knee in motion: 0 samples"):
        fit_two_stage(data, still_velocity=10.0, joint="knee")
    with pytest.raises(IdentificationError, match=r"^knee: the velocity has 5 samples"):
        fit_two_stage(MotorSamples(data.offset, data.torque, data.velocity[:5]), still_velocity=STILL, joint="knee")


@pytest.mark.parametrize("weight", [0.99, 0.0, -1.0, math.nan, math.inf])
def test_a_weight_below_one_is_refused(weight: float) -> None:
    for fit in (fit_asymmetric, lambda data, **more: fit_two_stage(data, still_velocity=STILL, **more)):
        with pytest.raises(IdentificationError, match=r"knee: weight") as caught:
            fit(linear(), weight=weight, joint="knee")
        assert caught.value.reason == Fault.ARGUMENT


@pytest.mark.parametrize("velocity", [0.0, -0.1, math.nan])
def test_a_threshold_of_rest_that_is_not_positive_is_refused(velocity: float) -> None:
    with pytest.raises(IdentificationError, match="still_velocity"):
        fit_two_stage(linear(), still_velocity=velocity)


def test_fits_refuse_bad_samples_by_the_bounds_they_are_given() -> None:
    data = linear()
    for fit in (fit_least_squares, fit_asymmetric):
        with pytest.raises(IdentificationError) as caught:
            fit(data, joint="knee", bounds=SampleBounds(torque_range=1e4))
        assert (caught.value.joint, caught.value.reason) == ("knee", Fault.TORQUE_SPREAD)
        with pytest.raises(IdentificationError) as caught:
            fit(MotorSamples(data.offset, data.torque, 0.1 * data.torque), joint="knee")
        assert caught.value.reason == Fault.COLLINEAR


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    m=st.integers(50, 90),
    weight=st.floats(1.0, 1e8),
    coulomb=st.booleans(),
    tail=st.sampled_from([0.7, 1.0, 3.0]),
)
def test_newton_reaches_the_minimum_of_any_data(seed: int, m: int, weight: float, coulomb: bool, tail: float) -> None:
    """Data that no model fits, with heavy tails: the gradient vanishes, and no solution by other means is lower."""
    generator = np.random.default_rng(seed)
    torque, velocity, offset = generator.standard_t(tail, (3, m))
    data = MotorSamples(offset, torque, velocity)
    bounds = SampleBounds(sign_share=0.0, condition=1e6)
    fit = fit_asymmetric(data, weight=weight, coulomb=coulomb, bounds=bounds)
    assert fit.converged
    assert fit.gradient_residual < 1e-9
    least = penalty(data, gains(fit)[: 2 + coulomb], weight)
    assert least <= penalty(data, reweighted(data, weight, coulomb), weight) * (1.0 + 1e-9)
