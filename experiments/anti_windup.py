"""Anti-windup, section IV-B and Figs. 4, 5 of [Benallegue 2021]: the hand is held out of its place, then let go.

The same held displacement is applied in three runs: with the QP-based anti-windup (11), with the plain scaling (10),
and without a limit. u_K is read from the controller's trace, all motion and force from the plant's truth and the
sensor. Oscillation is what swings beyond the place of rest within two seconds of the release
(`hand_runs.oscillation`). Gains are those of the paper (`controller.gains: paper`).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import anti_windup_figure, save
from experiments.hand_runs import (
    WINDOW_S,
    hand_error,
    load,
    oscillation,
    perform,
    return_time,
    settling_time,
    workplace,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-anti-windup"
METHODS: Final = ("qp", "scaling", "none")
OWN_FIELDS: Final = ("controller.anti_windup.method",)
PERSON: Final = "person"
GROWTH: Final = 3.0
RATIO: Final = 3.0
SETTLED_M: Final = 0.005
SMALLEST_M: Final = 1e-4
SMALLEST_RAD: Final = 1e-4
"""Smaller oscillations count as this: some counts of an encoder."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed: the same push with each method.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped a run.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS)
    with workplace(request) as directory:
        runs: dict[str, RunSeries] = {}
        for number, method in enumerate(METHODS):
            request.progress(number / len(METHODS), method)
            runs[method] = perform(request, SCENARIO, directory / method, {"controller.anti_windup.method": method})
        if request.directory is not None:
            save(anti_windup_figure(runs, push_times(scenario)), directory / "anti-windup")
    return _result(request, scenario, runs)


def push_times(scenario: Run) -> tuple[float, float]:
    """Start and release [s] of the held displacement."""
    event = next(event for event in scenario.scenario.plant.world.events if event.name == PERSON)
    return event.start_s, event.start_s + event.duration_s


def _result(request: ExperimentRequest, scenario: Run, runs: dict[str, RunSeries]) -> ExperimentResult:
    start_s, release_s = push_times(scenario)
    robot = scenario.robot.description
    share = scenario.scenario.controller.anti_windup.torque_share
    limit = share * np.array([joint.torque_limit for joint in robot.joints])
    metrics: dict[str, Any] = {"joints": list(robot.joint_names), "gains": scenario.scenario.controller.gains or "own"}
    hand, force, joints, peak = {}, {}, {}, {}
    for method, series in runs.items():
        window = series.trace.torque_mode & (series.trace.time_s >= start_s)
        peak[method] = np.nanmax(np.abs(series.trace.torque_limited[window]) / limit, axis=0)
        hand[method] = float(oscillation(series.truth.time_s, series.truth.hand, release_s).max())
        joints[method] = oscillation(series.truth.time_s, series.truth.position, release_s)
        force[method] = _force_swing(series, release_s)
        time_s, error = hand_error(series)
        distance = np.linalg.norm(error, axis=1)
        metrics |= {
            f"{method}_windup_over_limit": peak[method].tolist(),
            f"{method}_hand_oscillation_m": hand[method],
            f"{method}_force_oscillation_n": force[method],
            f"{method}_joint_oscillation_rad": joints[method].tolist(),
            f"{method}_hand_settling_time_s": settling_time(time_s, distance, release_s, SETTLED_M),
            f"{method}_hand_error_end_m": float(distance[-1]),
            f"{method}_push_force_max_n": float(np.linalg.norm(series.truth.world_forces[PERSON], axis=1).max()),
        }
    within = runs["qp"].trace
    over = np.nanmax(np.abs(within.torque_limited) / within.windup_bound)
    free = peak["qp"] < 1.0 - 1e-9
    against = _worst_ratio(joints["qp"][free], joints["scaling"][free])
    metrics["joints_not_saturated"] = [name for name, is_free in zip(robot.joint_names, free, strict=True) if is_free]
    metrics["windup_over_bound_max"] = float(over)
    bars = (
        Bar("qp_windup_over_limit_max", float(peak["qp"].max()), 1.0),
        Bar("windup_over_bound_max", float(over), 1.0),
        Bar("none_windup_over_limit_max", float(peak["none"].max()), GROWTH, at_least=True),
        Bar("hand_oscillation_none_over_qp", hand["none"] / max(hand["qp"], SMALLEST_M), RATIO, at_least=True),
        Bar("force_oscillation_none_over_qp", force["none"] / force["qp"], RATIO, at_least=True),
        Bar("free_joint_oscillation_qp_over_scaling", against, 1.0),
    )
    return ExperimentResult("anti-windup", robot.name, request.seed, fingerprint(scenario), metrics, bars)


def _force_swing(series: RunSeries, release_s: float) -> float:
    """Peak to peak [N] of the measured force's worst component once the hand is back, up to `WINDOW_S` after release.

    The way back accelerates the hand in every run alike; what the sensor feels afterwards is oscillation, and noise.
    """
    time_s = series.state.time_s
    back_s = return_time(series.truth.time_s, series.truth.hand, release_s)
    window = (time_s >= back_s) & (time_s < release_s + WINDOW_S)
    return float(np.ptp(series.state.wrench[window, :3], axis=0).max())


def _worst_ratio(one: Array, other: Array) -> float:
    """Largest ratio of oscillations [rad], those too small to matter set equal; 0 for no joints."""
    ratios = np.maximum(one, SMALLEST_RAD) / np.maximum(other, SMALLEST_RAD)
    return float(ratios.max(initial=0.0))
