"""Motor models of all joints from logs: `cosim identify motors`, section 3 of [Del Prete 2016]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np

from controller_service.ft_calibration import Payload
from controller_service.motor_fit import MotorFit, fit_asymmetric, fit_least_squares, fit_two_stage
from controller_service.motor_samples import MotorSamples, SampleBounds, check_samples
from controller_service.piecewise_fit import PiecewiseFit, PiecewiseModel, PiecewiseStatus, fit_piecewise
from deploy.errors import DeployError, UsageError
from deploy.motor_data import MotorData, motor_data, together
from deploy.series import RunSeries
from schemas.control_law import MotorModel, SavitzkyGolayFilter
from schemas.robot import Joint, RobotDescription

PIECEWISE_STARTS: Final = tuple(
    (float(centre - half), float(centre + half)) for centre in range(-15, 16, 3) for half in (0.5, 2.0, 4.0)
)
"""First τ_1 and τ_2 [N·m] that are tried where the paper's do not lead to convergence: the fit "requires the user to
provide an initial guess that may be different for each joint" (3.2.3), and friction moves the bends with the sign."""
WINDOW: Final = SavitzkyGolayFilter()


class IdentifyError(DeployError):
    """What was identified cannot be: a gain of the wrong sign."""


class FitMethod(StrEnum):
    """How the gains are found."""

    LEAST_SQUARES = "least-squares"
    """(7)."""
    ASYMMETRIC = "asymmetric"
    """(8) by Newton's method."""
    TWO_STAGE = "two-stage"
    """3.3.1: k_τ at rest, then k_v in motion, both by (8)."""
    QP = "qp"
    """(9) by OSQP, on thinned samples."""


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """What `identify` is asked to do; the paper's values."""

    method: FitMethod = FitMethod.TWO_STAGE
    weight: float = 100.0
    """w of (8)."""
    coulomb: bool = False
    """Fit k_c too."""
    still_velocity: float = 0.05
    """[rad/s]: a slower joint rests. The first stage leaves k_v q̇ of its samples out: a joint that is unloaded slowly
    needs less Δq, and the larger this is the more cautious is k_τ. On a drive without friction and dead zone it comes
    out 4 to 9 % low at 0.05 and within 1 % at 0.005; on one with both, where it must not over-estimate, 0.05 does."""
    slip_velocity: float = 0.005
    """[rad/s]: the friction of a slower joint may be anything that holds it. With k_c the methods of one stage leave
    such samples out, and so do the piecewise fits."""
    qp_samples: int = 1000
    """To which the samples of a joint are thinned for the QP."""
    filter: SavitzkyGolayFilter = WINDOW
    payload: Payload | None = None
    """Calibrated body beyond the force/torque sensor, and its offsets."""
    phases: tuple[str, ...] = ()
    """Whose samples alone are used; empty: all."""
    piecewise: bool = False
    """Fit the models of 3.2, too."""


@dataclass(frozen=True, slots=True)
class JointIdentification:
    """Model of a joint's motor and what it rests upon."""

    joint: str
    fit: MotorFit
    torque_reached: float
    """Largest |τ̂| of the samples over the joint's torque limit."""
    velocity_reached: float
    """Largest |q̇̂| over the velocity limit."""
    limited: int
    """Samples left out since the drive's torque limit may have acted."""
    piecewise: PiecewiseModel | None = None

    @property
    def model(self) -> MotorModel:
        """What the controller reads."""
        fit = self.fit
        return MotorModel(torque_gain=fit.torque_gain, velocity_gain=fit.velocity_gain, coulomb=fit.coulomb)

    def as_json(self) -> dict[str, Any]:
        """Plain values, SI."""
        result = asdict(self.fit) | {
            "torque_reached": self.torque_reached,
            "velocity_reached": self.velocity_reached,
            "limited": self.limited,
        }
        if self.piecewise is not None:
            sides = {"positive": self.piecewise.positive, "negative": self.piecewise.negative}
            result["piecewise"] = {name: _piecewise(fit) for name, fit in sides.items()}
        return result


