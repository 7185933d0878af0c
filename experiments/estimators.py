"""Estimators compared: [Del Prete 2016]'s Savitzky-Golay filter, centre and end of its window, and a Kalman filter.

Each of them controls the stairs-climbing swing at K₆ = 0.25 and the sinusoidal force, with motors identified on the
same plant; the centre's once more without the prediction of the velocity (`predict_velocity`), as in the paper. All
figures are of these runs and against the plant's truth. What is desired is the same, the motion that is estimated is
each one's own. The true torque is motor torque and friction, as the estimate means it.

    noise    standard deviation of estimated velocity and torque while the robot stands still under position control;
             and in the swing: of what is left of the aligned error when its mean over 80 samples is taken away
    delay    of velocity and torque in the swing, by the best-fitting shift over all joints that move
    error    root mean square over these joints in the swing: as it comes, late, and aligned, the delay taken away
    control  root mean square and maximum of q^d − q in the swing; of the vertical force's error over its amplitude

The encoders have no noise but their steps: at rest they give one number, and a filter of them alone no noise.

An estimator that cannot control a run has no figures for it; the bars ask for all to finish, and that the centre's
delay is that of its window.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller_service.errors import ControllerError
from controller_service.savitzky_golay import smooth
from deploy.errors import RunStoppedError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments.figures import estimators_figure, save
from experiments.hand_runs import common_ticks, load, perform, workplace
from experiments.leg_runs import identified_motors
from experiments.leg_signals import (
    CONFIG,
    WINDOW,
    best_shift,
    contact,
    in_span,
    motion,
    phase_span,
    rms,
    sine_spans,
    wrench_phase,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

STAIRS: Final = "leg6-stairs"
FORCE: Final = "leg6-force-sine"
SWING: Final = "swing"
SETTLE: Final = "settle"
GOLAY: Final = f"{CONFIG}.savitzky_golay.evaluate_at"
ESTIMATORS: Final[dict[str, dict[str, Any]]] = {
    "centre": {f"{CONFIG}.estimator": "savitzky_golay", GOLAY: "centre"},
    "unpredicted": {f"{CONFIG}.estimator": "savitzky_golay", GOLAY: "centre", f"{CONFIG}.predict_velocity": False},
    "end": {f"{CONFIG}.estimator": "savitzky_golay", GOLAY: "end"},
    "kalman": {f"{CONFIG}.estimator": "kalman"},
}
"""With `unpredicted`, friction is fed forward from the late velocity, as in the paper; the others are not late."""
STAIRS_GAIN: Final = 0.25
FORCE_GAIN: Final = 0.1
"""K₆ of the runs."""
FORCE_S: Final = 6.5
"""Length of the run with the sine: two whole periods."""
OWN_FIELDS: Final = (
    *(f"{CONFIG}.{name}" for name in ("motors", "motors_from", "position_gain", "predict_velocity")),
    *(f"{CONFIG}.{name}" for name in ("estimator", "savitzky_golay.evaluate_at")),
    "controller.phases",
    "plant.world",
    "plant.initial_posture",
    "plant.truth_frames",
    "duration_s",
)
MOVES_RAD: Final = 0.02
"""A joint whose true position changes by less in the swing is left out."""
SHIFT_S: Final = 0.1
"""Largest delay that is looked for."""
DELAY_TOLERANCE_S: Final = 0.003
SMALLEST: Final = 1e-9
"""Less is a rounding error, in any unit of the table."""


@dataclass(frozen=True, slots=True)
class Estimates:
    """What was believed and what was true in the swing, at the same times: K cycles, m joints that move."""

    time_s: Array
    joints: tuple[str, ...]
    velocity: Array
    """(K, m) [rad/s]."""
    true_velocity: Array
    torque: Array
    """(K, m) [N·m]."""
    true_torque: Array


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what the experiment sets itself.
        IdentificationError: the motors cannot be identified.

    """
    scenario = load(request, STAIRS, OWN_FIELDS)
    with workplace(request) as directory:
        request.progress(0.0, "identifying the motors")
        own = {f"{CONFIG}.motors": identified_motors(request, directory)}
        metrics: dict[str, dict[str, float]] = {}
        estimates: dict[str, Estimates] = {}
        for number, (name, overrides) in enumerate(ESTIMATORS.items()):
            request.progress(0.5 + 0.5 * number / len(ESTIMATORS), name)
            stairs = _attempt(
                request,
                STAIRS,
                directory / name / "stairs",
                {**own, **overrides, f"{CONFIG}.position_gain": STAIRS_GAIN},
            )
            force = _attempt(
                request,
                FORCE,
                directory / name / "force",
                {
                    **own,
                    **overrides,
                    f"{CONFIG}.position_gain": FORCE_GAIN,
                    "duration_s": FORCE_S,
                    "plant.world.events": [],
                },
            )
            metrics[name] = {"finished": float(stairs is not None and force is not None)}
            if stairs is not None:
                estimates[name] = estimates_of(stairs)
                metrics[name] |= of_estimates(estimates[name], stairs) | of_motion(stairs)
            if force is not None:
                metrics[name] |= of_force(force)
        if request.directory is not None:
            (directory / "estimators.md").write_text(table(metrics), encoding="utf-8")
            if estimates:
                save(estimators_figure(estimates, metrics), directory / "estimators")
    return evaluate(request, scenario, metrics)


