"""Tracking among unknown obstacles, section IV-D and Figs. 10, 11 of [Benallegue 2021], with null-space compliance.

The hand draws a closed shape several times in the y-z plane while elbow and forearm run into rigid poles. Laps, errors,
contacts and energy are the plant's truth; orientation and x are to stay. Gains are the tuned set.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import obstacle_track_figure, save
from experiments.hand_runs import common_ticks, load, perform, workplace
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "arm9-obstacle-track"
ERROR_M: Final = 0.02
CONTACTS: Final = 3
APART_S: Final = 0.2
"""Touches of a pole nearer in time than this are one contact."""
MEAN_S: Final = 0.05
IMPACT_S: Final = 0.05
"""Around the touches of an obstacle: where the energy of impacts is looked for."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped the run.

    """
    scenario = load(request, SCENARIO)
    with workplace(request) as directory:
        request.progress(0.0, "tracking")
        series = perform(request, SCENARIO, directory / "run", {})
        if request.directory is not None:
            save(obstacle_track_figure(series, contact_times(series)), directory / "obstacle-track")
    return _result(request, scenario, series)


def contact_times(series: RunSeries) -> dict[str, list[float]]:
    """Find the times [s] at which contacts with each obstacle begin."""
    names = [obstacle.name for obstacle in series.run.scenario.plant.world.obstacles]
    times: dict[str, list[float]] = {}
    for name in names:
        touching = np.array(
            [any(name == sample.other for sample in samples) for samples in series.truth.contacts], np.bool_
        )
        at = series.truth.time_s[touching]
        begins = np.flatnonzero(np.diff(at, prepend=-np.inf) > APART_S)
        times[name] = [float(time) for time in at[begins]]
    return times


def _result(request: ExperimentRequest, scenario: Run, series: RunSeries) -> ExperimentResult:
    robot, truth = scenario.robot.description, series.truth
    of_trace, of_truth = common_ticks(series)
    tracking = np.array([series.trace.phase[k] == "track" for k in of_trace])
    ticks, states = of_trace[tracking], of_truth[tracking]
    error = truth.hand[states] - series.trace.hand_desired[ticks]
    angle = _angle(truth.hand_orientation[states], series.trace.orientation_desired[ticks])
    laps = _laps(truth.hand[states], series.trace.hand_desired[ticks])
    wanted = max(phase.hand_path.laps for phase in scenario.scenario.controller.phases if phase.hand_path is not None)
    contacts = contact_times(series)
    begins = sorted(time for times in contacts.values() for time in times)
    limits = np.array([joint.torque_limit for joint in robot.joints])
    over = float(np.nanmax(np.abs(series.trace.torque_commanded) / limits))
    applied = float(np.nanmax(np.abs(truth.motor_torque_substeps) / limits))
    largest = np.abs(error).max(axis=0)
    metrics: dict[str, Any] = {
        "gains": scenario.scenario.controller.gains or "own",
        "laps_done": laps,
        "error_max_xyz_m": largest.tolist(),
        "error_rms_xyz_m": np.sqrt(np.mean(error**2, axis=0)).tolist(),
        "orientation_error_max_rad": float(angle.max()),
        "contacts": len(begins),
        "contacts_by_obstacle": {name: float(len(times)) for name, times in contacts.items()},
        "links_touched": sorted({sample.link for samples in truth.contacts for sample in samples}),
        "contact_force_max_n": {name: float(_forces(series, name).max()) for name in contacts},
        "contact_force_mean_50ms_max_n": {name: _largest_mean(series, name) for name in contacts},
        "kinetic_energy_at_impacts_max_j": _impact_energy(series),
        "torque_commanded_over_limit_max": over,
        "torque_applied_over_limit_max": applied,
    }
    bars = (
        Bar("laps_done", laps, wanted - 0.01, at_least=True),
        Bar("contacts", float(len(begins)), float(CONTACTS), at_least=True),
        Bar("error_max_x_m", float(largest[0]), ERROR_M),
        Bar("error_max_y_m", float(largest[1]), ERROR_M),
        Bar("error_max_z_m", float(largest[2]), ERROR_M),
        Bar("torque_commanded_over_limit_max", over, 1.0),
        Bar("torque_applied_over_limit_max", applied, 1.0),
    )
    return ExperimentResult("obstacle-track", robot.name, request.seed, fingerprint(scenario), metrics, bars)


def _laps(hand: Array, desired: Array) -> float:
    """How often the true hand (K, 3) went round the middle of the desired shape in the y-z plane."""
    middle = 0.5 * (desired.max(axis=0) + desired.min(axis=0))
    y, z = (hand - middle)[:, 1], (hand - middle)[:, 2]
    angle = np.unwrap(np.arctan2(z, y))
    return float(abs(angle[-1] - angle[0]) / (2.0 * np.pi))


def _angle(one: Array, other: Array) -> Array:
    """Angles (K,) [rad] between orientations (K, 4)."""
    dots = np.abs(np.einsum("ij,ij->i", one, other))
    return np.asarray(2.0 * np.arccos(np.minimum(dots, 1.0)), np.float64)


def _forces(series: RunSeries, name: str) -> Array:
    """Force (K,) [N] of an obstacle on the links that touch it, the sum of the norms: samples of one substep each."""
    sums = [
        sum(float(np.linalg.norm(sample.force_in_world)) for sample in samples if sample.other == name)
        for samples in series.truth.contacts
    ]
    return np.array(sums, np.float64)


def _largest_mean(series: RunSeries, name: str) -> float:
    """Largest mean force [N] over `MEAN_S`: what the arm leans on the obstacle with, its rattling averaged."""
    width = max(1, round(MEAN_S / series.run.robot.description.period_s))
    return float(np.convolve(_forces(series, name), np.full(width, 1.0 / width), "valid").max())


def _impact_energy(series: RunSeries) -> float:
    """Largest kinetic energy [J] within `IMPACT_S` of any touch of an obstacle."""
    energy = series.truth.kinetic_energy
    names = {obstacle.name for obstacle in series.run.scenario.plant.world.obstacles}
    touching = np.array(
        [any(sample.other in names for sample in samples) for samples in series.truth.contacts], np.bool_
    )
    width = round(IMPACT_S / series.run.robot.description.period_s)
    near = np.convolve(touching, np.ones(2 * width + 1), "same")[: len(energy)] > 0.5
    return float(energy[near].max(initial=0.0))
