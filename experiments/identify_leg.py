"""Motor identification, section 5.2, Table 1 and Figs. 1 and 3 of [Del Prete 2016], beside the plant's true values.

Both data collections of section 3.4 are run and the leg's motors identified from their logs as from those of a real
robot. The truth is the drives' law at the joint, with the motors' true torque constant (`torque_scale`, s), friction of
the seed and gains that depend on the velocity's sign, σ = ±1:

    k_τ = 1 / (s k_p (1 + α_p σ)),    k_v = (k_d (1 + α_d σ) + v / s) / (k_p (1 + α_p σ)),

without dead zone and dry friction, which the linear model lacks. A model that seldom over-estimates |Δq| lies below:
where friction helps to hold a load, the drive needs less than k_τ τ.

Over-estimation is counted over all samples of both collections; its size is relative to the joint's largest |Δq|.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller_service.motor_fit import MotorFit, fit_asymmetric, fit_least_squares
from deploy.errors import UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.identify import FitMethod, Identification, IdentifyOptions, fit_joint, identify
from deploy.series import Array
from experiments.figures import friction_figure, motor_figure, save
from experiments.hand_runs import workplace
from experiments.leg_runs import COLLECTIONS, collect, plant_overrides
from plant_service.friction import friction_factors
from schemas.fingerprint import fingerprint
from schemas.load import Run

WEIGHTS: Final = (1.0, 10.0, 100.0, 1e3, 1e4)
QP_SAMPLES: Final = 1000
FIGURES: Final = {"torque": "R_HIP_P", "friction": "R_ANKLE_P"}
"""Joint of the paper's Fig. 1 and Fig. 3."""
RATE: Final = 0.10
SIZE: Final = 0.05
RATE_RATIO: Final = 0.5
"""Over-estimation rate over that of the symmetric fit."""
QP_DIFFERENCE: Final = 1e-6
TORQUE_REACHED: Final = 0.4
VELOCITY_REACHED: Final = 0.6
"""Of the limits: "the collected data properly cover the whole operative region" (3.4)."""


@dataclass(frozen=True, slots=True)
class TrueMotors:
    """(6) of the plant's drives, of the description's joints: (3, n) at σ = −1, 0, 1."""

    torque_gain: Array
    """[rad/(N·m)]."""
    velocity_gain: Array
    """[s]."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what is no part of robot or plant.
        RunStoppedError: the HAL stopped a run.
        IdentificationError: a joint's samples do not tell its model.

    """
    if others := sorted(request.overrides.keys() - plant_overrides(request.overrides).keys()):
        raise UsageError(
            f"--set {others[0]}: this experiment's motions are its own; set what lies below plant or robot"
        )
    with workplace(request) as directory:
        told = replace(request, progress=lambda share, what: request.progress(0.8 * share, what))
        logs = collect(told, directory)
        request.progress(0.8, "identifying")
        result = identify([*logs.values()], IdentifyOptions(piecewise=True), names=[*COLLECTIONS.values()])
        run_ = next(iter(logs.values())).run
        truth = true_motors(run_)
        outcome = _result(request, run_, result, truth)
        if request.directory is not None:
            (directory / "table-1.md").write_text(table(result, truth), encoding="utf-8")
            _draw(result, directory)
    return outcome


def true_motors(run: Run) -> TrueMotors:
    """Compute (6) of the plant's drives from its configuration."""
    joints, plant = run.robot.description.joints, run.scenario.plant
    factors = friction_factors(len(joints), plant.friction_error, run.scenario.seed)
    viscous = plant.friction.viscous * np.array([joint.gear_ratio for joint in joints]) ** 2 * factors
    sigma = np.array([[-1.0], [0.0], [1.0]])
    stiffness = np.array([joint.drive.position_gain for joint in joints])
    damping = np.array([joint.drive.velocity_gain for joint in joints])
    stiffness = stiffness * (1.0 + plant.drive_asymmetry.position_gain * sigma)
    damping = damping * (1.0 + plant.drive_asymmetry.velocity_gain * sigma)
    return TrueMotors(1.0 / (plant.torque_scale * stiffness), (damping + viscous / plant.torque_scale) / stiffness)


def table(result: Identification, truth: TrueMotors) -> str:
    """Write Table 1 with the true values beside it, as Markdown."""
    lines = [
        "| joint | 10³ k_τ [rad/(N·m)] | true (σ = 1 … −1) | 10³ k_v [s] | true (σ = 1 … −1) |",
        "|---|---|---|---|---|",
    ]
    for index, each in enumerate(result.joints):
        columns = [each.joint.replace("_", " ")]
        for gain, true, digits in (
            (each.fit.torque_gain, truth.torque_gain, 4),
            (each.fit.velocity_gain, truth.velocity_gain, 2),
        ):
            low, middle, high = 1e3 * true[::-1, index]  # σ = 1, 0, −1
            columns.append(f"{1e3 * gain:.{digits}f}")
            columns.append(f"{middle:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})")
        lines.append(f"| {' | '.join(columns)} |")
    lines += [
        "",
        "Over-estimated samples, the worst joint: rate, and largest size over the largest abs(Δq)",
        "",
        "| w | two-stage | one stage |",
        "|---|---|---|",
    ]
    for weight in WEIGHTS:
        worst = []
        for method in (FitMethod.TWO_STAGE, FitMethod.ASYMMETRIC):
            of = [fit.statistics for fit in _fits(result, method, weight)]
            rate = max(each.over_estimation_rate for each in of)
            size = max(each.largest_over_estimation_relative for each in of)
            worst.append(f"{100.0 * rate:.1f} %, {100.0 * size:.1f} %")
        lines.append(f"| {weight:g} | {' | '.join(worst)} |")
    return "\n".join(lines) + "\n"