def _attempt(request: ExperimentRequest, scenario: str, directory: Path, overrides: dict[str, Any]) -> RunSeries | None:
    """Run; None: the leg could not be controlled."""
    try:
        return perform(request, scenario, directory, overrides)
    except (ControllerError, RunStoppedError):
        return None


def estimates_of(series: RunSeries) -> Estimates:
    """Take velocities and torques of the joints that the swing moves out of a run."""
    of_trace, of_truth = common_ticks(series)
    chosen = in_span(series.trace.time_s[of_trace], phase_span(series.run, SWING))
    of_trace, of_truth = of_trace[chosen], of_truth[chosen]
    moves = np.ptp(series.truth.position[of_truth], axis=0) >= MOVES_RAD
    names = series.run.robot.description.joint_names
    return Estimates(
        series.trace.time_s[of_trace],
        tuple(name for name, moved in zip(names, moves, strict=True) if moved),
        series.trace.estimated.velocity[of_trace][:, moves],
        series.truth.velocity[of_truth][:, moves],
        series.trace.estimated.torque[of_trace][:, moves],
        series.truth.joint_torque[of_truth][:, moves],
    )


def of_estimates(each: Estimates, series: RunSeries) -> dict[str, float]:
    """Give noise, delay and errors of an estimator."""
    period_s = series.run.robot.description.period_s
    metrics: dict[str, float] = {}
    settle = in_span(series.trace.time_s, phase_span(series.run, SETTLE))
    for name, estimate, truth, rest, unit in (
        ("velocity", each.velocity, each.true_velocity, series.trace.estimated.velocity, "rad_s"),
        ("torque", each.torque, each.true_torque, series.trace.estimated.torque, "nm"),
    ):
        still = rest[settle][np.isfinite(rest[settle]).all(axis=1)]
        delay_s = best_shift(estimate, truth, period_s, SHIFT_S)
        late, aligned = estimate - truth, _aligned(estimate, truth, delay_s / period_s)
        metrics |= {
            f"{name}_noise_rest_{unit}": float(np.sqrt(np.mean(still.std(axis=0) ** 2))),
            f"{name}_noise_motion_{unit}": float(
                np.sqrt(np.mean((aligned - smooth(aligned, WINDOW, 1, period_s)) ** 2))
            ),
            f"{name}_delay_s": delay_s,
            f"{name}_error_aligned_{unit}": float(np.sqrt(np.mean(aligned**2))),
            f"{name}_error_late_{unit}": float(np.sqrt(np.mean(late**2))),
        }
    return metrics


def _aligned(estimate: Array, truth: Array, shift: float) -> Array:
    """Error (K − ⌈|s|⌉ − 1, m) of an estimate (K, m) less the truth (K, m) of `shift` samples before."""
    times = np.arange(len(truth), dtype=np.float64)
    then = times - (0.0 if np.isnan(shift) else shift)
    inside = (then >= 0.0) & (then <= times[-1])
    before = np.column_stack([np.interp(then[inside], times, column) for column in truth.T])
    error: Array = estimate[inside] - before
    return error


