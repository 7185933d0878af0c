"""Three lines for a drive with a dead zone: what is true is found from the paper's start, what fails says how."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller_service.model import Array
from controller_service.motor_samples import Fault, IdentificationError, MotorSamples
from controller_service.piecewise_fit import (
    PiecewiseFit,
    PiecewiseLines,
    PiecewiseModel,
    PiecewiseStatus,
    fit_both_signs,
    fit_piecewise,
)

BOUND = 1e-3


def lines(
    switching: tuple[float, float] = (-1.5, 2.0),
    slopes: tuple[float, float, float] = (2e-4, 5e-3, 3e-4),
    middle: float = 2e-4,
) -> PiecewiseLines:
    """Three lines that meet at the switching points."""
    outer = [middle + (slopes[1] - slopes[i]) * at for i, at in ((0, switching[0]), (2, switching[1]))]
    return PiecewiseLines(slopes, (outer[0], middle, outer[1]), switching)


def torques(m: int = 2000, seed: int = 2) -> Array:
    return np.random.default_rng(seed).uniform(-40.0, 40.0, m)


def found(fit: PiecewiseFit) -> PiecewiseLines:
    assert fit.lines is not None
    return fit.lines


@pytest.mark.parametrize("switching", [(-1.5, 2.0), (-0.3, 0.4), (-5.0, 6.0), (0.1, 3.0)])
def test_the_true_lines_are_found_from_the_papers_start(switching: tuple[float, float]) -> None:
    true, torque = lines(switching), torques()
    fit = fit_piecewise(true.offset(torque), torque, slope_bound=BOUND)
    assert fit.status is PiecewiseStatus.CONVERGED
    assert fit.converged
    assert fit.iterations <= 10
    assert found(fit).switching == pytest.approx(switching, rel=1e-9)
    assert found(fit).slopes == pytest.approx(true.slopes, rel=1e-9)
    assert found(fit).intercepts == pytest.approx(true.intercepts, rel=1e-9)
    assert not fit.slope_bounded
    assert fit.rms_residual < 1e-12


def test_noise_moves_the_lines_little() -> None:
    true, torque = lines(), torques(20000)
    noise = 2e-4 * np.random.default_rng(0).standard_normal(len(torque))
    fit = fit_piecewise(true.offset(torque) + noise, torque, slope_bound=BOUND, iterations=30)
    assert fit.converged
    assert found(fit).switching == pytest.approx(true.switching, abs=0.02)
    assert found(fit).slopes == pytest.approx(true.slopes, rel=0.03)
    assert fit.rms_residual == pytest.approx(2e-4, rel=0.03)


def test_a_converged_fit_is_the_fit_of_its_own_segments() -> None:
    torque = torques(20000)
    offset = lines().offset(torque) + 2e-4 * np.random.default_rng(0).standard_normal(len(torque))
    fit = fit_piecewise(offset, torque, slope_bound=BOUND, iterations=30)
    low, high = found(fit).switching
    for index, chosen in enumerate((torque <= low, (low <= torque) & (torque <= high), torque >= high)):
        slope, intercept = np.polyfit(torque[chosen], offset[chosen], 1)
        assert found(fit).slopes[index] == pytest.approx(slope, rel=1e-7)
        assert found(fit).intercepts[index] == pytest.approx(intercept, rel=1e-7)


def test_the_dead_zone_of_a_drive_is_the_steep_line() -> None:
    """Δq = D⁻¹(τ)/k_p leaps by 2 d/k_p at τ = 0; the outer lines have the slope 1/k_p and are 2 d/k_p apart."""
    position_gain, dead_zone = 8000.0, 5.0
    generator = np.random.default_rng(4)
    torque = generator.uniform(-20.0, 20.0, 20000)
    # The torque is an estimate, with an error: it makes the leap a slope
    motor = torque + 0.3 * generator.standard_normal(20000)
    offset = (motor + dead_zone * np.sign(motor)) / position_gain
    fit = fit_piecewise(offset, torque, slope_bound=BOUND, iterations=30)
    assert fit.converged
    slopes, intercepts = found(fit).slopes, found(fit).intercepts
    assert slopes[0] == pytest.approx(1.0 / position_gain, rel=0.02)
    assert slopes[2] == pytest.approx(1.0 / position_gain, rel=0.02)
    assert slopes[1] > 5.0 / position_gain
    assert intercepts[2] - intercepts[0] == pytest.approx(2.0 * dead_zone / position_gain, rel=0.02)


def test_the_central_slope_keeps_its_bound_with_the_best_intercept() -> None:
    torque = torques()
    offset = lines().offset(torque)
    start = (-3.0, 3.0)
    fit = fit_piecewise(offset, torque, start=start, iterations=1, slope_bound=8e-3)
    assert fit.slope_bounded
    assert found(fit).slopes[1] == 8e-3
    chosen = np.abs(torque) <= 3.0
    assert found(fit).intercepts[1] == pytest.approx(np.mean(offset[chosen] - 8e-3 * torque[chosen]), rel=1e-9)
    free = fit_piecewise(offset, torque, start=start, iterations=1, slope_bound=-math.inf)
    assert not free.slope_bounded
    assert found(free).slopes[1] == pytest.approx(np.polyfit(torque[chosen], offset[chosen], 1)[0], rel=1e-9)


def test_a_sample_at_a_switching_point_belongs_to_both_of_its_segments() -> None:
    torque = np.linspace(-5.0, 5.0, 101).round(1)
    offset = lines().offset(torque) + 1e-4 * np.random.default_rng(0).standard_normal(101)
    fit = fit_piecewise(offset, torque, start=(-1.0, 1.0), iterations=1, slope_bound=-math.inf)
    for index, chosen in enumerate((torque <= -1.0, np.abs(torque) <= 1.0, torque >= 1.0)):
        assert found(fit).slopes[index] == pytest.approx(np.polyfit(torque[chosen], offset[chosen], 1)[0], rel=1e-9)


def test_an_iteration_that_does_not_end_is_told_with_its_last_lines() -> None:
    torque = torques()
    offset = lines((-5.0, 6.0)).offset(torque)
    fit = fit_piecewise(offset, torque, slope_bound=BOUND, iterations=2)
    assert fit.status is PiecewiseStatus.ITERATION_LIMIT
    assert not fit.converged
    assert fit.iterations == 2
    assert fit.rms_residual == pytest.approx(math.sqrt(np.mean((found(fit).offset(torque) - offset) ** 2)))
    again = fit_piecewise(offset, torque, start=found(fit).switching, slope_bound=BOUND)
    assert again.converged


def test_a_segment_without_samples_is_told() -> None:
    torque = torques()
    away = torque[np.abs(torque) > 1.0]
    fit = fit_piecewise(lines().offset(away), away, slope_bound=BOUND)
    assert fit == PiecewiseFit(None, PiecewiseStatus.EMPTY_SEGMENT, 1, False, len(away), math.inf)
    one_sided = fit_piecewise(lines().offset(torque), torque, start=(-50.0, 0.5), slope_bound=BOUND)
    assert one_sided.status is PiecewiseStatus.EMPTY_SEGMENT
    same = np.where(np.abs(torque) < 5.0, 0.25, torque)
    assert fit_piecewise(lines().offset(same), same, slope_bound=BOUND).status is PiecewiseStatus.EMPTY_SEGMENT


def test_lines_that_do_not_meet_are_told() -> None:
    torque = torques()
    fit = fit_piecewise(2e-4 * torque, torque, slope_bound=-math.inf)
    assert fit.status is PiecewiseStatus.PARALLEL_LINES
    assert fit.lines is None


def test_switching_points_that_cross_are_told_and_the_last_good_lines_are_kept() -> None:
    torque = torques()
    leap = 1e-3 * np.where(torque > 0.0, -1.0, 1.0) + 2e-4 * torque
    fit = fit_piecewise(leap, torque, slope_bound=BOUND)
    assert fit.status is PiecewiseStatus.CROSSED
    assert fit.lines is None
    # One line and noise: the first iteration gives lines in order, the second crosses
    generator = np.random.default_rng(8)
    torque = generator.uniform(-3.0, 3.0, 200)
    offset = 2e-4 * torque + 1e-3 * generator.standard_normal(200)
    late = fit_piecewise(offset, torque, slope_bound=0.0)
    assert (late.status, late.iterations) == (PiecewiseStatus.CROSSED, 2)
    assert late.lines == fit_piecewise(offset, torque, slope_bound=0.0, iterations=1).lines
    assert found(late).switching[0] < found(late).switching[1]


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    m=st.integers(50, 200),
    spread=st.floats(0.3, 50.0),
    levels=st.one_of(st.none(), st.integers(2, 12)),
    bound=st.sampled_from([-math.inf, 0.0, 1e-3, 1.0]),
)
def test_any_data_give_finite_continuous_lines_within_the_bound_or_none(
    seed: int, m: int, spread: float, levels: int | None, bound: float
) -> None:
    generator = np.random.default_rng(seed)
    torque = generator.uniform(-spread, spread, m) + np.linspace(-0.1, 0.1, m) * (levels is None)
    if levels is not None:
        torque = np.where(np.arange(m) < levels, np.linspace(-spread, spread, m), np.round(torque * levels) / levels)
    offset = generator.normal(0.0, 1e-3, m) + 1e-3 * np.sign(torque)
    fit = fit_piecewise(offset, torque, slope_bound=bound)
    assert 1 <= fit.iterations <= 10
    if fit.lines is None:
        assert not fit.converged
        assert fit.rms_residual == math.inf
        return
    low, high = fit.lines.switching
    assert low <= high
    assert fit.lines.slopes[1] >= bound
    assert fit.slope_bounded == (fit.lines.slopes[1] == bound)
    assert np.isfinite([*fit.lines.slopes, *fit.lines.intercepts, low, high, fit.rms_residual]).all()
    k, q = fit.lines.slopes, fit.lines.intercepts
    scale = 1e-12 * (max(abs(value) for value in (*k, *q)) * (1.0 + abs(low) + abs(high)))
    for first, at in ((0, low), (1, high)):
        assert k[first] * at + q[first] == pytest.approx(k[first + 1] * at + q[first + 1], abs=1e3 * scale)


def test_both_signs_have_their_own_lines_and_the_sign_between_mixes_them() -> None:
    torque = torques(4000)
    velocity = np.random.default_rng(9).normal(0.0, 0.01, 4000)
    positive, negative = lines((-1.0, 2.5), middle=3e-3), lines((-2.5, 1.0), (3e-4, 4e-3, 2e-4), middle=-3e-3)
    rest = np.abs(velocity) <= 1e-3
    offset = np.where(velocity > 0.0, positive.offset(torque), negative.offset(torque)) + 0.5 * rest
    model = fit_both_signs(MotorSamples(offset, torque, velocity), still_velocity=1e-3, slope_bound=BOUND)
    assert model.positive.converged
    assert model.negative.converged
    grid = np.linspace(-50.0, 50.0, 1001)
    assert model.offset(grid, 1.0) == pytest.approx(positive.offset(grid), rel=1e-9, abs=1e-12)
    assert model.offset(grid, -1.0) == pytest.approx(negative.offset(grid), rel=1e-9, abs=1e-12)
    assert model.offset(grid, 0.0) == pytest.approx(0.5 * (positive.offset(grid) + negative.offset(grid)), abs=1e-12)
    signs = np.where(grid > 3.0, 1.0, -1.0)
    mixed = np.where(grid > 3.0, positive.offset(grid), negative.offset(grid))
    assert model.offset(grid, signs) == pytest.approx(mixed, rel=1e-9, abs=1e-12)


def test_the_model_is_continuous() -> None:
    """No step of τ makes a larger one of Δq than the steepest line."""
    torque = torques(4000)
    velocity = np.random.default_rng(9).normal(0.0, 1.0, 4000)
    offset = lines().offset(torque) + 5e-4 * np.random.default_rng(1).standard_normal(4000) + 1e-3 * np.sign(velocity)
    model = fit_both_signs(MotorSamples(offset, torque, velocity), still_velocity=0.0, slope_bound=BOUND)
    for sign, fit in ((1.0, model.positive), (-1.0, model.negative)):
        for at in found(fit).switching:
            near = model.offset(at + 1e-9 * np.arange(-5.0, 6.0), sign)
            assert np.abs(np.diff(near)).max() <= 1.001e-9 * max(np.abs(found(fit).slopes)) + 1e-17
    assert model.offset(np.zeros((2, 3)), 1.0).shape == (2, 3)


def test_a_mirrored_joint_has_mirrored_lines() -> None:
    torque = torques()
    offset = lines().offset(torque) + 3e-4 * np.random.default_rng(1).standard_normal(2000)
    velocity = np.random.default_rng(9).normal(0.0, 1.0, 2000)
    model = fit_both_signs(MotorSamples(offset, torque, velocity), still_velocity=0.0, slope_bound=BOUND)
    other = fit_both_signs(MotorSamples(-offset, -torque, -velocity), still_velocity=0.0, slope_bound=BOUND)
    grid = np.linspace(-40.0, 40.0, 201)
    assert other.offset(-grid, -1.0) == pytest.approx(-model.offset(grid, 1.0), rel=1e-9, abs=1e-12)
    assert other.offset(-grid, 1.0) == pytest.approx(-model.offset(grid, -1.0), rel=1e-9, abs=1e-12)


def test_a_sign_without_lines_cannot_be_evaluated() -> None:
    torque = torques()
    good = fit_piecewise(lines().offset(torque), torque, slope_bound=BOUND)
    none = PiecewiseFit(None, PiecewiseStatus.EMPTY_SEGMENT, 1, False, 2000, math.inf)
    with pytest.raises(IdentificationError, match=r"^knee at negative velocity: .*without two different torques") as e:
        PiecewiseModel(good, none, "knee").offset(torque, 1.0)
    assert (e.value.joint, e.value.reason) == ("knee", Fault.NO_MODEL)


def test_bad_samples_and_arguments_are_refused() -> None:
    torque = torques()
    offset = lines().offset(torque)
    with pytest.raises(IdentificationError, match=r"^knee: 20 samples"):
        fit_piecewise(offset[:20], torque[:20], slope_bound=BOUND, joint="knee")
    with pytest.raises(IdentificationError, match="not finite"):
        fit_piecewise(np.where(torque > 39.0, np.nan, offset), torque, slope_bound=BOUND)
    with pytest.raises(IdentificationError, match="deviate"):
        fit_piecewise(offset, np.ones(2000), slope_bound=BOUND)
    moving_one_way = MotorSamples(offset, torque, np.ones(2000))
    with pytest.raises(IdentificationError, match=r"^knee at negative velocity: 0 samples"):
        fit_both_signs(moving_one_way, still_velocity=0.0, slope_bound=BOUND, joint="knee")
    with pytest.raises(IdentificationError, match="still_velocity"):
        fit_both_signs(moving_one_way, still_velocity=-1.0, slope_bound=BOUND)
    for start in ((0.5, -0.5), (0.5, 0.5), (math.nan, 0.5)):
        with pytest.raises(IdentificationError, match="start"):
            fit_piecewise(offset, torque, start=start, slope_bound=BOUND)
    for bound in (math.nan, math.inf):
        with pytest.raises(IdentificationError, match="slope_bound"):
            fit_piecewise(offset, torque, slope_bound=bound)
    with pytest.raises(IdentificationError, match="iterations"):
        fit_piecewise(offset, torque, slope_bound=BOUND, iterations=0)