def _result(request: ExperimentRequest, run: Run, result: Identification, truth: TrueMotors) -> ExperimentResult:
    names = [each.joint for each in result.joints]
    fits = [each.fit for each in result.joints]
    symmetric = _fits(result, FitMethod.LEAST_SQUARES, 1.0)
    true_torque, true_velocity = truth.torque_gain[1], truth.velocity_gain[1]

    def by_joint(values: Any) -> dict[str, float]:
        return dict(zip(names, [float(value) for value in values], strict=True))

    metrics: dict[str, Any] = {
        "samples": len(result.data.offset),
        "torque_gain": by_joint(fit.torque_gain for fit in fits),
        "velocity_gain_s": by_joint(fit.velocity_gain for fit in fits),
        "true_torque_gain": by_joint(true_torque),
        "true_velocity_gain_s": by_joint(true_velocity),
        "torque_gain_ratio": by_joint(fit.torque_gain / true for fit, true in zip(fits, true_torque, strict=True)),
        "velocity_gain_ratio": by_joint(
            fit.velocity_gain / true for fit, true in zip(fits, true_velocity, strict=True)
        ),
        "true_torque_gain_low": by_joint(truth.torque_gain.min(axis=0)),
        "true_torque_gain_high": by_joint(truth.torque_gain.max(axis=0)),
        "true_velocity_gain_low_s": by_joint(truth.velocity_gain.min(axis=0)),
        "true_velocity_gain_high_s": by_joint(truth.velocity_gain.max(axis=0)),
        "symmetric_torque_gain": by_joint(fit.torque_gain for fit in symmetric),
        "symmetric_velocity_gain_s": by_joint(fit.velocity_gain for fit in symmetric),
        "rms_residual_rad": by_joint(fit.statistics.rms_residual for fit in fits),
        "torque_reached": by_joint(each.torque_reached for each in result.joints),
        "velocity_reached": by_joint(each.velocity_reached for each in result.joints),
        "piecewise_positive": {
            each.joint: each.piecewise.positive.status.value for each in result.joints if each.piecewise
        },
        "piecewise_negative": {
            each.joint: each.piecewise.negative.status.value for each in result.joints if each.piecewise
        },
    }
    for method, prefix in ((FitMethod.TWO_STAGE, ""), (FitMethod.ASYMMETRIC, "one_stage_")):
        for weight in WEIGHTS:
            of_weight = _fits(result, method, weight)
            metrics |= {
                f"{prefix}over_rate_w{weight:g}": by_joint(f.statistics.over_estimation_rate for f in of_weight),
                f"{prefix}over_size_w{weight:g}": by_joint(
                    f.statistics.largest_over_estimation_relative for f in of_weight
                ),
            }
    of_symmetric = by_joint(fit.statistics.over_estimation_rate for fit in symmetric)
    metrics["symmetric_over_rate"] = of_symmetric
    metrics["symmetric_over_size"] = by_joint(fit.statistics.largest_over_estimation_relative for fit in symmetric)
    rates = {each.joint: each.fit.statistics.over_estimation_rate for each in result.joints}
    sizes = [fit.statistics.largest_over_estimation_relative for fit in fits]
    metrics["over_rate_to_symmetric"] = {joint: rates[joint] / of_symmetric[joint] for joint in names}
    metrics["qp_newton_difference"] = by_joint(qp_newton_difference(result, index) for index in range(len(names)))
    bars = (
        Bar("over_rate_max", max(rates.values()), RATE),
        Bar("over_size_max", max(sizes), SIZE),
        Bar("over_rate_to_symmetric_max", max(metrics["over_rate_to_symmetric"].values()), RATE_RATIO),
        Bar("qp_newton_difference_max", max(metrics["qp_newton_difference"].values()), QP_DIFFERENCE),
        Bar("torque_reached_min", min(metrics["torque_reached"].values()), TORQUE_REACHED, at_least=True),
        Bar("velocity_reached_min", min(metrics["velocity_reached"].values()), VELOCITY_REACHED, at_least=True),
    )
    return ExperimentResult("identify-leg", result.robot.name, request.seed, fingerprint(run), metrics, bars)


def qp_newton_difference(result: Identification, joint: int) -> float:
    """Give the largest relative difference of a joint's gains by (9) and by Newton's method, on `QP_SAMPLES`."""
    samples = result.data.of(joint).thinned(QP_SAMPLES)
    newton, qp = (fit_asymmetric(samples, method=method) for method in ("newton", "qp"))
    return max(abs(qp.torque_gain / newton.torque_gain - 1.0), abs(qp.velocity_gain / newton.velocity_gain - 1.0))


def _fits(result: Identification, method: FitMethod, weight: float) -> list[MotorFit]:
    options = replace(result.options, method=method, weight=weight)
    joints = enumerate(result.robot.joints)
    if method is FitMethod.LEAST_SQUARES:
        return [fit_least_squares(result.data.of(index), joint=joint.name) for index, joint in joints]
    return [fit_joint(joint, result.data.of(index), options) for index, joint in joints]


def _draw(result: Identification, directory: Path) -> None:
    names = result.data.joints
    save(friction_figure(result, names.index(FIGURES["friction"])), directory / "identify-leg")
    save(motor_figure(result, names.index(FIGURES["torque"])), directory / "identify-leg-torque")
