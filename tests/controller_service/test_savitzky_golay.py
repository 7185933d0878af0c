"""Savitzky-Golay: polynomials come back exactly, and what else comes is late and noisy by what is promised."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from controller_service.errors import StateError
from controller_service.model import Array
from controller_service.savitzky_golay import SavitzkyGolay, smooth
from schemas.errors import ConfigurationError

PERIOD = 0.001
Place = Literal["centre", "end"]


def run(of: SavitzkyGolay, signal: Array) -> Array:
    """Every estimate, (K, derivatives + 1, n)."""
    return np.array([of.update(sample) for sample in signal])


def polynomials(order: int, channels: int, duration: float) -> list[Polynomial]:
    """Of values and coefficients about one over the duration, different in each channel."""
    rng = np.random.default_rng(7)
    return [Polynomial(rng.uniform(0.5, 1.5, order + 1), domain=[0.0, duration]) for _ in range(channels)]


def table(of: list[Polynomial], derivative: int, t: Array) -> Array:
    return np.column_stack([p.deriv(derivative)(t) if derivative else p(t) for p in of])


@pytest.mark.parametrize("at", ["centre", "end"])
@pytest.mark.parametrize(("window", "order"), [(80, 2), (81, 3), (7, 4), (2, 1), (5, 0), (4, 3)])
def test_polynomials_up_to_the_order_come_back_with_all_derivatives(window: int, order: int, at: Place) -> None:
    t = PERIOD * np.arange(3 * window + 2)
    curves = polynomials(order, 3, t[-1])
    of = SavitzkyGolay(3, window, order, PERIOD, derivatives=order, at=at)
    estimates = run(of, table(curves, 0, t))[window - 1 :]
    assert estimates.shape[1:] == (order + 1, 3)
    for d in range(order + 1):
        expected = table(curves, d, t[window - 1 :] - of.delay_s)
        assert np.abs(estimates[:, d] - expected).max() < 1e-9 * np.abs(table(curves, d, t)).max()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_one_order_more_comes_back_at_the_centre_alone_and_there_in_every_second_derivative(order: int) -> None:
    t = PERIOD * np.arange(60)
    curves = polynomials(order + 1, 1, t[-1])
    places: tuple[Place, Place] = ("centre", "end")
    for at in places:
        exact = range(order, -1, -2) if at == "centre" else ()
        of = SavitzkyGolay(1, 20, order, PERIOD, derivatives=order, at=at)
        estimates = run(of, table(curves, 0, t))[19:]
        for d in range(order + 1):
            expected = table(curves, d, t[19:] - of.delay_s)
            error = np.abs(estimates[:, d] - expected).max() / np.abs(expected).max()
            assert (error < 1e-9) == (d in exact)
            assert d in exact or error > 1e-5


def test_at_the_centre_the_delay_is_half_the_window_less_half_a_period() -> None:
    of = SavitzkyGolay(1, 80, 1, PERIOD)
    assert of.delay_s == pytest.approx(0.0395)
    ramp = PERIOD * np.arange(200.0)[:, None]
    assert ramp[-1, 0] - run(of, ramp)[-1, 0, 0] == pytest.approx(of.delay_s, rel=1e-9)


@pytest.mark.parametrize("window", [80, 81])
@pytest.mark.parametrize("frequency_hz", [1.0, 5.0])
def test_at_the_centre_value_and_derivatives_of_a_sinusoid_are_late_by_exactly_the_delay(
    window: int, frequency_hz: float
) -> None:
    omega = 2.0 * math.pi * frequency_hz
    t = PERIOD * np.arange(2000)
    of = SavitzkyGolay(1, window, 2, PERIOD, derivatives=2)
    estimates = run(of, np.sin(omega * t)[:, None])[window - 1 :, :, 0]
    late = omega * (t[window - 1 :] - of.delay_s)
    gains = []
    for d, shape in enumerate((np.sin(late), omega * np.cos(late), -(omega**2) * np.sin(late))):
        gain = estimates[:, d] @ shape / (shape @ shape)
        assert np.abs(estimates[:, d] - gain * shape).max() < 1e-8 * np.abs(shape).max()
        gains.append(gain)
    assert gains == pytest.approx([1.0, 1.0, 1.0], abs=0.2)
    assert all(abs(gain) < 1.0 + 1e-9 for gain in gains), "a low-pass never amplifies here"


def test_at_the_end_only_what_is_no_polynomial_is_late_and_the_highest_derivative_is_that_of_the_centre() -> None:
    t = PERIOD * np.arange(600)
    signal = np.sin(12.0 * t)[:, None]
    centre = run(SavitzkyGolay(1, 80, 2, PERIOD, derivatives=2), signal)
    of = SavitzkyGolay(1, 80, 2, PERIOD, derivatives=2, at="end")
    end = run(of, signal)
    assert of.delay_s == 0.0
    assert np.abs(end[80:, 0, 0] - signal[80:, 0]).max() < 0.3 * np.abs(centre[80:, 0, 0] - signal[80:, 0]).max()
    assert end[:, 2] == pytest.approx(centre[:, 2], abs=1e-6)


@pytest.mark.parametrize("at", ["centre", "end"])
@pytest.mark.parametrize(("window", "order"), [(20, 2), (15, 1)])
def test_white_noise_comes_out_with_the_promised_deviation(window: int, order: int, at: Place) -> None:
    channels, rounds, sigma = 200, 100, 0.3
    rng = np.random.default_rng(11)
    of = SavitzkyGolay(channels, window, order, PERIOD, derivatives=order, at=at)
    outputs = np.array([run(of, sigma * rng.standard_normal((window, channels)))[-1] for _ in range(rounds)])
    deviation = np.std(outputs, axis=(0, 2))
    # 20000 independent windows: the deviation of a deviation is 1/sqrt(2 · 20000) of it
    assert deviation == pytest.approx(sigma * of.noise_gain, rel=4.0 / math.sqrt(2.0 * channels * rounds))


def test_the_noise_is_that_of_the_formulas() -> None:
    window = 80
    mean = SavitzkyGolay(1, window, 1, PERIOD, derivatives=1)
    # [value, slope] of the regression line: σ²/w and 12 σ²/(T² w (w² − 1))
    assert mean.noise_gain == pytest.approx(
        [1.0 / math.sqrt(window), math.sqrt(12.0 / (window * (window**2 - 1))) / PERIOD]
    )
    for order in (0, 1, 2, 3):
        end = SavitzkyGolay(1, window, order, PERIOD, at="end")
        assert end.noise_gain[0] == pytest.approx((order + 1) / math.sqrt(window), rel=0.05)
    assert SavitzkyGolay(1, window, 2, PERIOD).noise_gain[0] == pytest.approx(1.5 / math.sqrt(window), rel=0.01)


@pytest.mark.parametrize("window", [6, 7])
def test_order_one_at_the_centre_is_the_moving_average(window: int) -> None:
    signal = np.random.default_rng(3).standard_normal((50, 2))
    estimates = run(SavitzkyGolay(2, window, 1, PERIOD), signal)[:, 0]
    for k in range(window - 1, 50):
        assert estimates[k] == pytest.approx(signal[k - window + 1 : k + 1].mean(axis=0), abs=1e-13)


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("window", [15, 14])
def test_the_record_smoothed_is_the_stream_shifted_by_its_delay(window: int, derivative: int) -> None:
    signal = np.random.default_rng(5).standard_normal((100, 3))
    smoothed = smooth(signal, window, 2, PERIOD, derivative)
    assert smoothed.shape == signal.shape
    of = SavitzkyGolay(3, 15, 2, PERIOD, derivatives=2)
    shift = round(of.delay_s / PERIOD)
    assert shift == 7
    stream = run(of, signal)[14:, derivative]
    assert np.abs(smoothed[shift : 100 - shift] - stream).max() < 1e-12 * np.abs(stream).max()


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_the_ends_of_a_record_come_from_the_first_and_last_window(derivative: int) -> None:
    signal = np.random.default_rng(6).standard_normal((40, 2))
    smoothed = smooth(signal, 11, 2, PERIOD, derivative)
    t = PERIOD * np.arange(40)
    for rows, ends in ((slice(0, 11), slice(0, 5)), (slice(29, 40), slice(35, 40))):
        for channel in range(2):
            fit = Polynomial.fit(t[rows], signal[rows, channel], 2)
            expected = fit.deriv(derivative)(t[ends]) if derivative else fit(t[ends])
            assert smoothed[ends, channel] == pytest.approx(expected, rel=1e-9, abs=1e-9 * PERIOD**-derivative)


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_a_record_of_a_polynomial_comes_back_in_every_row(derivative: int) -> None:
    t = PERIOD * np.arange(120)
    curves = polynomials(3, 2, t[-1])
    smoothed = smooth(table(curves, 0, t), 40, 3, PERIOD, derivative)
    expected = table(curves, derivative, t)
    assert np.abs(smoothed - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("at", ["centre", "end"])
@pytest.mark.parametrize("gaps", [(2, 1, 3), (5,), (9, 1), (30, 1, 1)])
def test_missed_cycles_of_a_ramp_are_as_if_they_were_not(gaps: tuple[int, ...], at: Place) -> None:
    slope, start = np.array([0.7, -2.0]), np.array([1.0, 0.3])
    whole, seldom = (SavitzkyGolay(2, 10, 2, PERIOD, derivatives=2, at=at) for _ in range(2))
    k = 0
    whole.update(start)
    seldom.update(start)
    for i in range(40):
        cycles = gaps[i % len(gaps)]
        for _ in range(cycles):
            k += 1
            complete = whole.update(start + slope * (PERIOD * k))
        estimate = seldom.update(start + slope * (PERIOD * k), cycles)
        assert np.abs(estimate - complete).max(axis=1) / whole.noise_gain == pytest.approx(np.zeros(3), abs=1e-13)


def test_a_missed_sample_is_the_mean_of_its_neighbours() -> None:
    samples = np.random.default_rng(8).standard_normal((30, 2))
    filled = samples.copy()
    filled[20] = 0.5 * (samples[19] + samples[21])
    of, seldom = (SavitzkyGolay(2, 8, 2, PERIOD, derivatives=1) for _ in range(2))
    expected = run(of, filled)
    run(seldom, samples[:20])
    assert seldom.update(samples[21], 2) == pytest.approx(expected[21], rel=1e-10)
    assert seldom.update(samples[22]) == pytest.approx(expected[22], rel=1e-10)


def test_the_first_sample_is_a_robot_that_stands_still_and_a_restart_forgets() -> None:
    of = SavitzkyGolay(2, 12, 2, PERIOD, derivatives=2)
    signal = np.random.default_rng(9).standard_normal((40, 2))
    first = run(of, signal)
    assert first[0, 0] == pytest.approx(signal[0], abs=1e-12)
    assert first[0, 1:] == pytest.approx(np.zeros((2, 2)), abs=1e-6)
    of.restart()
    assert not of.ready
    assert np.array_equal(run(of, signal), first)


def test_ready_when_a_whole_window_was_seen() -> None:
    of = SavitzkyGolay(1, 5, 1, PERIOD)
    assert not of.ready
    seen = []
    for k in range(7):
        of.update(np.array([float(k)]))
        seen.append(of.ready)
    assert seen == [False] * 4 + [True] * 3
    of.restart()
    of.update(np.zeros(1), 5)
    assert not of.ready, "what was before the first sample was not seen"
    of.update(np.ones(1), 4)
    assert of.ready


def test_what_was_returned_and_what_was_given_stay_their_owners() -> None:
    of, other = (SavitzkyGolay(1, 6, 1, PERIOD) for _ in range(2))
    sample = np.ones(1)
    kept = of.update(sample)
    copy = kept.copy()
    sample[:] = 50.0
    other.update(np.ones(1))
    assert of.update(np.zeros(1)) == pytest.approx(other.update(np.zeros(1)))
    assert np.array_equal(kept, copy)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"window": 1, "order": 0}, "window of 1"),
        ({"window": 3, "order": 3}, "order 3"),
        ({"order": -1}, "order -1"),
        ({"derivatives": 3}, "no derivative 3"),
        ({"derivatives": -1}, "no derivative -1"),
        ({"period_s": 0.0}, "must be positive"),
        ({"period_s": math.nan}, "must be positive"),
        ({"channels": 0}, "at least one channel"),
        ({"at": "start"}, "'centre' or at the 'end'"),
        ({"window": 500, "order": 5, "at": "end"}, "rounding"),
    ],
)
def test_a_filter_that_cannot_be_is_refused(change: dict[str, Any], says: str) -> None:
    fits: dict[str, Any] = {"channels": 2, "window": 10, "order": 2, "period_s": PERIOD}
    SavitzkyGolay(**fits)
    with pytest.raises(ConfigurationError, match=says):
        SavitzkyGolay(**(fits | change))


@pytest.mark.parametrize(
    ("sample", "cycles"),
    [([1.0], 1), ([[1.0, 2.0]], 1), ([1.0, math.nan], 1), ([-math.inf, 1.0], 1), ([1.0, 2.0], 0), ([1.0, 2.0], -1)],
)
def test_a_sample_that_does_not_fit_is_refused_and_changes_nothing(sample: list[Any], cycles: int) -> None:
    of, other = (SavitzkyGolay(2, 4, 1, PERIOD) for _ in range(2))
    for each in (of, other):
        each.update(np.array([0.5, 0.6]))
    with pytest.raises(StateError, match="2 finite values"):
        of.update(np.array(sample), cycles)
    assert np.array_equal(of.update(np.ones(2)), other.update(np.ones(2)))


@pytest.mark.parametrize(
    ("signal", "window", "derivative", "says"),
    [
        (np.zeros(50), 10, 0, "expected a signal"),
        (np.zeros((10, 2)), 10, 0, "at least 11 samples"),
        (np.full((20, 1), math.inf), 10, 0, "not finite in sample 0"),
        (np.zeros((50, 2)), 10, 3, "no derivative 3"),
        (np.zeros((50, 2)), 2, 0, "order 2"),
    ],
)
def test_a_record_that_cannot_be_smoothed_is_refused(signal: Array, window: int, derivative: int, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        smooth(signal, window, 2, PERIOD, derivative)
    assert smooth(np.zeros((11, 2)), 10, 2, PERIOD).shape == (11, 2)
