"""Anti-windup, section IV-B and Figs. 4, 5 of [Benallegue 2021]: the hand is held out of its place, then let go.

The same stiff hand moves the robot's hand away in every run: with the QP-based anti-windup (11), with the plain scaling
(10), without a limit, and with (11) and back-calculation, which is not in the paper. u_K is read from the controller's
trace, all motion from the plant's truth, forces from the sensor. Gains are those of the paper.

**Oscillation** is the peak to peak of a signal in the two seconds after the release, from when it first passes where it
comes to rest: the way back is no oscillation (`hand_runs.oscillation`). Forces have no rest to pass: theirs is the peak
to peak from `FORCE_FROM_S` after the release, the same window in every run, the start of the way back included.
Joints that are not saturated are compared with plain scaling in units of the band in which stiction alone decides
where a joint rests (`hand_runs.stiction_band`).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import anti_windup_figure, save
from experiments.hand_runs import (
    WINDOW_S,
    cycle_at,
    event_of,
    hand_error,
    load,
    oscillation,
    perform,
    settling_time,
    stiction_band,
    workplace,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-anti-windup"
METHODS: Final[dict[str, dict[str, Any]]] = {
    "qp": {"controller.anti_windup.method": "qp"},
    "scaling": {"controller.anti_windup.method": "scaling"},
    "none": {"controller.anti_windup.method": "none"},
    "conditioned": {"controller.anti_windup.method": "qp", "controller.anti_windup.back_calculation": 20.0},
}
OWN_FIELDS: Final = ("controller.anti_windup.method", "controller.anti_windup.back_calculation")
PERSON: Final = "person"
FORCE_FROM_S: Final = 0.02
"""After the release: the sensor's reading has fallen from the held force."""
GROWTH: Final = 3.0
RATIO: Final = 3.0
SETTLED_M: Final = 0.005
SMALLEST_M: Final = 1e-4
"""A smaller oscillation of the hand counts as this: some counts of an encoder."""
SMALLEST_N: Final = 0.02
"""As much for a force: one count of the sensor."""
RANGE_MARGIN_RAD: Final = 0.05
"""Closer to its range, a joint's limit and not the anti-windup would decide what happens."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed: the same push with each method.

    Raises:
        UsageError: an override of what the experiment sets itself, no push, too short a run.
        RunStoppedError: the HAL stopped a run.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS, events=(PERSON,), after_s=WINDOW_S)
    with workplace(request) as directory:
        runs: dict[str, RunSeries] = {}
        for number, (method, overrides) in enumerate(METHODS.items()):
            request.progress(number / len(METHODS), method)
            runs[method] = perform(request, SCENARIO, directory / method, overrides)
        if request.directory is not None:
            save(anti_windup_figure(runs, push_times(scenario)), directory / "anti-windup")
    return _result(request, scenario, runs)


def push_times(scenario: Run) -> tuple[float, float]:
    """Give start and release [s] of the push."""
    event = event_of(scenario, PERSON)
    return event.start_s, event.start_s + event.duration_s


def _result(request: ExperimentRequest, scenario: Run, runs: dict[str, RunSeries]) -> ExperimentResult:
    push = push_times(scenario)
    robot, config = scenario.robot.description, scenario.scenario.controller
    limit = config.anti_windup.torque_share * np.array([joint.torque_limit for joint in robot.joints])
    metrics: dict[str, Any] = {"joints": list(robot.joint_names), "gains": config.gains or "own"}
    for method, series in runs.items():
        metrics |= {f"{method}_{name}": value for name, value in measure(series, push, limit).items()}
    peak = {method: np.array(metrics[f"{method}_windup_over_limit"]) for method in runs}
    hand = {method: metrics[f"{method}_hand_oscillation_m"] for method in runs}
    joints = {method: np.array(metrics[f"{method}_joint_oscillation_rad"]) for method in runs}
    free = peak["qp"] < 1.0 - 1e-9
    band = stiction_band(scenario)
    metrics["stiction_band_rad"] = band.tolist()
    metrics["joints_not_saturated"] = [name for name, is_free in zip(robot.joint_names, free, strict=True) if is_free]
    metrics["force_oscillation_none_over_qp"] = metrics["none_force_oscillation_n"] / max(
        metrics["qp_force_oscillation_n"], SMALLEST_N
    )
    margin = float(np.min([metrics[f"{method}_range_margin_min_rad"] for method in runs]))
    bars = (
        Bar("qp_windup_over_limit_max", float(peak["qp"].max()), 1.0),
        Bar("qp_windup_over_bound_max", metrics["qp_windup_over_bound_max"], 1.0),
        Bar("none_windup_over_limit_max", float(peak["none"].max()), GROWTH, at_least=True),
        Bar("hand_oscillation_none_over_qp", hand["none"] / max(hand["qp"], SMALLEST_M), RATIO, at_least=True),
        Bar("free_joint_oscillation_excess", excess(joints["qp"] / band, joints["scaling"] / band, free), 1.0),
        Bar("range_margin_min_rad", margin, RANGE_MARGIN_RAD, at_least=True),
    )
    return ExperimentResult("anti-windup", robot.name, request.seed, fingerprint(scenario), metrics, bars)


def measure(series: RunSeries, push: tuple[float, float], limit: Array) -> dict[str, Any]:
    """Take the metrics of one run; `push` is start and release [s], `limit` τ_m (n,) [N·m]."""
    start_s, release_s = push
    trace, truth, joints = series.trace, series.truth, series.run.robot.description.joints
    in_torque = trace.torque_mode
    pushed = in_torque & (trace.time_s >= start_s)
    time_s, error = hand_error(series)
    distance = np.linalg.norm(error, axis=1)
    before = cycle_at(series, start_s)
    release = cycle_at(series, release_s)
    end = cycle_at(series, float(series.state.time_s[-1]))
    position = truth.position[before : end + 1]
    low = np.array([joint.position_min for joint in joints])
    high = np.array([joint.position_max for joint in joints])
    forces = np.linalg.norm(truth.world_forces[PERSON], axis=1)
    return {
        "windup_over_limit": (np.abs(trace.torque_limited[pushed]) / limit).max(axis=0).tolist(),
        "windup_over_bound_max": float((np.abs(trace.torque_limited) / trace.windup_bound)[in_torque].max()),
        "hand_oscillation_m": float(oscillation(truth.time_s, truth.hand, release_s).max()),
        "joint_oscillation_rad": oscillation(truth.time_s, truth.position, release_s).tolist(),
        "force_oscillation_n": force_swing(series, release_s),
        "hand_settling_time_s": settling_time(time_s, distance, release_s, SETTLED_M),
        "hand_error_end_m": float(np.linalg.norm(truth.hand[end] - trace.hand_desired[-1])),
        "displacement_at_release_m": float(np.linalg.norm(truth.hand[release] - truth.hand[before])),
        "push_force_max_n": float(forces.max()),
        "range_margin_min_rad": float(np.minimum(position - low, high - position).min()),
    }


def force_swing(series: RunSeries, release_s: float) -> float:
    """Peak to peak [N] of the measured force's worst component, from `FORCE_FROM_S` to `WINDOW_S` after a release."""
    time_s = series.state.time_s
    window = (time_s >= release_s + FORCE_FROM_S) & (time_s < release_s + WINDOW_S)
    return float(np.ptp(series.state.wrench[window, :3], axis=0).max())


def excess(one: Array, other: Array, chosen: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
    """Largest amount by which one exceeds the other (n,) among the chosen; NaN where none is chosen."""
    return float((one - other)[chosen].max()) if chosen.any() else float("nan")
