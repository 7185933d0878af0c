"""Dual compliance, section IV-C and Fig. 9 of [Benallegue 2021]: the elbow gives way alone, the hand when it is led.

The elbow is pushed by `FORCE_OVER_STICTION` times the force that breaks the true friction of the seed's joints, and
the hand stays; then a person leads the hand with more than the threshold force: the admittance takes it along until it
is let go, at once and in motion, and the place where that happens is kept. Gains are the tuned set with the lower hand
gains of the scenario.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import dual_compliance_figure, save
from experiments.hand_runs import cycle_at, load, perform, stiction_force, workplace
from experiments.null_space import (
    DIRECTION,
    ELBOW,
    ELBOW_FORCE,
    FORCE_OVER_STICTION,
    elbow_displacement,
    elbow_push,
    spans,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-dual-compliance"
OWN_FIELDS: Final = (ELBOW_FORCE,)
LEAD_S: Final = 4.0
SETTLE_S: Final = 2.0
"""After the hand was let go: how long its place is watched, at least."""
DRIFT_M: Final = 0.01
ELBOW_M: Final = 0.05
MOVED_M: Final = 0.10
KEPT_M: Final = 0.01


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped the run.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS, events=("elbow", "hand"), after_s=SETTLE_S)
    stiction = stiction_force(scenario, ELBOW, DIRECTION)
    with workplace(request) as directory:
        request.progress(0.0, "pushed and led")
        series = perform(request, SCENARIO, directory / "run", elbow_push(stiction))
        if request.directory is not None:
            save(dual_compliance_figure(series, ELBOW), directory / "dual-compliance")
    return _result(request, scenario, series, stiction)


def _result(request: ExperimentRequest, scenario: Run, series: RunSeries, stiction: float) -> ExperimentResult:
    robot, pushes = scenario.robot.description, spans(scenario)
    hand = series.truth.hand
    elbow_from, elbow_to = pushes["elbow"]
    lead_from, lead_to = pushes["hand"]
    start = cycle_at(series, elbow_from)
    led = cycle_at(series, lead_from)
    drift = float(_distances(hand, start, led).max())
    in_time = cycle_at(series, min(lead_from + LEAD_S, lead_to))
    moved = float(np.linalg.norm(hand[in_time] - hand[led]))
    release = cycle_at(series, lead_to)
    end = cycle_at(series, float(series.state.time_s[-1]))
    kept = float(_distances(hand, release, end).max())
    desired = series.trace.hand_desired[-1]
    active = series.trace.admittance
    times = series.trace.time_s
    led_until = float(times[active][-1]) if active.any() else float("nan")
    early = active & (times < lead_from)
    metrics: dict[str, Any] = {
        "gains": scenario.scenario.controller.gains or "own",
        "elbow_stiction_n": stiction,
        "elbow_force_n": FORCE_OVER_STICTION * stiction,
        "elbow_displacement_m": elbow_displacement(series, (elbow_from, elbow_to)),
        "hand_drift_elbow_push_m": drift,
        "hand_moved_m": moved,
        "hand_kept_within_m": kept,
        "hand_error_end_m": float(np.linalg.norm(hand[end] - desired)),
        "lead_force_max_n": float(np.linalg.norm(series.truth.world_forces["hand"], axis=1).max()),
        "admittance_on_s": float(times[active][0]) if active.any() else None,
        "admittance_off_s": led_until,
        "admittance_ticks_before_lead": int(np.count_nonzero(early)),
    }
    bars = (
        Bar("hand_drift_elbow_push_m", drift, DRIFT_M),
        Bar("elbow_displacement_m", float(metrics["elbow_displacement_m"]), ELBOW_M, at_least=True),
        Bar("hand_moved_m", moved, MOVED_M, at_least=True),
        Bar("hand_kept_within_m", kept, KEPT_M),
        Bar("admittance_off_s", led_until, lead_to, at_least=True),
        Bar("admittance_ticks_before_lead", float(np.count_nonzero(early)), 0.0),
    )
    return ExperimentResult("dual-compliance", robot.name, request.seed, fingerprint(scenario), metrics, bars)


def _distances(path: Array, first: int, last: int) -> Array:
    return np.asarray(np.linalg.norm(path[first : last + 1] - path[first], axis=1), np.float64)
