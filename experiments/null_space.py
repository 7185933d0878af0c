"""Null-space compliance, section IV-C and Figs. 6-8 of [Benallegue 2021]: the hand is pushed, then the elbow.

The same two pushes are made with the null-space compliant law and without it, at the same gains: the tuned set with the
lower hand gains of the scenario. The elbow's force is `FORCE_OVER_STICTION` times what breaks the true friction of the
seed's joints (`hand_runs.stiction_force`): below it nothing moves under any law. All figures are the plant's truth.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import null_space_figure, save
from experiments.hand_runs import hand_error, load, perform, rest_position, stiction_force, workplace
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-null-space"
VARIANTS: Final[dict[str, dict[str, Any]]] = {"with": {}, "without": {"controller.null_space": None}}
OWN_FIELDS: Final = ("controller.null_space", "plant.world.events.elbow.force_in_world")
ELBOW: Final = "elbow_pitch_link"
DIRECTION: Final = (0.0, 1.0, 0.0)
FORCE_OVER_STICTION: Final = 1.25
RATIO: Final = 3.0
ERROR_M: Final = 0.01
RETURN_M: Final = 0.003
SETTLE_S: Final = 3.0
"""After a release: the error from then on is the return error."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed, with and without.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped a run.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS)
    stiction = stiction_force(scenario, ELBOW, DIRECTION)
    force = [FORCE_OVER_STICTION * stiction * component for component in DIRECTION]
    with workplace(request) as directory:
        runs: dict[str, RunSeries] = {}
        for number, (name, overrides) in enumerate(VARIANTS.items()):
            request.progress(number / len(VARIANTS), name)
            own = {"plant.world.events.elbow.force_in_world": force, **overrides}
            runs[name] = perform(request, SCENARIO, directory / name, own)
        if request.directory is not None:
            save(null_space_figure(runs, ELBOW), directory / "null-space")
    return _result(request, scenario, runs, stiction)


def spans(scenario: Run) -> dict[str, tuple[float, float]]:
    """First and last time [s] of each push."""
    events = scenario.scenario.plant.world.events
    return {event.name: (event.start_s, event.start_s + event.duration_s) for event in events}


def _result(request: ExperimentRequest, scenario: Run, runs: dict[str, RunSeries], stiction: float) -> ExperimentResult:
    robot, pushes = scenario.robot.description, spans(scenario)
    metrics: dict[str, Any] = {
        "gains": scenario.scenario.controller.gains or "own",
        "elbow_stiction_n": stiction,
        "elbow_force_n": FORCE_OVER_STICTION * stiction,
    }
    bars = []
    moved = {}
    for name, series in runs.items():
        time_s, error = hand_error(series)
        distance = np.linalg.norm(error, axis=1)
        moved[name] = elbow_displacement(series, pushes["elbow"])
        back = [_return_error(time_s, distance, pushes, event) for event in pushes]
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
    first, _ = rest_position(series, push[0])
    last, _ = rest_position(series, push[1])
    elbow = series.truth.frames[ELBOW]
    return float(np.linalg.norm(elbow[first : last + 1] - elbow[first], axis=1).max())


def _return_error(time_s: Array, distance: Array, pushes: dict[str, tuple[float, float]], event: str) -> float:
    """Largest error [m] from `SETTLE_S` after a push until the next one, or at the end if that comes first."""
    begin = min(pushes[event][1] + SETTLE_S, float(time_s[-1]) - 0.1)
    later = [start for start, _ in pushes.values() if start > pushes[event][0]]
    end = min(later, default=float(time_s[-1]))
    if begin >= end:
        begin = end - 0.1
    return _largest(time_s, distance, (begin, end))


def _largest(time_s: Array, distance: Array, span: tuple[float, float]) -> float:
    return float(distance[(time_s >= span[0]) & (time_s <= span[1])].max())
