"""Force/torque sensors and inertial units: what they read in SI units, with the noise and bias of the scenario.

The frames' encoding is the devices' business.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from plant_service.model import sensor_name
from schemas.base import Vector3
from schemas.robot import RobotDescription
from schemas.scenario import SensorNoise

Array = NDArray[np.float64]

SENSOR_STREAM = 3


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One sample of an inertial unit: angular velocity [rad/s] and specific force [m/s²] in its frame."""

    angular_velocity: Array
    acceleration: Array
    orientation_to_world: Array
    """Unit quaternion (w, x, y, z)."""


class Sensors:
    """Reads MuJoCo's sensors of one model.

    A wrench is what the parent side exerts on everything from the sensor's link on, in that link's frame at its origin.
    Force, moment and acceleration belong to the start of the substep that ended at the sample, angular velocity and
    orientation to its end.
    """

    def __init__(self, description: RobotDescription, model: mujoco.MjModel, noise: SensorNoise, seed: int) -> None:
        kinds = mujoco.mjtSensor
        self._wrench_names = [sensor.name for sensor in description.force_torque_sensors]
        self._imu_names = [imu.name for imu in description.imus]
        self._forces = [
            np.concatenate([_address(model, name, kinds.mjSENS_FORCE), _address(model, name, kinds.mjSENS_TORQUE)])
            for name in self._wrench_names
        ]
        self._imus = [
            np.concatenate([_address(model, imu, kinds.mjSENS_GYRO), _address(model, imu, kinds.mjSENS_ACCELEROMETER)])
            for imu in self._imu_names
        ]
        self._quaternions = [_address(model, name, kinds.mjSENS_FRAMEQUAT) for name in self._imu_names]
        self._noisy = any(value > 0.0 for value in noise.model_dump().values())
        self._generator = np.random.default_rng([seed, SENSOR_STREAM])
        self._wrench_noise = np.repeat([noise.force, noise.torque], 3)
        self._imu_noise = np.repeat([noise.angular_velocity, noise.acceleration], 3)
        bias = np.repeat([noise.force_bias, noise.torque_bias], 3)
        self._biases = [bias * self._generator.standard_normal(6) for _ in self._wrench_names]
        self.true_wrenches: dict[str, tuple[Vector3, Vector3]] = {}
        """Force [N] and moment [N·m] of each sensor without noise and bias."""
        self.wrenches: dict[str, Array] = {}
        """Force and moment as measured, shape (6,)."""
        self.imus: dict[str, ImuReading] = {}

    def sample(self, sensordata: Array) -> None:
        """Read all sensors."""
        for name, address, bias in zip(self._wrench_names, self._forces, self._biases, strict=True):
            wrench = sensordata[address]
            fx, fy, fz, mx, my, mz = wrench.tolist()
            self.true_wrenches[name] = ((fx, fy, fz), (mx, my, mz))
            self.wrenches[name] = wrench + (bias + self._draw(self._wrench_noise)) if self._noisy else wrench
        for name, address, quaternion in zip(self._imu_names, self._imus, self._quaternions, strict=True):
            motion = sensordata[address]
            if self._noisy:
                motion += self._draw(self._imu_noise)
            self.imus[name] = ImuReading(motion[:3], motion[3:], sensordata[quaternion])

    def _draw(self, deviation: Array) -> Array:
        return deviation * self._generator.standard_normal(6)


def _address(model: mujoco.MjModel, name: str, kind: mujoco.mjtSensor) -> NDArray[np.intp]:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, sensor_name(name, kind))
    start = int(model.sensor_adr[index])
    return np.arange(start, start + int(model.sensor_dim[index]), dtype=np.intp)
