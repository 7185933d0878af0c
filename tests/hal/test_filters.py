from __future__ import annotations

from hal.filters import DATA_FRAME_MASK, MOST_FILTERS, filters_of, hal_filters, heard_by_hal
from hal.profile.frames import CAN_EFF_FLAG, CAN_RTR_FLAG
from tests.hal.robots import imu, robot, wrist

ROBOT = robot("torque", "torque", "servo", force_torque_sensors=(wrist(),), imus=(imu(),))
"""Nodes 1 and 3 and the IMU on bus a, node 2 and the wrist sensor on bus b."""


def passes(bus: str, can_id: int) -> bool:
    """As the kernel decides (`can_rcv_filter`)."""
    return any(can_id & each["can_mask"] == each["can_id"] & each["can_mask"] for each in hal_filters(ROBOT, bus))


def test_the_hal_hears_its_own_nodes_and_sensors() -> None:
    assert heard_by_hal(ROBOT, "a") == {
        *(base + node for base in (0x080, 0x180, 0x280, 0x580) for node in (1, 3)),
        *(0x400 + offset for offset in (0x21, 0x32, 0x34)),
    }
    assert heard_by_hal(ROBOT, "b") == {0x082, 0x182, 0x282, 0x582, 0x50, 0x51}


def test_what_passes_the_kernels_filters() -> None:
    for can_id in heard_by_hal(ROBOT, "a"):
        assert passes("a", can_id)
        assert not passes("a", can_id | CAN_RTR_FLAG)
        assert not passes("a", can_id | CAN_EFF_FLAG)
    # Its peers' and other masters' commands, other nodes' reports and answers.
    for can_id in (0x000, 0x080, 0x201, 0x301, 0x601, 0x182, 0x582, 0x081 + 0x10, 0x52):
        assert not passes("a", can_id)
    # Any node that boots is heard, though none of the description.
    assert all(passes("a", 0x700 + node) for node in (1, 2, 3, 77))


def test_the_kernels_limit_is_kept() -> None:
    exact = filters_of(range(MOST_FILTERS))
    assert exact == [{"can_id": can_id, "can_mask": DATA_FRAME_MASK} for can_id in range(MOST_FILTERS)]
    grouped = filters_of(range(MOST_FILTERS + 1))
    assert len(grouped) == 5
    assert all(
        any(can_id & each["can_mask"] == each["can_id"] for each in grouped) for can_id in range(MOST_FILTERS + 1)
    )
