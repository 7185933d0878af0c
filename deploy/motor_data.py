"""Samples of all motors from logs of runs under position control, [Del Prete 2016] 3.4.

What the drive aims at: `StateSeries.position_applied` of row k is latched at the SYNC of row k and reached, along a
line, at the next one. So at the SYNC of row k, when the position is measured, the drive's target is row k − 1 of it.
What the HAL limited, its range and its speed, needs no care: the applied target is the limited one.

Records need not be causal (3.4.3): velocities, accelerations and sensor readings are those of the middle of a window
about each row, and torques follow from them by Newton-Euler (algorithm 1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from controller_service.base_motion import BaseMotion, ImuKinematics
from controller_service.ft_calibration import Payload
from controller_service.model import RobotModel
from controller_service.motor_samples import MotorSamples
from controller_service.savitzky_golay import smooth
from controller_service.torque_estimation import TorqueEstimator
from deploy.series import Array, RunSeries, read_series, stretches
from hal.profile.firmware import FirmwareGains
from schemas.control_law import SavitzkyGolayFilter
from schemas.load import Robot

Mask = NDArray[np.bool_]

LIMIT_SHARE: Final = 0.9
"""Of a drive's torque limit, by the maker's law: more may have been cut off, as the drive's true gains may differ."""
STEP: Final = 2000
"""Rows between two reports of progress."""


@dataclass(frozen=True, slots=True)
class MotorData:
    """Samples of all joints: M instants, n joints."""

    joints: tuple[str, ...]
    offset: Array
    """Δq (M, n) [rad]: the drive's target at the SYNC less the measured position."""
    torque: Array
    """τ (M, n) [N·m], estimated: motor less friction, with the rotors' inertia."""
    velocity: Array
    """q̇ (M, n) [rad/s], estimated."""
    limited: Mask
    """(M, n): the drive's torque limit may have acted."""
    rows: int
    """States of all logs."""
    left_out: dict[str, int]
    """Rows that gave no sample, by reason; what a drive's limit takes is in `limited`."""

    def of(self, joint: int) -> MotorSamples:
        """Give the samples of a joint, without those that its drive's limit may have cut."""
        kept = ~self.limited[:, joint]
        return MotorSamples(
            *(np.ascontiguousarray(each[kept, joint]) for each in (self.offset, self.torque, self.velocity))
        )


def motor_data(
    series: RunSeries,
    config: SavitzkyGolayFilter,
    *,
    payload: Payload | None = None,
    phases: tuple[str, ...] = (),
    progress: Callable[[float], None] = lambda _share: None,
) -> MotorData:
    """Make samples of a log.

    Left out are rows before which or at which the drives had no position target (modes without, changes of mode, the
    first row), rows after a safe stop or of other phases, rows beside a lost cycle, and half a window beside each.
    That a sensor's reading is an old one is not told by `StateSeries`.

    Args:
        series: of the log; the first force/torque sensor and the first inertial unit of the robot are used.
        config: window and orders; `evaluate_at` does not matter.
        payload: calibrated body and offsets of the sensor; None: the URDF's and no offsets.
        phases: of the controller, whose rows alone are used; empty: all.
        progress: told the share that is done.

    """
    robot, state = series.run.robot, series.state
    target = np.vstack((np.full_like(state.position_applied[:1], np.nan), state.position_applied[:-1]))
    follows = np.concatenate(([False], np.diff(state.sequence) == 1))
    usable = np.isfinite(target).all(axis=1) & np.isfinite(state.position_applied).all(axis=1) & follows
    usable &= np.isfinite(state.position).all(axis=1)
    kept, reasons = usable.copy(), {"without a position target, or beside a lost cycle": int(np.sum(~usable))}
    stops = [event.sequence for event in series.events if event.kind == "safe_stop"]
    if stops:
        reasons["after a safe stop"] = int(np.sum(kept & (state.sequence >= min(stops))))
        kept &= state.sequence < min(stops)
    if phases:
        chosen = np.array([phase in phases for phase in series.trace.phase], dtype=np.bool_)
        other = ~np.isin(state.sequence, series.trace.sequence[chosen])
        reasons["in other phases"] = int(np.sum(kept & other))
        kept &= ~other
    half = config.window // 2
    parts = []
    for first, last in stretches(kept):
        if last - first > 2 * (half + 1):
            parts.append(_Part(series, target, first, last, config))
    reasons["within half a window of these or of the ends"] = int(np.sum(kept)) - sum(len(part) for part in parts)
    torques = _torques(robot, parts, payload, progress)
    n = len(robot.description.joints)
    offset, velocity = (
        np.concatenate([np.empty((0, n)), *(getattr(part, name) for part in parts)]) for name in ("offset", "velocity")
    )
    gains = FirmwareGains.of(robot.description)
    effort = np.abs(gains.position_gain * offset - gains.velocity_gain * velocity) - gains.dead_zone
    limited = effort >= LIMIT_SHARE * gains.torque_limit
    return MotorData(
        robot.description.joint_names, offset, torques, velocity, limited, len(state.sequence),
        {reason: count for reason, count in reasons.items() if count},
    )  # fmt: skip