@dataclass(frozen=True, slots=True)
class Identification:
    """Models of all joints of a robot."""

    robot: RobotDescription
    options: IdentifyOptions
    joints: tuple[JointIdentification, ...]
    data: MotorData
    logs: tuple[str, ...] = field(default=())
    """Names of the logs."""
    cut: tuple[str, ...] = field(default=())
    """Names of those that are cut short."""

    def motors(self) -> dict[str, dict[str, float]]:
        """Give the models as `controller.position_torque.motors` takes them."""
        return {each.joint: each.model.model_dump(exclude_defaults=True) for each in self.joints}

    def as_json(self) -> dict[str, Any]:
        """Plain values, SI."""
        options = self.options
        return {
            "robot": self.robot.name,
            "logs": list(self.logs),
            "method": options.method.value,
            "weight": weight_of(options),
            "cut_logs": list(self.cut),
            "still_velocity": options.still_velocity,
            "window": options.filter.window,
            "rows": self.data.rows,
            "samples": len(self.data.offset),
            "left_out": self.data.left_out,
            "joints": {each.joint: each.as_json() for each in self.joints},
        }


def weight_of(options: IdentifyOptions) -> float:
    """W of (8); least squares has none, which is 1."""
    return 1.0 if options.method is FitMethod.LEAST_SQUARES else options.weight


def identify(
    logs: Sequence[RunSeries],
    options: IdentifyOptions,
    *,
    names: Sequence[str] = (),
    progress: Callable[[float, str], None] = lambda _share, _what: None,
) -> Identification:
    """Identify the motors of all joints from logs of one robot.

    Args:
        logs: at least one.
        options: method and filter.
        names: of the logs.
        progress: told what share is done and what comes next.

    Raises:
        UsageError: logs of different robots; a phase that no log has.
        IdentificationError: samples from which a joint's model cannot be told, with joint and reason.
        IdentifyError: a gain comes out with the wrong sign.

    """
    robot = _common_robot(logs)
    _check_phases(logs, options.phases)
    parts = []
    for number, series in enumerate(logs):

        def tell(share: float, number: int = number) -> None:
            progress(0.9 * (number + share) / len(logs), f"torques of log {number + 1}")

        tell(0.0)
        parts.append(motor_data(series, options.filter, payload=options.payload, phases=options.phases, progress=tell))
    data = together(parts)
    joints = []
    for index, joint in enumerate(robot.joints):
        progress(0.9 + 0.1 * index / len(robot.joints), joint.name)
        joints.append(_identify_joint(joint, data, index, options))
    cut = [name for name, series in zip(names, logs, strict=False) if not series.complete]
    return Identification(robot, options, tuple(joints), data, tuple(names), tuple(cut))


def fit_joint(joint: Joint, samples: MotorSamples, options: IdentifyOptions) -> MotorFit:
    """Fit the model of a joint by the method of the options.

    Raises:
        IdentificationError: samples from which it cannot be told.
        IdentifyError: a gain of the wrong sign.

    """
    bounds = SampleBounds(torque_range=joint.torque_limit, velocity_range=joint.velocity_limit)
    still, coulomb, name = options.still_velocity, options.coulomb, joint.name
    if options.method is FitMethod.TWO_STAGE:
        # k_τ is known when k_v is fitted: the joint in motion need not be loaded, but the one at rest must be
        resting = samples.where(np.abs(samples.velocity) < still)
        check_samples(name, resting, moving=False, bounds=bounds, part=" at rest")
        in_motion = replace(bounds, torque_range=None)
        fit = fit_two_stage(
            samples, still_velocity=still, weight=options.weight, coulomb=coulomb, joint=name, bounds=in_motion
        )
    else:
        if coulomb:
            samples = samples.where(np.abs(samples.velocity) >= options.slip_velocity)
        if options.method is FitMethod.LEAST_SQUARES:
            fit = fit_least_squares(samples, coulomb=coulomb, joint=name, bounds=bounds)
        else:
            qp = options.method is FitMethod.QP
            fit = fit_asymmetric(
                samples.thinned(options.qp_samples) if qp else samples,
                weight=options.weight,
                coulomb=coulomb,
                method="qp" if qp else "newton",
                joint=name,
                bounds=bounds,
            )
    _check_signs(name, fit)
    return fit


