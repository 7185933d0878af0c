"""The position→torque transition of section IV-A of [Benallegue 2021] and its reverse, against a naive switch.

The robot reaches a pose in position mode, settles, goes to torque mode, holds there, and goes back. In each pose the
run is made twice: with the integral term initialised and the HAL's holding rule, and naively (integral term at zero,
first position target = measured position). All figures are read from the plant's truth in the log: the step is
|first motor torque in the new mode − last in the old| at the firmware's rate, the deviation the farthest that a joint
goes from where it stood at the change while it should stand still.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from deploy.errors import UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.metrics import CSP, CST, mode_changes
from deploy.plots import transition_figure
from deploy.runner import run_to_log
from deploy.series import RunSeries, read_series
from schemas.fingerprint import fingerprint
from schemas.load import Robot, Run, load_run

SCENARIO: Final = "arm9-transition"
POSES: Final[dict[str, dict[str, dict[str, float]]]] = {
    "arm9": {
        "bent": {"shoulder_pitch": -0.6, "shoulder_roll": -0.35, "shoulder_yaw": 0.1, "elbow_pitch": -1.3},
        "forward": {"shoulder_pitch": -1.5, "elbow_pitch": -0.15},
        "sideways": {"shoulder_roll": -1.4, "elbow_pitch": -0.3},
    }
}
"""Per robot: a relaxed pose and loaded ones, the arm stretched out against gravity."""
RANGE_SHARES: Final = {"low": 0.35, "middle": 0.5, "high": 0.65}
"""Poses of any other robot: each joint at this share of its range."""
REACH_S: Final = 1.0
SETTLE_S: Final = 0.4
TORQUE_S: Final = 1.0
POSITION_S: Final = 1.0
STEP_LIMIT: Final = 0.01
DEVIATION_LIMIT_RAD: Final = float(np.radians(0.5))
NAIVE_FACTOR: Final = 10.0
DIRECTIONS: Final = {"to_torque": CST, "to_position": CSP}

START_SHARE: Final = 0.8
"""The robot starts at this share of the pose: the reach is short on any robot, yet a motion that loads the friction."""
ANY_ROBOT: Final[dict[str, Any]] = {
    "plant.initial_posture": {},
    "controller.phases": [{"name": "hold", "mode": "position", "duration_s": 1.0}],
}
"""What the scenario says of its own robot's joints, left out."""

OWN_FIELDS: Final = ("seed", "duration_s", "controller.phases", "plant.initial_posture")

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


