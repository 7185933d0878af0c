"""Null-space compliance, section IV-C and Figs. 6-8 of [Benallegue 2021]: the hand is pushed, then the elbow.

The same two pushes are made with the null-space compliant law and without it, at the same gains: the tuned set with the
lower hand gains of the scenario. The elbow's force is `FORCE_OVER_STICTION` times what breaks the true friction of the
seed's joints (`hand_runs.stiction_force`): below it nothing moves under any law. All figures are the plant's truth.

Without the law there is no `null_space.posture_metric` either: that run's posture task is met in the metric of the
joints, the other's in that of its scenario (`inertia`). The comparison is of both together; the metric
`posture_metric` names them. With `--set controller.null_space.posture_metric=joint` both runs have the same one, and
only the law differs.

The hand has returned when its error stays small from `SETTLE_S` after a release until the next push, or until the end
of the run. Where the next push leaves less than `LAST_S` of that, the error counts in the last `LAST_S` before it.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.errors import UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import null_space_figure, save
from experiments.hand_runs import (
    TIME_TOLERANCE_S,
    cycle_at,
    hand_error,
    load,
    perform,
    stiction_force,
    workplace,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-null-space"
VARIANTS: Final[dict[str, dict[str, Any]]] = {"with": {}, "without": {"controller.null_space": None}}
PUSHES: Final = ("hand", "elbow")
ELBOW_FORCE: Final = "plant.world.events.elbow.force_in_world"
OWN_FIELDS: Final = (ELBOW_FORCE,)
OWN_WHOLE: Final = ("controller.null_space",)
ELBOW: Final = "elbow_pitch_link"
DIRECTION: Final = (0.0, 1.0, 0.0)
FORCE_OVER_STICTION: Final = 1.25
RATIO: Final = 3.0
ERROR_M: Final = 0.01
RETURN_M: Final = 0.003
SETTLE_S: Final = 3.0
"""After a release: the error from then on is the return error."""
LAST_S: Final = 0.5
"""The return error is that of at least this time, before the next push or the end."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed, with and without.

    Raises:
        UsageError: an override of what the experiment sets itself, or takes away what it needs.
        RunStoppedError: the HAL stopped a run.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS, own_whole=OWN_WHOLE, events=PUSHES, after_s=SETTLE_S + LAST_S)
    _check(scenario)
    stiction = stiction_force(scenario, ELBOW, DIRECTION)
    with workplace(request) as directory:
        runs: dict[str, RunSeries] = {}
        for number, (name, overrides) in enumerate(VARIANTS.items()):
            request.progress(number / len(VARIANTS), name)
            runs[name] = perform(request, SCENARIO, directory / name, {**elbow_push(stiction), **overrides})
        if request.directory is not None:
            save(null_space_figure(runs, ELBOW), directory / "null-space")
    return _result(request, scenario, runs, stiction)


def elbow_push(stiction: float) -> dict[str, Any]:
    """Give the override that pushes the elbow by `FORCE_OVER_STICTION` times the stiction force [N]."""
    return {ELBOW_FORCE: [FORCE_OVER_STICTION * stiction * component for component in DIRECTION]}


def spans(scenario: Run) -> dict[str, tuple[float, float]]:
    """First and last time [s] of each push."""
    events = scenario.scenario.plant.world.events
    return {event.name: (event.start_s, event.start_s + event.duration_s) for event in events}


def _check(scenario: Run) -> None:
    if ELBOW not in scenario.scenario.plant.truth_frames:
        raise UsageError(f"plant.truth_frames lacks {ELBOW}, whose motion the experiment measures: name it there")
    pushes = spans(scenario)
    first, second = sorted(PUSHES, key=lambda name: pushes[name][0])
    room_s = pushes[second][0] - pushes[first][1]
    if room_s < LAST_S - TIME_TOLERANCE_S:
        raise UsageError(
            f"plant.world.events: {second!r} begins {room_s:g} s after the end of {first!r}; let it begin at least"
            f" {LAST_S:g} s after, so that the hand's return is seen"
        )


def _result(request: ExperimentRequest, scenario: Run, runs: dict[str, RunSeries], stiction: float) -> ExperimentResult:
    robot, pushes = scenario.robot.description, spans(scenario)
    metrics: dict[str, Any] = {
        "gains": scenario.scenario.controller.gains or "own",
        "elbow_stiction_n": stiction,
        "elbow_force_n": FORCE_OVER_STICTION * stiction,
        "posture_metric": {name: posture_metric(series.run) for name, series in runs.items()},
    }
    bars = []
    moved = {}
    for name, series in runs.items():
        time_s, error = hand_error(series)
        distance = np.linalg.norm(error, axis=1)
        moved[name] = elbow_displacement(series, pushes["elbow"])
        back = [_return_error(time_s, distance, pushes, event) for event in PUSHES]
        metrics |= {
            f"{name}_elbow_displacement_m": moved[name],
            f"{name}_hand_error_max_m": float(distance.max()),
            f"{name}_hand_error_rms_m": float(np.sqrt(np.mean(distance**2))),
            f"{name}_hand_error_max_hand_push_m": _largest(time_s, distance, pushes["hand"]),
            f"{name}_hand_error_max_elbow_push_m": _largest(time_s, distance, pushes["elbow"]),
            f"{name}_return_error_m": max(back),
        }
        bars += [
            Bar(f"{name}_hand_error_max_m", float(distance.max()), ERROR_M),
            Bar(f"{name}_return_error_m", max(back), RETURN_M),
        ]
    ratio = moved["with"] / moved["without"]
    metrics["elbow_displacement_ratio"] = ratio
    bars.insert(0, Bar("elbow_displacement_ratio", ratio, RATIO, at_least=True))
    return ExperimentResult("null-space", robot.name, request.seed, fingerprint(scenario), metrics, tuple(bars))


def elbow_displacement(series: RunSeries, push: tuple[float, float]) -> float:
    """Farthest that the elbow is from where it was at a push's start, up to its end [m]."""
    first = cycle_at(series, push[0])
    last = cycle_at(series, push[1])
    elbow = series.truth.frames[ELBOW]
    return float(np.linalg.norm(elbow[first : last + 1] - elbow[first], axis=1).max())


def posture_metric(run: Run) -> str:
    """Name the metric of the run's posture task, which without null-space compliance is that of the joints."""
    null_space = run.scenario.controller.null_space
    return "joint" if null_space is None else null_space.posture_metric


def _return_error(time_s: Array, distance: Array, pushes: dict[str, tuple[float, float]], event: str) -> float:
    """Largest error [m] from `SETTLE_S` after a push, or from `LAST_S` before the next one or the end if that is less.

    Up to the next push, or to the end.
    """
    later = [start for start, _ in pushes.values() if start > pushes[event][0]]
    end = min(later, default=float(time_s[-1]))
    begin = min(pushes[event][1] + SETTLE_S, end - LAST_S)
    return _largest(time_s, distance, (begin, end))


def _largest(time_s: Array, distance: Array, span: tuple[float, float]) -> float:
    return float(distance[(time_s >= span[0]) & (time_s <= span[1])].max())
