"""What the experiment of dual compliance measures, on runs that never were."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deploy.experiment import ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments import dual_compliance
from experiments.dual_compliance import DRIFT_M, ELBOW, ELBOW_M, FORCE_OVER_STICTION, KEPT_M, LEAD_S, MOVED_M, SCENARIO
from experiments.null_space import spans
from schemas.load import load_run
from tests.experiments.made_up_runs import made_up

RUN = load_run(SCENARIO)
PUSHES = spans(RUN)
(ELBOW_FROM, ELBOW_TO), (LEAD_FROM, LEAD_TO) = PUSHES["elbow"], PUSHES["hand"]
AWAY = (0.0, 0.6, 0.8)
MADE = made_up(SCENARIO)
TIME = MADE.truth.time_s
CYCLE_S = float(TIME[1])
LED = (TIME >= LEAD_FROM + 0.5) & (TIME < LEAD_TO + 0.1)


def arm(hand_m: Any = 0.0, *, moved_m: float = 0.2, elbow_m: float = 0.08, led: Any = LED) -> RunSeries:
    """A run whose hand goes a way while it is led and stays; `hand_m` (K,) comes on top."""
    way = moved_m * np.clip((TIME - LEAD_FROM) / (LEAD_TO - LEAD_FROM), 0.0, 1.0)
    hand = 0.4 + np.outer(way + hand_m, AWAY)
    pushed = (TIME > ELBOW_FROM) & (TIME <= ELBOW_TO)
    frames = {"hand": hand, ELBOW: 0.3 + np.outer(elbow_m * pushed, AWAY)}
    truth = replace(MADE.truth, hand=hand, frames=frames)
    return replace(MADE, truth=truth, trace=replace(MADE.trace, hand_desired=hand + 0.0, admittance=led))


def during(begin_s: float, end_s: float, value: float) -> Array:
    return np.where((begin_s - 1e-6 < TIME) & (end_s + 1e-6 > TIME), value, 0.0)


def measured(series: RunSeries) -> ExperimentResult:
    return dual_compliance._result(ExperimentRequest(3), RUN, series, 200.0)


def failing(series: RunSeries) -> set[str]:
    return {bar.name for bar in measured(series).bars if not bar.holds}


def test_a_run_within_all_limits_passes() -> None:
    found = measured(arm())
    assert found.passed
    metrics = found.metrics
    assert metrics["elbow_force_n"] == pytest.approx(FORCE_OVER_STICTION * 200.0)
    assert metrics["elbow_displacement_m"] == pytest.approx(0.08)
    assert metrics["hand_drift_elbow_push_m"] == 0.0
    assert metrics["hand_moved_m"] == pytest.approx(0.2)
    assert metrics["hand_kept_within_m"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["hand_error_end_m"] == 0.0
    assert metrics["lead_force_max_n"] == 20.0
    assert metrics["admittance_on_s"] == pytest.approx(LEAD_FROM + 0.5)
    assert metrics["admittance_off_s"] == pytest.approx(LEAD_TO + 0.1 - CYCLE_S)


@pytest.mark.parametrize("when", [ELBOW_FROM + CYCLE_S, 5.0, ELBOW_TO + 0.5, LEAD_FROM - CYCLE_S])
def test_the_hand_may_not_drift_at_one_cycle_between_the_elbows_push_and_the_lead(when: float) -> None:
    assert failing(arm(during(when, when, -1.1 * DRIFT_M))) == {"hand_drift_elbow_push_m"}
    within = measured(arm(during(when, when, 0.9 * DRIFT_M)))
    assert within.passed
    assert within.metrics["hand_drift_elbow_push_m"] == pytest.approx(0.9 * DRIFT_M)


def test_drift_is_from_the_place_at_the_start_of_the_push() -> None:
    assert failing(arm(during(0.0, ELBOW_FROM - CYCLE_S, 0.5))) == set()
    assert failing(arm(during(LEAD_FROM + CYCLE_S, LEAD_FROM + 1.0, 0.5))) == set()


def test_an_elbow_that_gives_way_too_little_fails() -> None:
    assert failing(arm(elbow_m=0.9 * ELBOW_M)) == {"elbow_displacement_m"}
    assert failing(arm(elbow_m=1.1 * ELBOW_M)) == set()


def test_a_hand_that_is_led_too_short_a_way_fails() -> None:
    assert failing(arm(moved_m=0.9 * MOVED_M)) == {"hand_moved_m"}
    assert failing(arm(moved_m=1.1 * MOVED_M)) == set()


def test_the_way_counts_from_the_lead_and_in_its_time() -> None:
    before = arm(during(0.0, LEAD_FROM - 0.5, -0.5), moved_m=0.9 * MOVED_M)
    assert failing(before) == {"hand_moved_m", "hand_drift_elbow_push_m"}
    last = min(LEAD_FROM + LEAD_S, LEAD_TO)
    late = during(last + CYCLE_S, TIME[-1], 0.5)
    assert failing(arm(late, moved_m=0.9 * MOVED_M)) == {"hand_moved_m", "hand_kept_within_m"}
    in_time = during(last - CYCLE_S, TIME[-1], 0.9 * KEPT_M)
    assert failing(arm(in_time, moved_m=MOVED_M - 0.5 * KEPT_M)) == set()


@pytest.mark.parametrize(("creep_m", "fails"), [(0.012, True), (-0.012, True), (0.008, False)])
def test_a_hand_that_creeps_after_it_was_let_go_has_not_kept_its_place(creep_m: float, fails: bool) -> None:
    creep = creep_m * np.clip((TIME - LEAD_TO) / (TIME[-1] - LEAD_TO), 0.0, 1.0)
    found = measured(arm(creep))
    assert found.metrics["hand_kept_within_m"] == pytest.approx(abs(creep_m))
    assert {bar.name for bar in found.bars if not bar.holds} == ({"hand_kept_within_m"} if fails else set())
    there_and_back = during(LEAD_TO + 1.0, LEAD_TO + 1.0, creep_m)
    assert failing(arm(there_and_back)) == ({"hand_kept_within_m"} if fails else set())


def test_an_error_at_the_end_is_that_of_the_desired_place() -> None:
    series = arm(during(TIME[-1], TIME[-1], 0.005))
    kept = replace(series, trace=replace(series.trace, hand_desired=arm().trace.hand_desired))
    assert measured(kept).metrics["hand_error_end_m"] == pytest.approx(0.005)
    assert measured(series).metrics["hand_error_end_m"] == 0.0


def test_the_admittance_leads_until_the_hand_is_let_go() -> None:
    assert failing(arm(led=LED & (TIME < LEAD_TO - 0.5 * CYCLE_S))) == {"admittance_off_s"}
    assert failing(arm(led=LED & (TIME < LEAD_TO + 0.5 * CYCLE_S))) == set()


def test_an_admittance_that_never_leads_fails() -> None:
    found = measured(arm(led=np.zeros_like(LED)))
    assert {bar.name for bar in found.bars if not bar.holds} == {"admittance_off_s"}
    assert found.metrics["admittance_on_s"] is None


@pytest.mark.parametrize("when", [ELBOW_FROM + 1.0, LEAD_FROM - CYCLE_S])
def test_an_admittance_that_leads_before_the_hand_is_led_fails(when: float) -> None:
    found = measured(arm(led=LED | (np.abs(TIME - when) < 0.5 * CYCLE_S)))
    assert {bar.name for bar in found.bars if not bar.holds} == {"admittance_ticks_before_lead"}
    assert found.metrics["admittance_ticks_before_lead"] == 1
    assert failing(arm(led=LED | (np.abs(TIME - LEAD_FROM) < 0.5 * CYCLE_S))) == set()