@dataclass(frozen=True, slots=True)
class Switches:
    """Per direction, step (fraction of the torque limit) and deviation [rad] of every joint in one run."""

    step: dict[str, Array]
    deviation: dict[str, Array]


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed: all poses, properly and naively.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped a run.

    """
    for path in request.overrides:
        if path.startswith(OWN_FIELDS):
            raise UsageError(f"--set {path}: the experiment sets it itself; --seed chooses the seed")
    scenario = load_run(SCENARIO, {**ANY_ROBOT, **request.overrides, "seed": request.seed})
    robot = scenario.robot
    poses = _poses(robot)
    proper: dict[str, Switches] = {}
    naive: dict[str, Switches] = {}
    with TemporaryDirectory() as scratch:
        directory = request.directory or Path(scratch)
        for number, (name, pose) in enumerate(poses.items()):
            request.progress(number / len(poses), name)
            series = _run(request, robot, pose, directory / name, {})
            proper[name] = _switches(series)
            if request.directory is not None:
                _plot(series, directory / name)
            request.progress((number + 0.5) / len(poses), f"{name}, naive")
            baseline = {"controller.initialize_integral": False, "robot.safety.holding": "none"}
            naive[name] = _switches(_run(request, robot, pose, directory / f"{name}-naive", baseline))
    return _result(request, scenario, proper, naive)


def _result(
    request: ExperimentRequest, scenario: Run, proper: dict[str, Switches], naive: dict[str, Switches]
) -> ExperimentResult:
    robot = scenario.robot.description
    metrics: dict[str, Any] = {"joints": list(robot.joint_names), "poses": list(proper)}
    bars = []
    for direction in DIRECTIONS:
        step = _worst(proper, "step", direction)
        naive_step = _worst(naive, "step", direction)
        deviation = _worst(proper, "deviation", direction)
        metrics[f"torque_step_fraction_{direction}"] = step.tolist()
        metrics[f"naive_torque_step_fraction_{direction}"] = naive_step.tolist()
        metrics[f"joint_deviation_{direction}_rad"] = deviation.tolist()
        metrics[f"naive_joint_deviation_{direction}_rad"] = _worst(naive, "deviation", direction).tolist()
        metrics[f"naive_over_proper_{direction}"] = float(naive_step.max() / step.max())
        bars += [
            Bar(f"torque_step_fraction_{direction}", float(step.max()), STEP_LIMIT),
            Bar(f"joint_deviation_{direction}_rad", float(deviation.max()), DEVIATION_LIMIT_RAD),
            Bar(f"naive_over_proper_{direction}", float(naive_step.max() / step.max()), NAIVE_FACTOR, at_least=True),
        ]
    for name, switches in proper.items():
        metrics[f"{name}_torque_step_fraction"] = {d: float(switches.step[d].max()) for d in DIRECTIONS}
        metrics[f"{name}_joint_deviation_rad"] = {d: float(switches.deviation[d].max()) for d in DIRECTIONS}
    return ExperimentResult("transition", robot.name, request.seed, fingerprint(scenario), metrics, tuple(bars))


def _poses(robot: Robot) -> dict[str, dict[str, float]]:
    joints = robot.description.joints
    by_share = {
        name: {joint.name: joint.position_min + share * (joint.position_max - joint.position_min) for joint in joints}
        for name, share in RANGE_SHARES.items()
    }
    return POSES.get(robot.description.name, by_share)


def _run(
    request: ExperimentRequest, robot: Robot, pose: dict[str, float], directory: Path, overrides: dict[str, Any]
) -> RunSeries:
    phases = [
        {"name": "reach", "mode": "position", "duration_s": REACH_S, "posture": pose},
        {"name": "settle", "mode": "position", "duration_s": SETTLE_S},
        {"name": "torque", "mode": "torque", "duration_s": TORQUE_S},
        {"name": "position", "mode": "position", "duration_s": POSITION_S},
    ]
    fixed = {
        "duration_s": REACH_S + SETTLE_S + TORQUE_S + POSITION_S,
        "controller.phases": phases,
        "plant.initial_posture": _start(robot, pose),
        "seed": request.seed,
    }
    run = load_run(SCENARIO, {**fixed, **request.overrides, **overrides})
    return read_series(run_to_log(run, directory, processes=request.processes))


def _start(robot: Robot, pose: dict[str, float]) -> dict[str, float]:
    joints = {joint.name: joint for joint in robot.description.joints}
    return {
        name: min(max(START_SHARE * angle, joints[name].position_min), joints[name].position_max)
        for name, angle in pose.items()
    }


def _switches(series: RunSeries) -> Switches:
    limits = np.array([joint.torque_limit for joint in series.run.robot.description.joints])
    changes = {change.to_mode: change for change in mode_changes(series.truth, limits)}
    deviation = {}
    for direction, mode in DIRECTIONS.items():
        time_s = changes[mode].time_s
        window = (series.truth.time_s >= time_s) & (series.truth.time_s < time_s + min(TORQUE_S, POSITION_S) - 0.01)
        positions = series.truth.position[window]
        deviation[direction] = np.abs(positions - positions[0]).max(axis=0)
    return Switches({d: np.array(changes[mode].torque_step) for d, mode in DIRECTIONS.items()}, deviation)


def _worst(runs: dict[str, Switches], what: str, direction: str) -> Array:
    return np.asarray(np.max([getattr(switches, what)[direction] for switches in runs.values()], axis=0), np.float64)


def _plot(series: RunSeries, directory: Path) -> None:
    limits = np.array([joint.torque_limit for joint in series.run.robot.description.joints])
    for change in mode_changes(series.truth, limits):
        direction = next(name for name, mode in DIRECTIONS.items() if mode == change.to_mode)
        transition_figure(series, change).savefig(directory / f"{direction}.png", dpi=120)
