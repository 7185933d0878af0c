"""What the experiments with the leg measure with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deploy.errors import UsageError
from experiments.leg_signals import best_shift, contact, in_span, motion, phase_span, rms, sine_spans
from schemas.load import load_run
from schemas.messages import ContactSample
from tests.experiments.made_up_runs import made_up_leg

STAIRS, FORCE = "leg6-stairs", "leg6-force-sine"
FOOT = "R_ANKLE_P_S"
T = 0.001


def wave(time_s: Any) -> Any:
    return np.column_stack((np.sin(9.0 * time_s) + 0.2 * time_s, 0.01 * np.cos(7.0 * time_s)))


@pytest.mark.parametrize("late_s", [0.0395, 0.0123, 0.0, -0.0072])
def test_a_shift_is_found_between_the_samples_and_signed(late_s: float) -> None:
    time_s = np.arange(0.0, 3.0, T)
    signal = 1.1 * wave(time_s - late_s) + 5.0
    assert best_shift(signal, wave(time_s), T, 0.1) == pytest.approx(late_s, abs=2e-4)


def test_a_shift_beyond_reach_is_none_and_what_stands_still_does_not_count() -> None:
    time_s = np.arange(0.0, 3.0, T)
    assert np.isnan(best_shift(wave(time_s - 0.15), wave(time_s), T, 0.1))
    noise = np.random.default_rng(1).standard_normal(len(time_s))
    signal = np.column_stack((wave(time_s - 0.02), noise))
    reference = np.column_stack((wave(time_s), np.zeros(len(time_s))))
    assert best_shift(signal, reference, T, 0.1) == pytest.approx(0.02, abs=1e-4)


def test_spans_of_phases_and_runs_that_end_before() -> None:
    assert phase_span(load_run(STAIRS), "swing") == pytest.approx((1.0, 3.2))
    with pytest.raises(UsageError, match="no phase 'climb'"):
        phase_span(load_run(STAIRS), "climb")
    with pytest.raises(UsageError, match=r"--set duration_s=3\.2 or more"):
        phase_span(load_run(STAIRS, {"duration_s": 3.1}), "swing")


def test_whole_periods_before_and_after_the_event() -> None:
    spans = sine_spans(load_run(FORCE), "lifted")
    assert (spans.period_s, spans.before, spans.after) == (2.0, (2.0, 8.0), (10.0, 12.0))
    alone = sine_spans(load_run(FORCE))
    assert (alone.before, alone.after) == ((2.0, 12.0), None)
    assert sine_spans(load_run(FORCE, {"duration_s": 7.9})).before == (2.0, 6.0)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"plant.world.events.lifted.start_s": 3.9}, "no whole period of its sine ends before 3.9 s"),
        ({"plant.world.events.lifted.start_s": 8.7}, "must begin 1 s after that"),
        ({"controller.phases.press.wrench": None}, "no phase with a wrench"),
        ({"plant.world.events": []}, "no event 'lifted'"),
    ],
)
def test_what_leaves_no_whole_period_is_refused(overrides: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        sine_spans(load_run(FORCE, overrides), "lifted")


def test_the_contact_is_what_acts_on_the_foot_about_its_origin() -> None:
    run = load_run(FORCE)
    count = 400
    still = np.zeros((count, 6))
    foot = np.tile((0.1, -0.2, 0.3), (count, 1))

    def touches(z: float) -> tuple[ContactSample, ...]:
        lower = {"other": "block", "position_in_world": (0.2, -0.2, 0.2)}
        sole = ContactSample(link=FOOT, force_in_world=(3.0, 0.0, z), **lower)
        knee = ContactSample(link="R_KNEE_S", force_in_world=(0.0, 0.0, 1e3), **lower)
        return sole, sole, knee

    series = made_up_leg(run, still, still, hand=foot, contacts=tuple(touches(k) for k in range(count)))
    force = contact(series)
    ramp = 2.0 * np.arange(count)
    assert_allclose(force.raw[:, :3], np.column_stack((6.0 + 0 * ramp, 0 * ramp, ramp)))
    assert_allclose(force.raw[:, 3:], np.cross((0.1, 0.0, -0.1), force.raw[:, :3]))
    assert_allclose(force.smooth, force.raw, atol=1e-8)
    bump = made_up_leg(run, still, still, hand=foot, contacts=tuple(touches(405.0 * (k == 200)) for k in range(count)))
    assert_allclose(contact(bump).smooth[[159, 160, 200, 240, 241], 2], (0.0, 10.0, 10.0, 10.0, 0.0), atol=1e-9)


def test_the_error_is_against_what_the_other_run_was_asked_at_the_same_time() -> None:
    run = load_run(STAIRS)
    asked, followed = np.random.default_rng(2).standard_normal((2, 5000, 6))
    one, other = made_up_leg(run, asked, asked), made_up_leg(run, 0.0 * asked, followed)
    cut = replace(other, truth=replace(other.truth, sequence=other.truth.sequence + 10))
    moved = motion(cut, (1.0, 3.2), one)
    assert len(moved.time_s) == 2200
    assert moved.time_s[[0, -1]] == pytest.approx((1.0, 3.199))
    assert_allclose(moved.desired, asked[1000:3200])
    assert_allclose(moved.error, asked[1000:3200] - followed[990:3190])


def test_spans_leave_their_end_out_and_rms_is_by_column() -> None:
    assert in_span(np.array((0.9, 1.0, 1.5, 2.0)), (1.0, 2.0)).tolist() == [False, True, True, False]
    assert_allclose(rms(np.array([[3.0, 0.0], [-3.0, 2.0]])), (3.0, np.sqrt(2.0)))
