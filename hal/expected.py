"""Which frames the HAL awaits after a SYNC."""

from __future__ import annotations

from hal.profile import identifiers, sensors
from schemas.robot import ForceTorqueSensor, Imu, RobotDescription


def sensor_ids(sensor: ForceTorqueSensor | Imu) -> tuple[int, ...]:
    """List the identifiers of the frames that a sensor sends after each SYNC."""
    if isinstance(sensor, ForceTorqueSensor):
        return sensor.can_id, sensor.can_id + 1
    offsets = (sensors.GYRO_ID, sensors.ACCELERATION_ID, sensors.QUATERNION_ID)
    return tuple(sensor.base_id + offset for offset in offsets)


def expected_reports(
    robot: RobotDescription,
    *,
    mode_change: bool,
    silent_joints: frozenset[int],
    silent_sensors: frozenset[str],
    foreign_joints: frozenset[int] = frozenset(),
) -> tuple[frozenset[int], ...]:
    """List identifiers per bus: TPDO1 of every drive, TPDO2 when the mode changed, all frames of every sensor.

    Args:
        robot: the description.
        mode_change: the command latched at this SYNC has another mode of operation than the one before.
        silent_joints: indices of joints given up, whose frames are not awaited.
        silent_sensors: names of sensors given up.
        foreign_joints: indices of joints with other makers' drives. Their TPDO2 is taken when it comes, but some never
            send it, and waiting for it would keep the HAL's heartbeat from all drives.
    """
    ids: list[set[int]] = [set() for _ in robot.buses]
    for index, joint in enumerate(robot.joints):
        if index not in silent_joints:
            bus = ids[robot.bus_index(joint.drive.bus)]
            bus.add(identifiers.TPDO1 + joint.drive.node_id)
            if mode_change and index not in foreign_joints:
                bus.add(identifiers.TPDO2 + joint.drive.node_id)
    every: list[ForceTorqueSensor | Imu] = [*robot.force_torque_sensors, *robot.imus]
    for sensor in every:
        if sensor.name not in silent_sensors:
            ids[robot.bus_index(sensor.bus)].update(sensor_ids(sensor))
    return tuple(frozenset(bus) for bus in ids)
