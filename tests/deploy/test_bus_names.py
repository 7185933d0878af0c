from __future__ import annotations

import pytest

from deploy.bus_names import FrameNames
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from hal.profile.objects import STATE_STRUCT
from hal.profile.units import DriveUnits
from schemas.load import load_robot
from tests.deploy.bus_logs import ROBOTS

ARM9 = load_robot("arm9").description
STILT = load_robot(str(ROBOTS / "stilt.yaml")).description
FEATHER = load_robot(str(ROBOTS / "feather.yaml")).description
JOINT = "scapula_yaw"


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [
        (0x080, "", ("all", "SYNC", "")),
        (0x000, "0100", ("all", "NMT", "start")),
        (0x000, "8102", ("scapula_roll", "NMT", "reset node")),
        (0x000, "8155", ("node 85", "NMT", "reset node")),
        (0x281, "0a1086", (JOINT, "TPDO2", "CST, error 0x8610")),
        (0x281, "083081", (JOINT, "TPDO2", "CSP, error heartbeat lost (0x8130)")),
        (0x281, "080000", (JOINT, "TPDO2", "CSP, no error")),
        (0x081, "3081110000000001", (JOINT, "EMCY",
         "error heartbeat lost (0x8130), maker 0x0100000000, register generic + communication")),
        (0x081, "0000000000000000", (JOINT, "EMCY", "no error")),
        (0x701, "05", (JOINT, "heartbeat", "operational")),
        (0x77F, "05", ("hal", "heartbeat", "operational")),
        (0x601, "4041600000000000", (JOINT, "SDO request", "read 0x6041:0 Statusword")),
        (0x581, "4b41600037120000", (JOINT, "SDO answer", "value 0x6041:0 Statusword = operation enabled")),
        (0x601, "2f60600008000000", (JOINT, "SDO request", "write 0x6060:0 Modes of operation = CSP")),
        (0x581, "6060600000000000", (JOINT, "SDO answer", "written 0x6060:0 Modes of operation")),
        (0x581, "8041600002000106", (JOINT, "SDO answer",
         "ABORT 0x6041:0 Statusword: Attempt to write a read only object (0x06010002)")),
        (0x581, "4318100102040000", (JOINT, "SDO answer", "value 0x1018:1 Identity object: Vendor-ID = 1026 (0x402)")),
        (0x601, "2301140101020080", (JOINT, "SDO request",
         "write 0x1401:1 RPDO2 communication: COB-ID used by RPDO = 2147484161 (0x80000201)")),
        (0x581, "4108100010000000", (JOINT, "SDO answer",
         "value 0x1008:0 Manufacturer device name: 16 bytes in segments")),
        (0x601, "6000000000000000", (JOINT, "SDO request", "read segment 00 00 00 00 00 00 00")),
        (0x581, "c601100000000000", (JOINT, "SDO answer", "block c6 01 10 00 00 00 00 00")),
        (0x601, "4055550900000000", (JOINT, "SDO request", "read 0x5555:9")),
        (0x181, "37", (JOINT, "TPDO1", "37 (1 bytes, must be 8)")),
        (0x190, "", ("node 16", "0x180", "")),
        (0x005, "01", ("?", "0x000", "01")),
        (CAN_EFF_FLAG | 0x18FF1234, "aa", ("?", "29-bit frame", "aa")),
        (CAN_RTR_FLAG | 0x701, "", (JOINT, "remote request", "")),
        (CAN_ERR_FLAG | 0x040, "0000000000000000", ("controller", "bus error", "bus-off")),
    ],
)  # fmt: skip
def test_frames_are_named(can_id: int, data: str, expected: tuple[str, str, str]) -> None:
    found = FrameNames(ARM9, "arm9-0").decode(can_id, bytes.fromhex(data))
    assert (found.who, found.what, found.content) == expected


def test_positions_and_torques_are_those_of_the_joint() -> None:
    robot = load_robot(str(ROBOTS / "crane.yaml")).description
    index = robot.joint_names.index("j2")  # turned round, with an offset
    units = DriveUnits.of(robot)
    decoded = FrameNames(robot, "lo").decode(0x184, STATE_STRUCT.pack(0x1237, -12345, 77))
    assert decoded.values["position_rad"] == units.zero_offset[index] - 12345 * units.radian_per_count[index]
    assert decoded.values["torque_nm"] == 77 * units.newton_metre_per_mille[index] == pytest.approx(-6.16)
    assert decoded.content == "operation enabled, -0.405315 rad, -6.16 N·m"
    assert decoded.values["state"] == "operation enabled"
    assert decoded.values["flags"] == "remote follows_command"


