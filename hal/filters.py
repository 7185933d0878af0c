"""What the HAL has to hear on each bus, for the kernel's filters.

The plant has none: all that its peers send is meant for some drive, whose identifiers a master may change at any time,
and its own frames do not come back to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from can.typechecking import CanFilter

from hal.expected import sensor_ids
from hal.profile import identifiers
from hal.profile.frames import CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK
from schemas.robot import ForceTorqueSensor, Imu, RobotDescription

MOST_FILTERS: Final = 512
"""`CAN_RAW_FILTER_MAX`."""
DATA_FRAME_MASK: Final = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG
"""One identifier's 11-bit data frames; the kernel finds filters with this mask by index, without a search."""
FUNCTION_MASK: Final = 0x780
_OF_A_DRIVE: Final = (identifiers.EMCY, identifiers.TPDO1, identifiers.TPDO2, identifiers.SDO_TX)


def heard_by_hal(robot: RobotDescription, bus: str) -> frozenset[int]:
    """List the identifiers that the HAL's nodes and sensors of a bus send: EMCY, TPDOs, SDO answers, readings."""
    ids = {base + joint.drive.node_id for joint in robot.joints if joint.drive.bus == bus for base in _OF_A_DRIVE}
    sensors: list[ForceTorqueSensor | Imu] = [*robot.force_torque_sensors, *robot.imus]
    for sensor in sensors:
        if sensor.bus == bus:
            ids.update(sensor_ids(sensor))
    return frozenset(ids)


def hal_filters(robot: RobotDescription, bus: str) -> list[CanFilter]:
    """Kernel filters of the HAL on a bus; of heartbeats all pass: an unknown node that boots is worth knowing of."""
    heartbeats = CanFilter(can_id=identifiers.HEARTBEAT, can_mask=FUNCTION_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG)
    return [*filters_of(heard_by_hal(robot, bus), MOST_FILTERS - 1), heartbeats]


def filters_of(can_ids: Iterable[int], most: int = MOST_FILTERS) -> list[CanFilter]:
    """One filter an identifier, or, where they are more than `most`, one a function code (bits 7 to 10)."""
    wanted = sorted(set(can_ids))
    if len(wanted) <= most:
        return [CanFilter(can_id=can_id, can_mask=DATA_FRAME_MASK) for can_id in wanted]
    codes = sorted({can_id & FUNCTION_MASK for can_id in wanted})
    return [CanFilter(can_id=code, can_mask=FUNCTION_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG) for code in codes]