def of_motion(series: RunSeries) -> dict[str, float]:
    """Give errors of control in the swing, over the joints that move."""
    swing = motion(series, phase_span(series.run, SWING))
    error = swing.error[:, np.ptp(swing.desired, axis=0) >= MOVES_RAD]
    return {
        "position_error_rms_rad": float(np.sqrt(np.mean(error**2))),
        "position_error_max_rad": float(np.abs(error).max()),
    }


def of_force(series: RunSeries) -> dict[str, float]:
    """Give errors of the vertical force, smoothed, over whole periods of its sine."""
    force = contact(series)
    chosen = in_span(force.time_s, sine_spans(series.run).before)
    amplitude = wrench_phase(series.run)[1].amplitude[2]
    error = force.smooth[chosen, 2] - force.reference[chosen, 2]
    return {
        "force_error_rms_ratio": float(rms(error)) / amplitude,
        "force_error_max_ratio": float(np.abs(error).max()) / amplitude,
    }


ROWS: Final = (
    ("velocity noise at rest", "velocity_noise_rest_rad_s", 1e3, "mrad/s"),
    ("velocity noise in motion", "velocity_noise_motion_rad_s", 1e3, "mrad/s"),
    ("velocity delay", "velocity_delay_s", 1e3, "ms"),
    ("velocity error, aligned", "velocity_error_aligned_rad_s", 1e3, "mrad/s"),
    ("velocity error, as it comes", "velocity_error_late_rad_s", 1e3, "mrad/s"),
    ("torque noise at rest", "torque_noise_rest_nm", 1.0, "N·m"),
    ("torque noise in motion", "torque_noise_motion_nm", 1.0, "N·m"),
    ("torque delay", "torque_delay_s", 1e3, "ms"),
    ("torque error, aligned", "torque_error_aligned_nm", 1.0, "N·m"),
    ("torque error, as it comes", "torque_error_late_nm", 1.0, "N·m"),
    ("position error, rms", "position_error_rms_rad", 1e3, "mrad"),
    ("position error, largest", "position_error_max_rad", 1e3, "mrad"),
    ("force error, rms over amplitude", "force_error_rms_ratio", 100.0, "%"),
    ("force error, largest over amplitude", "force_error_max_ratio", 100.0, "%"),
)
"""Of the table: name, metric, factor, unit."""


def table(metrics: dict[str, dict[str, float]]) -> str:
    """Write the comparison as Markdown; a run that did not finish has no numbers."""
    lines = [f"| | unit | {' | '.join(metrics)} |", "|---" * (len(metrics) + 2) + "|"]
    for name, metric, factor, unit in ROWS:
        cells = [_written(factor * of[metric]) if metric in of else "–" for of in metrics.values()]
        lines.append(f"| {name} | {unit} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _written(value: float) -> str:
    """Write three digits, and rounding errors as the zero that they are."""
    return f"{value:.3g}" if abs(value) > SMALLEST else "0"


def evaluate(request: ExperimentRequest, scenario: Run, metrics: dict[str, dict[str, float]]) -> ExperimentResult:
    """Name all figures by their estimator, and set the bars."""
    told: dict[str, Any] = {f"{name}_{key}": value for name, of in metrics.items() for key, value in of.items()}
    description = scenario.robot.description
    window = scenario.scenario.controller.position_torque
    assert window is not None
    expected_s = 0.5 * (window.savitzky_golay.window - 1) * description.period_s
    bars = [Bar(f"{name}_finished", of["finished"], 1.0, at_least=True) for name, of in metrics.items()]
    for signal in ("velocity", "torque"):
        difference_s = abs(metrics["centre"].get(f"{signal}_delay_s", float("nan")) - expected_s)
        bars.append(Bar(f"centre_{signal}_delay_difference_s", difference_s, DELAY_TOLERANCE_S))
    return ExperimentResult("estimators", description.name, request.seed, fingerprint(scenario), told, tuple(bars))