def test_a_warning_and_a_limit_stand_in_the_line() -> None:
    decoded = FrameNames(ARM9, "arm9-0").decode(0x181, STATE_STRUCT.pack(0x0AB7, 0, 0))
    assert decoded.content.endswith("warning, internal limit")


def test_a_drive_without_torque_sensing_shows_none() -> None:
    decoded = FrameNames(STILT, "left").decode(0x181, STATE_STRUCT.pack(0x1237, 0, 77))
    assert "torque_nm" not in decoded.values
    assert decoded.content == "operation enabled, +0.00000 rad"


@pytest.mark.parametrize(
    ("data", "content"),
    [
        ("0f000800000000", "enable operation, CSP, target +0.000000 rad"),
        ("0600080000ff", "06 00 08 00 00 ff (6 bytes, must be 7)"),
        ("0b00fd00000000", "control 0x000B, mode -3, target +0.000000 rad"),
    ],
)
def test_position_commands(data: str, content: str) -> None:
    assert FrameNames(ARM9, "arm9-0").decode(0x201, bytes.fromhex(data)).content == content


def test_a_servo_command_has_target_and_limit() -> None:
    decoded = FrameNames(FEATHER, "can").decode(0x201, bytes.fromhex("0f0000000000e803"))
    assert decoded.content == "enable operation, target +0.00000 rad, limit +6.000 N·m"
    assert decoded.values["torque_limit_nm"] == pytest.approx(6.0)


def test_a_torque_limit_has_no_direction() -> None:
    data = bytes.fromhex("2b726000e8030000")
    decoded = FrameNames(STILT, "left").decode(0x602, data)  # the joint is turned round
    assert decoded.content == "write 0x6072:0 Max torque = +80.00 N·m"


class TestForceTorque:
    def test_force_then_torque(self) -> None:
        names = FrameNames(ARM9, "arm9-2")
        first = names.decode(0x1C0, bytes.fromhex("0b00320000ffce00"))
        second = names.decode(0x1C1, bytes.fromhex("640064ff9c000000"))
        assert (first.what, first.content) == ("F/T 1", "force (+1.00, +0.00, -1.00) N")
        assert (second.what, second.content) == ("F/T 2", "torque (+0.0500, +0.0500, -0.0500) N·m")
        assert second.values["force_in_sensor_n"] == (1.0, 0.0, -1.0)
        assert second.values["torque_in_sensor_nm"] == pytest.approx((0.05, 0.05, -0.05))

    def test_a_second_frame_alone_tells_no_torque(self) -> None:
        decoded = FrameNames(ARM9, "arm9-2").decode(0x1C1, bytes(8))
        assert decoded.content.startswith("without its first frame")

    def test_a_first_frame_serves_once(self) -> None:
        names = FrameNames(ARM9, "arm9-2")
        names.decode(0x1C0, bytes.fromhex("0b00320000ffce00"))
        names.decode(0x1C1, bytes(8))
        assert names.decode(0x1C1, bytes(8)).content.startswith("without its first frame")

    def test_a_wrong_mark_is_shown_raw(self) -> None:
        assert FrameNames(ARM9, "arm9-2").decode(0x1C0, bytes(8)).content == "00 00 00 00 00 00 00 00"

    def test_overload_and_command(self) -> None:
        names = FrameNames(ARM9, "arm9-2")
        names.decode(0x1C0, bytes.fromhex("0b00320000ffce00"))
        assert "OVERLOAD 0x21" in names.decode(0x1C1, bytes.fromhex("0000000000210000")).content
        assert names.decode(0x1C8, bytes.fromhex("0b00000000000000")).content == "start"


@pytest.mark.parametrize(
    ("can_id", "data", "what", "content"),
    [
        (0x432, "020000000000", "gyro", "(+1.000, +0.000, +0.000) rad/s"),
        (0x434, "0000000009d0", "acceleration", "(+0.000, +0.000, +9.812) m/s²"),
        (0x421, "7fff000000000000", "orientation", "(+1.0000, +0.0000, +0.0000, +0.0000) (w x y z)"),
        (0x421, "0000000000000000", "orientation", "00 00 00 00 00 00 00 00"),
    ],
)
def test_inertial_units(can_id: int, data: str, what: str, content: str) -> None:
    decoded = FrameNames(STILT, "sensors").decode(can_id, bytes.fromhex(data))
    assert (decoded.who, decoded.what, decoded.content) == ("chest", what, content)
