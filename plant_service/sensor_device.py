"""Simulated sensors on the bus: Robotous RFT force/torque and Xsens MTi inertial unit; both answer every SYNC."""

from __future__ import annotations

from collections.abc import Callable

from hal.profile import frames, identifiers, sensors
from schemas.base import Quaternion, Vector3
from schemas.robot import ForceTorqueSensor, Imu

Wrench = tuple[Vector3, Vector3]
"""Force [N] and moment [N·m] in the sensor's frame."""
Motion = tuple[Vector3, Vector3, Quaternion]
"""Angular velocity [rad/s] and specific force [m/s²] in the sensor's frame, orientation to the world."""


class ForceTorqueDevice:
    """Silent until the start command; then two frames after each SYNC, at `can_id` and `can_id + 1`."""

    revision = 0

    def __init__(self, sensor: ForceTorqueSensor, read: Callable[[], Wrench]) -> None:
        self._sensor = sensor
        self._read = read
        self._running = False

    @property
    def can_ids(self) -> frozenset[int]:
        """Identifiers that this device listens to."""
        return frozenset((self._sensor.command_id, identifiers.SYNC))

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Start or stop on a command frame; answer a SYNC."""
        if can_id == identifiers.SYNC:
            return self.sync(now_ns)
        if can_id == self._sensor.command_id and data:
            if data[0] == sensors.FORCE_TORQUE_START:
                self._running = True
            elif data[0] == sensors.FORCE_TORQUE_STOP:
                self._running = False
        return []

    def sync(self, now_ns: int) -> list[bytes]:
        """Two frames of this instant's reading, if started."""
        if not self._running:
            return []
        sensor = self._sensor
        first, second = sensors.encode_force_torque(*self._read(), sensor.force_resolution, sensor.torque_resolution)
        return [frames.pack(sensor.can_id, first), frames.pack(sensor.can_id + 1, second)]

    def tick(self, now_ns: int) -> list[bytes]:
        """Do nothing: the sensor has no timers."""
        return []


class ImuDevice:
    """Gyro, acceleration and quaternion frames after each SYNC, at the maker's identifiers plus `base_id`."""

    revision = 0
    can_ids = frozenset((identifiers.SYNC,))

    def __init__(self, imu: Imu, read: Callable[[], Motion]) -> None:
        self._base = imu.base_id
        self._read = read

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Answer a SYNC."""
        return self.sync(now_ns) if can_id == identifiers.SYNC else []

    def sync(self, now_ns: int) -> list[bytes]:
        """Three frames of this instant's reading."""
        angular_velocity, acceleration, orientation = self._read()
        return [
            frames.pack(self._base + sensors.QUATERNION_ID, sensors.encode_quaternion(orientation)),
            frames.pack(self._base + sensors.GYRO_ID, sensors.encode_gyro(angular_velocity)),
            frames.pack(self._base + sensors.ACCELERATION_ID, sensors.encode_acceleration(acceleration)),
        ]

    def tick(self, now_ns: int) -> list[bytes]:
        """Do nothing: the unit has no timers."""
        return []
