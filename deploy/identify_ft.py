"""The body beyond a force/torque sensor from logs of poses at rest: `cosim identify ft`, 2.2 of [Del Prete 2016]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller_service.base_motion import ImuKinematics
from controller_service.ft_calibration import (
    PayloadDifference,
    PayloadFit,
    StaticPose,
    gravity_in_sensor,
    identify_payload,
    payload_difference,
    static_poses,
)
from controller_service.model import RobotModel
from controller_service.torque_estimation import TorqueEstimator
from deploy.errors import ReportError, UsageError
from deploy.series import Array
from schemas.control_law import SensorPayload
from schemas.load import Robot
from schemas.log import LogReader
from schemas.messages import RobotState
from schemas.robot import RobotDescription
from schemas.topics import decode

SPEED_LIMIT: Final = 0.002
"""[rad/s]: a window in which no joint is faster is at rest."""
LEAST_S: Final = 0.5
"""[s], shortest stretch at rest."""


@dataclass(frozen=True, slots=True)
class FtIdentification:
    """An identified body beside the URDF's."""

    robot: RobotDescription
    sensor: str
    fit: PayloadFit
    poses: tuple[StaticPose, ...]
    difference: PayloadDifference
    """Identified less the URDF's."""
    gravity_from: str
    """Name of the inertial unit that told gravity, or `description`."""
    logs: tuple[str, ...]

    @property
    def payload(self) -> SensorPayload:
        """As `controller.position_torque.payload` takes it."""
        payload = self.fit.payload
        centre, offset = payload.centre_of_mass.tolist(), payload.wrench_offset.tolist()
        return SensorPayload(
            mass=payload.mass,
            centre_in_sensor=tuple(centre),
            force_offset=tuple(offset[:3]),
            torque_offset=tuple(offset[3:]),
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values, SI."""
        fit = self.fit
        return {
            "robot": self.robot.name,
            "logs": list(self.logs),
            "sensor": self.sensor,
            "gravity_from": self.gravity_from,
            "poses": [{"start_s": pose.start_s, "end_s": pose.end_s} for pose in self.poses],
            "payload": self.payload.model_dump(mode="json"),
            "mass_deviation": fit.mass_deviation,
            "first_moment_deviation": fit.first_moment_deviation.tolist(),
            "offset_deviation": fit.offset_deviation.tolist(),
            "residual_force_rms": fit.residual_force_rms,
            "residual_torque_rms": fit.residual_torque_rms,
            "condition": fit.condition,
            "urdf": {
                "mass": fit.payload.mass - self.difference.mass,
                "centre_in_sensor": (fit.payload.centre_of_mass - self.difference.centre_of_mass).tolist(),
            },
        }


def identify_ft(
    logs: Sequence[Path],
    sensor: str | None = None,
    *,
    progress: Callable[[float, str], None] = lambda _share, _what: None,
) -> FtIdentification:
    """Identify the body beyond a sensor, and the sensor's offsets, from all poses at rest in logs of one robot.

    Nothing may touch the robot beyond the sensor while it is at rest. Gravity is what the robot's first inertial unit
    measures at each pose, or the description's where there is none.

    Args:
        logs: at least one.
        sensor: name; None: the robot's first one.
        progress: told what share is done and what comes next.

    Raises:
        LogError: a file is no log.
        UsageError: different robots, no such sensor.
        ReportError: a log without states.
        CalibrationError: the poses do not tell.

    """
    robot: Robot | None = None
    poses: list[StaticPose] = []
    gravity: list[Array] = []
    name = gravity_from = ""
    for number, path in enumerate(logs):
        progress(number / len(logs), path.name)
        reader = LogReader(path)
        if robot is None:
            robot = reader.run.robot
            name = _sensor(robot.description, sensor)
        elif reader.run.robot != robot:
            raise UsageError(f"{path}: a log of another robot, or of another description of {robot.description.name}")
        found, in_sensor, gravity_from = _poses(reader, robot, name, path)
        poses += found
        gravity.append(in_sensor)
    if robot is None:
        raise UsageError("no log to identify from")
    fit = identify_payload(np.concatenate(gravity), np.array([pose.wrench for pose in poses]).reshape(-1, 6))
    carried = TorqueEstimator(robot, (name,)).carried(name)
    return FtIdentification(
        robot.description, name, fit, tuple(poses), payload_difference(fit.payload, carried), gravity_from,
        tuple(path.name for path in logs),
    )  # fmt: skip


def _poses(reader: LogReader, robot: Robot, sensor: str, path: Path) -> tuple[tuple[StaticPose, ...], Array, str]:
    """Poses at rest of a log, gravity (P, 3) [m/s²] at each in the sensor's axes, and whence it is known."""
    description = robot.description
    imu = description.imus[0] if description.imus else None
    times, positions, wrenches, forces = [], [], [], []
    for record in reader.records(("state",)):
        state = decode(RobotState, record.data)
        wrench = next((each for each in state.wrenches if each.name == sensor and each.age_cycles == 0), None)
        inertial = next((each for each in state.imus if imu is not None and each.name == imu.name), None)
        if wrench is None or (imu is not None and inertial is None):
            continue
        times.append(state.time_ns * 1e-9)
        positions.append(state.position_measured)
        wrenches.append(wrench.force_in_sensor + wrench.torque_in_sensor)
        forces.append(inertial.acceleration_in_imu if inertial is not None else (0.0, 0.0, 0.0))
    if not times:
        raise ReportError(f"{path}: the log holds no reading of sensor {sensor}")
    time_s, position, specific = np.array(times), np.array(positions), np.array(forces)
    found = static_poses(time_s, position, np.array(wrenches), speed_limit=SPEED_LIMIT, least_s=LEAST_S)
    model = RobotModel(robot)
    frame = next(each.frame for each in description.force_torque_sensors if each.name == sensor)
    in_sensor, zero = [], np.zeros(len(description.joints))
    for pose in found:
        gravity = np.array(description.gravity_in_world)
        if imu is not None:
            during = (time_s >= pose.start_s) & (time_s <= pose.end_s)
            kinematics = ImuKinematics(model.model, imu.frame, description.joint_names)
            reading = specific[during].mean(axis=0)
            gravity = -kinematics.base_motion(pose.position, zero, zero, np.zeros(3), None, reading).acceleration
        in_sensor.append(gravity_in_sensor(model, pose.position[np.newaxis], frame, gravity)[0])
    return found, np.array(in_sensor).reshape(-1, 3), "description" if imu is None else imu.name


def _sensor(description: RobotDescription, name: str | None) -> str:
    names = [sensor.name for sensor in description.force_torque_sensors]
    if name is None and names:
        return names[0]
    if name is None or name not in names:
        raise UsageError(
            f"--sensor {name or ''}: robot {description.name} has no such force/torque sensor; it has"
            f" {', '.join(names) or 'none'}"
        )
    return name
