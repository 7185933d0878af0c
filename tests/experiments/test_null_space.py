"""What the null-space experiment measures, on runs that never were."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments import null_space
from experiments.null_space import (
    ELBOW,
    ERROR_M,
    LAST_S,
    RETURN_M,
    SCENARIO,
    SETTLE_S,
    VARIANTS,
    elbow_displacement,
    posture_metric,
    spans,
)
from schemas.load import load_run
from tests.experiments.made_up_runs import made_up

PUSHES = spans(load_run(SCENARIO))
AWAY = (0.0, 0.6, 0.8)


def arm(elbow_m: float, hand_m: Any = 0.0, **overrides: Any) -> RunSeries:
    """A run whose elbow is away by a distance while it is pushed, and whose hand is off its place by `hand_m` (K,)."""
    series = made_up(SCENARIO, **overrides)
    truth, time_s = series.truth, series.truth.time_s
    rest = np.zeros((len(time_s), 3))
    pushed = (time_s > PUSHES["elbow"][0]) & (time_s <= PUSHES["elbow"][1])
    hand = rest + np.multiply.outer(hand_m + 0.0 * time_s, AWAY)
    elbow = 0.3 + elbow_m * np.outer(pushed, AWAY)
    return replace(
        series,
        truth=replace(truth, hand=hand, frames={"hand": hand, ELBOW: elbow}),
        trace=replace(series.trace, hand_desired=rest),
    )


def during(begin_s: float, end_s: float, value: float) -> Array:
    time_s = made_up(SCENARIO).truth.time_s
    return np.where((time_s > begin_s) & (time_s < end_s), value, 0.0)


def measured(with_law: RunSeries, without: RunSeries) -> ExperimentResult:
    runs = {"with": with_law, "without": without}
    return null_space._result(ExperimentRequest(3), load_run(SCENARIO), runs, 200.0)


def failing(result: ExperimentResult) -> set[str]:
    return {bar.name for bar in result.bars if not bar.holds}


def without(elbow_m: float, hand_m: Any = 0.0) -> RunSeries:
    return arm(elbow_m, hand_m, **VARIANTS["without"])


def test_pushes_leave_room_for_both_returns() -> None:
    run = load_run(SCENARIO)
    events = {event.name: event for event in run.scenario.plant.world.events}
    assert {name: end - start for name, (start, end) in PUSHES.items()} == {
        name: event.duration_s for name, event in events.items()
    }
    assert PUSHES["hand"][1] + SETTLE_S + LAST_S <= PUSHES["elbow"][0]
    assert PUSHES["elbow"][1] + SETTLE_S + LAST_S <= run.scenario.duration_s


def test_the_elbows_displacement_is_the_farthest_during_its_push() -> None:
    series = arm(0.2)
    assert elbow_displacement(series, PUSHES["elbow"]) == pytest.approx(0.2, rel=1e-12)
    assert elbow_displacement(series, PUSHES["hand"]) == 0.0
    there_and_back = (PUSHES["elbow"][0], PUSHES["elbow"][1] + 1.0)
    assert elbow_displacement(series, there_and_back) == pytest.approx(0.2, rel=1e-12)


def test_a_run_within_all_limits_passes_and_says_what_differed() -> None:
    result = measured(arm(0.2), without(0.02))
    assert failing(result) == set()
    assert result.metrics["elbow_displacement_ratio"] == pytest.approx(10.0)
    assert result.metrics["posture_metric"] == {"with": "inertia", "without": "joint"}
    same = load_run(SCENARIO, {"controller.null_space.posture_metric": "joint"})
    assert posture_metric(same) == "joint"


def test_an_elbow_that_gives_way_too_little_fails_the_ratio_alone() -> None:
    assert failing(measured(arm(0.05), without(0.02))) == {"elbow_displacement_ratio"}


@pytest.mark.parametrize("event", ["hand", "elbow"])
def test_a_hand_that_is_off_late_after_a_release_has_not_returned(event: str) -> None:
    release = PUSHES[event][1]
    late = during(release + SETTLE_S + 0.1, release + SETTLE_S + 0.3, 1.5 * RETURN_M)
    result = measured(arm(0.2, late), without(0.02))
    assert failing(result) == {"with_return_error_m"}
    assert result.metrics["with_return_error_m"] == pytest.approx(1.5 * RETURN_M)
    assert result.metrics["without_return_error_m"] == 0.0


def test_on_its_way_back_the_hand_may_be_off_by_less_than_the_largest_error() -> None:
    early = during(PUSHES["hand"][0], PUSHES["hand"][1] + SETTLE_S - 0.1, 0.9 * ERROR_M)
    result = measured(arm(0.2, early), without(0.02))
    assert failing(result) == set()
    assert result.metrics["with_hand_error_max_hand_push_m"] == pytest.approx(0.9 * ERROR_M)
    assert result.metrics["with_hand_error_max_elbow_push_m"] == 0.0
    assert failing(measured(arm(0.2, early * 1.2), without(0.02))) == {"with_hand_error_max_m"}


@pytest.mark.parametrize(("gap_s", "judged_s"), [(1.0, 0.5), (SETTLE_S, 0.5), (SETTLE_S + 1.0, 1.0)])
def test_the_return_is_judged_for_half_a_second_at_least(gap_s: float, judged_s: float) -> None:
    """Errors of one instant each: the earliest that counts lies `judged_s` before the next push."""
    time_s = np.arange(0.0, 20.0, 0.01)
    pushes = {"hand": (2.0, 4.0), "elbow": (4.0 + gap_s, 9.0 + gap_s)}

    def error_at(instant: float) -> float:
        distance = np.where(np.abs(time_s - instant) < 0.004, 1.0, 0.0)
        return null_space._return_error(time_s, distance, pushes, "hand")

    begin = pushes["elbow"][0] - judged_s
    assert [error_at(begin - 0.02), error_at(begin + 0.02), error_at(pushes["elbow"][0] + 0.02)] == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("plant.world.events", [], "the experiment sets it itself"),
        ("plant.world.events.1.force_in_world", [0, 1, 0], r"events\.1\.force_in_world: the experiment sets it itself"),
        ("controller.null_space", None, "the experiment sets it itself"),
        ("duration_s", 15, "--set duration_s=17 or more"),
        ("plant.truth_frames", [], "truth_frames lacks elbow_pitch_link"),
        ("plant.world.events.elbow.start_s", 5.75, "'elbow' begins 0.25 s after the end of 'hand'"),
        ("controller.phases.hold.mode", "position", "needs torque mode"),
    ],
)
def test_what_it_cannot_measure_with_is_refused_before_anything_runs(path: str, value: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        null_space.run(ExperimentRequest(0, {path: value}))