def _identify_joint(joint: Joint, data: MotorData, index: int, options: IdentifyOptions) -> JointIdentification:
    samples = data.of(index)
    fit = fit_joint(joint, samples, options)
    return JointIdentification(
        joint.name,
        fit,
        float(np.abs(samples.torque).max()) / joint.torque_limit,
        float(np.abs(samples.velocity).max()) / joint.velocity_limit,
        int(data.limited[:, index].sum()),
        fit_pieces(joint, samples, options) if options.piecewise else None,
    )


def fit_pieces(joint: Joint, samples: MotorSamples, options: IdentifyOptions) -> PiecewiseModel:
    """Fit the piecewise models of 3.2 to the slow samples that do not stick, one for each sign of the velocity.

    The central line is kept at least as steep as the symmetric line: across the dead zone Δq leaps. Of the
    `PIECEWISE_STARTS` the one whose converged fit leaves the least residual is taken. With too few samples of a sign
    its fit has no lines: the model is a picture of the drive, and its want no reason to refuse the gains.
    """
    speed = np.abs(samples.velocity)
    slow = samples.where((speed < options.still_velocity) & (speed >= options.slip_velocity))
    square = float(slow.torque @ slow.torque)
    slope = float(slow.torque @ slow.offset) / square if square > 0.0 else 0.0
    fits = [_pieces(joint.name, slow.where(sign * slow.velocity > 0.0), slope) for sign in (1.0, -1.0)]
    return PiecewiseModel(fits[0], fits[1], joint.name)


def _pieces(joint: str, samples: MotorSamples, slope: float) -> PiecewiseFit:
    if len(samples) < SampleBounds().samples:
        return PiecewiseFit(None, PiecewiseStatus.EMPTY_SEGMENT, 0, False, len(samples), np.inf)
    of_paper = fit_piecewise(samples.offset, samples.torque, slope_bound=slope, joint=joint)
    if of_paper.converged:
        return of_paper
    found = [
        fit_piecewise(samples.offset, samples.torque, start=start, slope_bound=slope, joint=joint)
        for start in PIECEWISE_STARTS
    ]
    return min((fit for fit in found if fit.converged), key=lambda fit: fit.rms_residual, default=of_paper)


def _check_signs(joint: str, fit: MotorFit) -> None:
    gains = {"k_τ": (fit.torque_gain, "rad/(N·m)"), "k_v": (fit.velocity_gain, "s"), "k_c": (fit.coulomb, "rad")}
    for name, (value, unit) in gains.items():
        if value < 0.0 or (name == "k_τ" and value == 0.0):
            raise IdentifyError(
                f"{joint}: {name} comes out as {value:.3g} {unit}, which no drive has. Check the signs of encoder,"
                " force/torque sensor and target, and that the log holds the robot's large torques and speeds; for k_c"
                " try --method least-squares or asymmetric, which fit it with k_τ."
            )


def _common_robot(logs: Sequence[RunSeries]) -> RobotDescription:
    if not logs:
        raise UsageError("no log to identify from")
    first = logs[0].run.robot
    for series in logs[1:]:
        if series.run.robot != first:
            names = first.description.name, series.run.robot.description.name
            raise UsageError(f"the logs are of different robots, or of two descriptions of one: {' and '.join(names)}")
    return first.description


def _check_phases(logs: Sequence[RunSeries], phases: tuple[str, ...]) -> None:
    known = {phase.name for series in logs for phase in series.run.scenario.controller.phases}
    for phase in phases:
        if phase not in known:
            raise UsageError(f"--phase {phase}: no log has it; there are {', '.join(sorted(known))}")


def _piecewise(fit: PiecewiseFit) -> dict[str, Any]:
    return {
        "status": fit.status.value,
        "iterations": fit.iterations,
        "slopes": None if fit.lines is None else list(fit.lines.slopes),
        "intercepts": None if fit.lines is None else list(fit.lines.intercepts),
        "switching": None if fit.lines is None else list(fit.lines.switching),
        "slope_bounded": fit.slope_bounded,
        "samples": fit.samples,
        "rms_residual": fit.rms_residual if np.isfinite(fit.rms_residual) else None,
    }
