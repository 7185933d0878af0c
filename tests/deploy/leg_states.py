"""States of a leg that moves and is pushed, whose drives obey (6) of [Del Prete 2016] exactly: logs without a plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from controller_service.base_motion import BaseMotion
from controller_service.torque_estimation import TorqueEstimator
from deploy.series import RunSeries, state_series, trace_series, truth_series
from schemas.base import ControlMode
from schemas.fingerprint import fingerprint
from schemas.load import Run, load_run
from schemas.log import LogWriter
from schemas.messages import (
    AppliedCommand,
    ControllerTrace,
    DriveState,
    Event,
    HalStatus,
    ImuSample,
    RobotState,
    WrenchSample,
)

Array = npt.NDArray[np.float64]

TORQUE_GAIN = np.array([5.5e-5, 4.4e-5, 14.0e-5, 5.6e-5, 22.0e-5, 18.0e-5])
VELOCITY_GAIN = np.array([17.6e-3, 15.8e-3, 12.0e-3, 11.5e-3, 11.8e-3, 10.7e-3])
COULOMB = np.array([4e-4, 3e-4, 9e-4, 4e-4, 14e-4, 12e-4])
CENTRE = np.array([-0.65, -0.22, 0.13, 1.3, 0.085, -0.26])


@dataclass(frozen=True)
class LegMotion:
    """A motion in closed form: sines of growing amplitude for half of the time, then pushes on a slow leg."""

    time_s: Array
    position: Array
    velocity: Array
    torque: Array
    wrench: Array
    """(K, 6) as the ankle's sensor reads it."""
    offset: Array
    """Δq (K, 6) at each SYNC."""


def leg_motion(duration_s: float = 8.0, coulomb: Array | float = 0.0) -> LegMotion:
    """Half of the time fast without a load, half slow with large ones."""
    run = leg_run()
    time_s = np.arange(0.0, duration_s, 1e-3)
    half_s = 0.5 * duration_s
    fast = 1.0 / (1.0 + np.exp((time_s - half_s) / 0.1))[:, np.newaxis]
    rate = 2.0 * np.pi * np.array([0.75, 1.0, 0.9, 0.85, 1.1, 0.95])
    size = fast * np.array([0.9, 0.4, 0.45, 1.0, 0.5, 0.8]) + (1.0 - fast) * 1e-3
    position = CENTRE + size * np.sin(rate * time_s[:, np.newaxis] + np.arange(6.0))
    velocity = np.gradient(position, 1e-3, axis=0)
    acceleration = np.gradient(velocity, 1e-3, axis=0)
    # Forces and moments at the foot, each of a frequency of its own
    scale = np.array([250.0, 250.0, 300.0, 60.0, 60.0, 60.0])
    pace = 2.0 * np.pi * np.array([0.5, 0.8, 0.65, 0.9, 1.1, 0.75])
    contact = (1.0 - fast) * scale * np.sin(pace * time_s[:, np.newaxis])
    estimator = TorqueEstimator(run.robot, ("ankle",))
    base = BaseMotion.at_rest(run.robot.description.gravity_in_world)
    torque, wrench = np.empty_like(position), np.empty((len(time_s), 6))
    for k in range(len(time_s)):
        q, v, a = position[k], velocity[k], acceleration[k]
        free = estimator.estimate(q, v, a, base, (np.zeros(6),)).external_wrenches[0]
        wrench[k] = free - contact[k]
        torque[k] = estimator.estimate(q, v, a, base, (wrench[k],)).torque
    offset = TORQUE_GAIN * torque + VELOCITY_GAIN * velocity + coulomb * np.sign(velocity)
    return LegMotion(time_s, position, velocity, torque, wrench, offset)


def leg_run() -> Run:
    return load_run("leg6-high-velocity")


def leg_states(motion: LegMotion) -> list[RobotState]:
    """The states: the target that row k latches is the one of the SYNC after it."""
    target = motion.position + motion.offset
    ahead = np.vstack((target[1:], target[-1:]))
    return [state(k, motion.position[k], motion.wrench[k], ahead[k]) for k in range(len(target))]


def state(sequence: int, position: Array, wrench: Array, target: Array | None, **changes: Any) -> RobotState:
    n = len(position)
    applied = AppliedCommand(
        sequence=sequence - 2,
        mode=ControlMode.POSITION if target is not None else ControlMode.TORQUE,
        position=None if target is None else tuple(target.tolist()),
    )
    values: dict[str, Any] = {
        "sequence": sequence,
        "time_ns": sequence * 1_000_000,
        "status": HalStatus.ACTIVE,
        "position_measured": tuple(position.tolist()),
        "motor_torque_measured": None,
        "drive_state": (DriveState.OPERATION_ENABLED,) * n,
        "mode": (ControlMode.POSITION,) * n,
        "error_code": (0,) * n,
        "applied": applied,
        "wrenches": (
            WrenchSample(name="ankle", force_in_sensor=tuple(wrench[:3]), torque_in_sensor=tuple(wrench[3:])),
        ),
        "imus": (
            ImuSample(
                name="base",
                angular_velocity_in_imu=(0.0, 0.0, 0.0),
                acceleration_in_imu=(0.0, 0.0, 9.81),
                orientation_imu_to_world=(1.0, 0.0, 0.0, 0.0),
            ),
        ),
    }
    return RobotState(**values | changes)


def write_log(path: Path, states: list[RobotState]) -> Path:
    run = leg_run()
    with LogWriter(path, run, fingerprint(run)) as log:
        for each in states:
            log.write("state", each)
    return path


def of_states(
    run: Run,
    states: list[RobotState],
    traces: Sequence[ControllerTrace] = (),
    events: Sequence[Event] = (),
    *,
    complete: bool = True,
) -> RunSeries:
    """Make a series of states alone, or with traces and events."""
    description = run.robot.description
    n = len(description.joints)
    return RunSeries(
        run=run,
        complete=complete,
        state=state_series(states, n),
        command_sequence=np.array([], np.int64),
        trace=trace_series(list(traces), n),
        truth=truth_series([], n, description.hand_frame),
        events=tuple(events),
        statistics=(),
    )
