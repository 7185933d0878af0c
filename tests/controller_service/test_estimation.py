"""Velocity from positions."""

from __future__ import annotations

import math

import numpy as np

from controller_service.estimation import VelocityEstimator


def test_the_first_sample_gives_zero_and_a_ramp_its_slope() -> None:
    estimator = VelocityEstimator(0.002, 40.0)
    assert not estimator.estimate(np.array([1.0, -2.0])).velocity.any()
    for k in range(1, 200):
        estimate = estimator.estimate(np.array([1.0, -2.0]) + 0.002 * k * np.array([0.5, -0.3]))
    assert np.allclose(estimate.velocity, [0.5, -0.3])


def test_a_step_of_speed_rises_with_the_exact_pole() -> None:
    estimator = VelocityEstimator(0.002, 40.0)
    estimator.estimate(np.zeros(1))
    for k in range(1, 20):
        estimate = estimator.estimate(np.array([0.002 * k]))
        assert math.isclose(estimate.velocity[0], 1.0 - math.exp(-2.0 * math.pi * 40.0 * 0.002 * k))


def test_a_gap_of_two_cycles_is_one_difference_over_both() -> None:
    estimator = VelocityEstimator(0.002, 40.0)
    estimator.estimate(np.zeros(1))
    estimate = estimator.estimate(np.array([0.004]), cycles=2)
    assert math.isclose(estimate.velocity[0], 1.0 - math.exp(-2.0 * math.pi * 40.0 * 0.004))


def test_the_lag_is_what_the_documentation_says() -> None:
    period, cutoff, rate = 0.002, 40.0, 6.0
    estimator = VelocityEstimator(period, cutoff)
    velocities = [estimator.estimate(np.array([math.sin(rate * k * period)])).velocity[0] for k in range(3000)]
    t = np.arange(3000) * period
    tail = slice(1000, 3000)
    fit = np.linalg.lstsq(
        np.column_stack((np.cos(rate * t[tail]), np.sin(rate * t[tail]))), np.array(velocities)[tail], rcond=None
    )[0]
    pole = math.exp(-2.0 * math.pi * cutoff * period)
    assert math.isclose(math.atan2(fit[1], fit[0]) / rate, period / 2 + period * pole / (1 - pole), rel_tol=0.01)
