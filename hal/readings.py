"""Sensor readings put together from the frames of a cycle."""

from __future__ import annotations

from typing import Final

from hal.profile import sensors
from schemas.base import Quaternion, Vector3
from schemas.messages import ImuSample, WrenchSample
from schemas.robot import ForceTorqueSensor, Imu

FORCE: Final = 6
TORQUE: Final = 7
GYRO: Final = 8
ACCELERATION: Final = 9
QUATERNION: Final = 10
"""Kinds of frames, as the decoder counts them."""


class ForceTorqueReading:
    """Last reading of one force/torque sensor and the frames of the running cycle."""

    def __init__(self, sensor: ForceTorqueSensor) -> None:
        self.sensor = sensor
        self.parts: dict[int, bytes] = {}
        self.age = 0
        self._last: tuple[Vector3, Vector3] | None = None

    def sample(self) -> WrenchSample | None:
        """End a cycle: the last whole reading, None before the first."""
        self.age += 1
        if len(self.parts) == 2:
            sensor = self.sensor
            self._last = sensors.decode_force_torque(
                self.parts[FORCE], self.parts[TORQUE], sensor.force_resolution, sensor.torque_resolution
            )
            self.age = 0
        self.parts.clear()
        if self._last is None:
            return None
        force, torque = self._last
        return WrenchSample(name=self.sensor.name, force_in_sensor=force, torque_in_sensor=torque, age_cycles=self.age)


class InertialReading:
    """Last reading of one inertial unit and the frames of the running cycle."""

    def __init__(self, imu: Imu) -> None:
        self.sensor = imu
        self.parts: dict[int, bytes] = {}
        self.age = 0
        self._last: tuple[Vector3, Vector3, Quaternion] | None = None

    def sample(self) -> ImuSample | None:
        """End a cycle: the last whole reading, None before the first."""
        self.age += 1
        if len(self.parts) == 3:
            self._last = (
                sensors.decode_gyro(self.parts[GYRO]),
                sensors.decode_acceleration(self.parts[ACCELERATION]),
                sensors.decode_quaternion(self.parts[QUATERNION]),
            )
            self.age = 0
        self.parts.clear()
        if self._last is None:
            return None
        angular_velocity, acceleration, orientation = self._last
        return ImuSample(
            name=self.sensor.name,
            angular_velocity_in_imu=angular_velocity,
            acceleration_in_imu=acceleration,
            orientation_imu_to_world=orientation,
            age_cycles=self.age,
        )
