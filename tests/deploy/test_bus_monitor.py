from __future__ import annotations

import pytest

from deploy.bus_monitor import Decoded, FrameNames
from schemas.load import load_robot


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [
        (0x080, "", Decoded("all", "SYNC", "")),
        (0x000, "0100", Decoded("all", "NMT", "start")),
        (0x000, "8102", Decoded("scapula_roll", "NMT", "reset node")),
        (0x181, "3702e8030000f6ff", Decoded("scapula_yaw", "TPDO1", "operation_enabled, position 1000, torque -10 ‰")),
        (0x283, "0a1086", Decoded("shoulder_pitch", "TPDO2", "mode 10, error 0x8610")),
        (0x201, "0f00080cfeffff", Decoded("scapula_yaw", "RPDO1", "control 0x0F, mode 8, target -500")),
        (0x302, "0f000af401", Decoded("scapula_roll", "RPDO2", "control 0x0F, mode 10, torque 500 ‰")),
        (0x081, "3081110000000000", Decoded("scapula_yaw", "EMCY", "0x8130, register 0x11")),
        (0x701, "05", Decoded("scapula_yaw", "heartbeat", "operational")),
        (0x77F, "05", Decoded("hal", "heartbeat", "operational")),
        (0x601, "4041600000000000", Decoded("scapula_yaw", "SDO request", "0x6041:00 command 0x40 00 00 00 00")),
        (0x181, "37", Decoded("scapula_yaw", "0x180", "37")),
        (0x190, "", Decoded("node 16", "0x180", "")),
    ],
)
def test_frames_are_named(can_id: int, data: str, expected: Decoded) -> None:
    names = FrameNames(load_robot("arm9").description, "arm9-0")
    assert names.decode(can_id, bytes.fromhex(data)) == expected


def test_sensors_outrank_the_predefined_identifiers() -> None:
    names = FrameNames(load_robot("arm9").description, "arm9-2")
    assert names.decode(0x1C1, b"\x01\x02") == Decoded("wrist", "F/T 2", "01 02")