def read_states(path: Path, *, phases: bool = False) -> RunSeries:
    """Read of a log what `motor_data` needs, which takes a third of the time of all.

    Args:
        path: of the log.
        phases: read the controller's trace too, which tells the phase of each cycle.

    Raises:
        LogError: the file is not a readable log.
        ReportError: it holds no state.

    """
    return read_series(path, ("state", "event", *(("trace",) if phases else ())))


def together(data: list[MotorData]) -> MotorData:
    """Put the samples of several logs of one robot into one."""
    reasons: dict[str, int] = {}
    for each in data:
        for reason, count in each.left_out.items():
            reasons[reason] = reasons.get(reason, 0) + count
    return MotorData(
        data[0].joints,
        np.concatenate([each.offset for each in data]),
        np.concatenate([each.torque for each in data]),
        np.concatenate([each.velocity for each in data]),
        np.concatenate([each.limited for each in data]),
        sum(each.rows for each in data),
        reasons,
    )


class _Part:
    """A stretch of rows without a gap, smoothed; its arrays lack half a window at both ends."""

    def __init__(self, series: RunSeries, target: Array, first: int, last: int, config: SavitzkyGolayFilter) -> None:
        state, window = series.state, config.window
        period, order = series.run.robot.description.period_s, config.encoder_order
        inner = slice(window // 2, last - first - window // 2)
        position, imu, wrench = (each[first:last] for each in (state.position, state.imu, state.wrench))
        self.offset: Array = (target[first:last] - position)[inner]
        self.position = smooth(position, window, order, period)[inner]
        self.velocity = smooth(position, window, order, period, 1)[inner]
        self.acceleration = smooth(position, window, order, period, 2)[inner]
        description = series.run.robot.description
        self.imu = self.imu_rate = self.wrench = np.empty((len(self.offset), 0))
        if description.imus:
            self.imu = smooth(imu, window, config.sensor_order, period)[inner]
            self.imu_rate = smooth(imu, window, config.sensor_order, period, 1)[inner]
        if description.force_torque_sensors:
            self.wrench = smooth(wrench, window, config.sensor_order, period)[inner]

    def __len__(self) -> int:
        return len(self.offset)


def _torques(robot: Robot, parts: list[_Part], payload: Payload | None, progress: Callable[[float], None]) -> Array:
    """τ̂ (M, n) [N·m] of all rows of all parts."""
    description = robot.description
    sensors = tuple(sensor.name for sensor in description.force_torque_sensors[:1])
    compensations = {} if payload is None else dict.fromkeys(sensors, payload)
    estimator = TorqueEstimator(robot, sensors, compensations=compensations)
    kinematics = None
    if description.imus:
        model = RobotModel(robot)
        kinematics = ImuKinematics(model.model, description.imus[0].frame, description.joint_names)
    base = BaseMotion.at_rest(description.gravity_in_world)
    torque = np.empty((sum(len(part) for part in parts), len(description.joints)))
    row = 0
    for part in parts:
        for k in range(len(part)):
            q, v, a = part.position[k], part.velocity[k], part.acceleration[k]
            if kinematics is not None:
                reading = part.imu[k]
                base = kinematics.base_motion(q, v, a, reading[:3], part.imu_rate[k, :3], reading[3:])
            wrenches = (part.wrench[k],) if sensors else ()
            torque[row] = estimator.estimate(q, v, a, base, wrenches).torque
            row += 1
            if row % STEP == 0:
                progress(row / len(torque))
    return torque
