"""The switch of dual compliance: hysteresis, dwell, edges."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.dual_compliance import Compliance, DualComplianceSwitch
from schemas.control_law import DualCompliance

PERIOD = 0.002
CONFIG = DualCompliance(force_on=15.0, force_off=6.0, dwell_s=0.01)
OFF = Compliance(active=False, engaged=False, released=False)
ON = Compliance(active=True, engaged=False, released=False)
ENGAGED = Compliance(active=True, engaged=True, released=False)
RELEASED = Compliance(active=False, engaged=False, released=True)


def run(forces: list[float], config: DualCompliance = CONFIG, elapsed_s: float = PERIOD) -> list[Compliance]:
    switch = DualComplianceSwitch(config, PERIOD)
    return [switch.update(force, elapsed_s) for force in forces]


def test_it_engages_above_the_upper_force_only() -> None:
    assert run([0.0, 6.5, 14.9, 15.0, 15.1, 15.1]) == [OFF, OFF, OFF, OFF, ENGAGED, ON]


def test_between_the_two_forces_it_stays_as_it_is() -> None:
    assert run([10.0] * 50) == [OFF] * 50
    assert run([20.0] + [6.0] * 50) == [ENGAGED] + [ON] * 50


def test_it_releases_after_the_dwell_below_the_lower_force_and_engages_again() -> None:
    assert run([20.0] + [5.0] * 7 + [16.0]) == [ENGAGED] + [ON] * 5 + [RELEASED, OFF, ENGAGED]


def test_a_force_in_between_starts_the_dwell_again() -> None:
    assert run([20.0] + [5.0] * 5 + [7.0] + [5.0] * 6) == [ENGAGED] + [ON] * 11 + [RELEASED]


def test_the_dwell_is_a_time_and_not_a_number_of_updates() -> None:
    assert run([20.0] + [5.0] * 3, elapsed_s=0.005) == [ENGAGED, ON, ON, RELEASED]


@pytest.mark.parametrize("cycles", [1, 10, 208, 999])
def test_rounding_adds_no_cycle_to_the_dwell(cycles: int) -> None:
    """A sum of periods of 5 ms falls short of their product from 10 on."""
    period = 0.005
    switch = DualComplianceSwitch(CONFIG.model_copy(update={"dwell_s": cycles * period}), period)
    states = [switch.update(force, period) for force in [20.0] + [0.0] * (cycles + 1)]
    assert states == [ENGAGED, *[ON] * cycles, RELEASED]


def test_without_dwell_it_releases_at_once() -> None:
    assert run([20.0, 5.9], CONFIG.model_copy(update={"dwell_s": 0.0})) == [ENGAGED, RELEASED]


def test_a_reset_is_no_release() -> None:
    switch = DualComplianceSwitch(CONFIG, PERIOD)
    switch.update(20.0, PERIOD)
    switch.reset()
    assert switch.update(10.0, PERIOD) == OFF
    assert switch.update(20.0, PERIOD) == ENGAGED


def test_any_sequence_keeps_the_law() -> None:
    """Edges are the changes of `active`; each engagement has a force above, each release a dwell of forces below."""
    noise = np.random.default_rng(2).normal(size=5000)
    forces = 10.0 + 9.0 * np.sin(np.arange(5000) * 0.05) + 3.0 * noise
    states = run(forces.tolist())
    active = np.array([state.active for state in states])
    before = np.concatenate(([False], active[:-1]))
    engaged = np.array([state.engaged for state in states])
    released = np.array([state.released for state in states])
    assert np.array_equal(engaged, active & ~before)
    assert np.array_equal(released, ~active & before)
    assert np.array_equal(engaged, (forces > 15.0) & ~before)
    calm = np.lib.stride_tricks.sliding_window_view(np.concatenate((np.full(5, 99.0), forces)), 6).max(axis=1) < 6.0
    calm &= np.array([before[max(k - 5, 0) : k + 1].all() for k in range(5000)])
    assert np.array_equal(released, calm)
    assert released.sum() > 10
