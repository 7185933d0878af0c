from __future__ import annotations

import struct

import numpy as np
import pytest

from hal.bus.error_frames import Trouble
from hal.decode import Decoder, upload_request
from hal.errors import HalError, ProfileError
from hal.profile.frames import unpack
from schemas.messages import DriveState
from tests.hal.robots import FAULT, frame, imu, mode_report, report, robot, wrist


def decoder(*kinds: str) -> Decoder:
    description = robot(*kinds, force_torque_sensors=(wrist(),), imus=(imu(),))
    return Decoder(description, np.zeros(len(kinds)))


def test_state_reports_in_any_order_on_both_buses() -> None:
    measured = decoder("torque", "torque", "torque").decode(
        [report(3, 409600, -1000) + report(1, 4096), report(2, -409600, 100, FAULT)]
    )
    assert measured.position == pytest.approx([2 * np.pi / 100, 0.1 + 2 * np.pi, 0.2 + 2 * np.pi])
    assert measured.motor_torque == pytest.approx([0.0, -5.0, -50.0])
    assert measured.drive_state.tolist() == [
        DriveState.OPERATION_ENABLED,
        DriveState.FAULT,
        DriveState.OPERATION_ENABLED,
    ]
    assert measured.silent_cycles.tolist() == [0, 0, 0]


def test_the_last_of_two_reports_counts() -> None:
    measured = decoder("torque").decode([report(1, 1) + report(1, 409600), b""])
    assert measured.position[0] == pytest.approx(2 * np.pi)


@pytest.mark.parametrize(
    "foreign",
    [
        frame(0x181 | 0x80000000, b"\0" * 8),
        frame(0x181 | 0x40000000, b"\0" * 8),
        frame(0x7FF, b"\0" * 8),
        frame(0x1FFFFFFF | 0x80000000, b"\0" * 8),
        frame(0x182, struct.pack("<Hih", 0x0008, 5, 5)),
        frame(0x080, b""),
        frame(0x20000040, b"\0" * 8),
        frame(0x20000181, b"\0" * 8),
        frame(0x581, bytes.fromhex("4341600027060000")),
        frame(0x581, bytes.fromhex("8061600000000206")),
    ],
)
def test_foreign_frames_change_nothing(foreign: bytes) -> None:
    unit = decoder("torque", "torque")
    before = unit.decode([report(1, 77), report(2, 88)])
    after = unit.decode([foreign, b""])
    assert after.position.tolist() == before.position.tolist()
    assert after.drive_state.tolist() == before.drive_state.tolist()
    assert after.mode.tolist() == before.mode.tolist()
    assert after.silent_cycles.tolist() == [1, 1]
    assert after.notices == ()


def test_modes_and_errors_are_kept_between_reports() -> None:
    unit = decoder("torque", "torque")
    unit.decode([report(1) + mode_report(1, 10, 0x7305), report(2)])
    measured = unit.decode([report(1), report(2)])
    assert measured.mode.tolist() == [10, 8]
    assert measured.error_code.tolist() == [0x7305, 0]


def test_a_drive_without_error_codes_reports_its_mode_alone() -> None:
    unit = decoder("torque", "torque")
    measured = unit.decode([report(1) + frame(0x281, b"\x0a"), report(2)])
    assert measured.mode.tolist() == [10, 8]
    assert measured.error_code.tolist() == [0, 0]
    assert measured.notices == ()


def test_what_did_not_change_is_the_array_of_the_cycle_before() -> None:
    unit = decoder("torque", "torque")
    before = unit.decode([report(1), report(2)])
    after = unit.decode([report(1, 5), report(2, 6)])
    assert after.drive_state is before.drive_state
    assert after.mode is before.mode
    assert after.error_code is before.error_code
    assert after.position.tolist() != before.position.tolist()
    fault = unit.decode([report(1, 5, statusword=0x0208), report(2, 6)])
    assert fault.drive_state.tolist() == [DriveState.FAULT, DriveState.OPERATION_ENABLED]
    assert after.drive_state.tolist() == [DriveState.OPERATION_ENABLED] * 2


def test_an_undefined_statusword_is_told_in_every_cycle() -> None:
    unit = decoder("torque")
    for _ in range(2):
        assert len(unit.decode([report(1, statusword=0x0001), b""]).notices) == 1


def test_an_undefined_statusword_stops_and_keeps_the_state() -> None:
    measured = decoder("torque").decode([report(1, statusword=0x0001), b""])
    (notice,) = measured.notices
    assert (notice.kind, notice.joint, notice.stops) == ("drive_fault", 0, True)
    assert measured.drive_state.tolist() == [DriveState.OPERATION_ENABLED]


def test_emergencies_name_joint_and_code() -> None:
    unit = decoder("torque", "torque")
    data = struct.pack("<HB5s", 0x7305, 0x21, b"\1\2\3\4\5")
    (notice,) = unit.decode([b"", frame(0x082, data)]).notices
    assert notice.stops
    assert notice.joint == 1
    assert "j1: EMCY 0x7305 (INCREMENTAL_SENSOR_FAULT), register 0x21, data 01 02 03 04 05" in notice.text
    (passive,) = unit.decode([frame(0x081, struct.pack("<HB5s", 0x8120, 0x11, b"")), b""]).notices
    assert (passive.severity, passive.stops) == ("warning", False)
    (reset,) = unit.decode([frame(0x081, bytes(8)), b""]).notices
    assert (reset.severity, reset.stops) == ("info", False)
    (unknown,) = unit.decode([frame(0x081, struct.pack("<HB5s", 0xFF01, 0x81, b"")), b""]).notices
    assert "EMCY 0xff01 (of the maker)" in unknown.text


@pytest.mark.parametrize(
    ("foreign", "text", "stops"),
    [
        (frame(0x181, bytes(7)), "joint j0: TPDO1 has 7 bytes, expected 8", True),
        (frame(0x281, b"\x0a\x00"), "joint j0: TPDO2 has 2 bytes, expected 3", True),
        (frame(0x081, b"\x10"), "joint j0: EMCY has 1 bytes, expected 8", False),
        (frame(0x432, bytes(8)), "sensor imu: a frame has 8 bytes, expected 6", False),
    ],
)
def test_a_wrong_length_changes_nothing_and_is_told_at_its_onset(foreign: bytes, text: str, stops: bool) -> None:
    unit = decoder("torque", "torque")
    unit.decode([report(1, 77), report(2, 88)])
    for _ in range(2):
        (notice,) = unit.decode([foreign, report(2, 88)]).notices
        assert notice.text.startswith(text)
        assert (notice.kind, notice.stops) == ("frame_length", stops)
        measured = unit.decode([foreign, report(2, 88)])
        assert measured.notices == ()
        assert measured.position[0] == pytest.approx(77 / 4096 / 100 * 2 * np.pi)
        assert unit.decode([report(1, 77), report(2, 88)]).notices == ()


def test_error_frames_are_handed_out_with_their_bus() -> None:
    unit = decoder("torque", "torque")
    off, passive = frame(0x20000040, bytes(8)), frame(0x20000004, bytes.fromhex("0010000000000080"))
    measured = unit.decode([report(1) + off, report(2)])
    assert [(bus, each.troubles) for bus, each in measured.errors] == [(0, (Trouble.BUS_OFF,))]
    assert measured.heard == (True, True)
    measured = unit.decode([off, passive + passive])
    assert [bus for bus, _ in measured.errors] == [0, 1, 1]
    assert measured.heard == (False, False)
    assert measured.silent_cycles.tolist() == [1, 1]
    assert unit.decode([b"", report(2)]).heard == (False, True)


def test_mode_and_error_come_by_sdo_as_well() -> None:
    unit = decoder("torque", "torque")
    assert list(unpack(upload_request(2, 0x6061))) == [(0x602, bytes.fromhex("4061600000000000"))]
    assert list(unpack(upload_request(2, 0x603F))) == [(0x602, bytes.fromhex("403F600000000000"))]
    answers = frame(0x582, bytes.fromhex("4F61600008000000")) + frame(0x582, bytes.fromhex("4B3F600005730000"))
    before = unit.decode([report(1), report(2) + mode_report(2, 10)])
    assert before.mode.tolist() == [8, 10]
    measured = unit.decode([report(1), report(2) + answers])
    assert measured.mode.tolist() == [8, 8]
    assert measured.error_code.tolist() == [0, 0x7305]
    assert measured.answered == {1}
    assert unit.decode([report(1), report(2)]).answered == set()


def test_a_boot_up_in_operation_is_a_lost_node() -> None:
    unit = decoder("torque")
    assert unit.decode([frame(0x701, b"\x05"), b""]).notices == ()
    (reset,) = unit.decode([frame(0x701, b"\x00"), b""]).notices
    assert (reset.kind, reset.stops) == ("node_lost", True)
    assert "was reset" in reset.text
    assert unit.decode([frame(0x701, b"\x00"), b""]).reset == {0}
    assert unit.decode([frame(0x701, b"\x05"), b""]).reset == set()
    (left,) = unit.decode([frame(0x701, b"\x7f"), b""]).notices
    assert "left OPERATIONAL" in left.text


def test_sensors_are_absent_until_whole_and_then_age() -> None:
    unit = decoder("torque")
    first, second = frame(0x50, bytes.fromhex("0b0032ffce01f403")), frame(0x51, bytes.fromhex("e8fc180000000000"))
    assert unit.decode([b"", first]).wrenches == ()
    assert unit.decode([b"", second]).wrenches == ()
    (wrench,) = unit.decode([b"", first + second]).wrenches
    assert wrench.force_in_sensor == pytest.approx((1.0, -1.0, 10.0))
    assert wrench.torque_in_sensor == pytest.approx((0.5, -0.5, 0.0))
    assert wrench.age_cycles == 0
    assert unit.decode([b"", b""]).wrenches[0].age_cycles == 1
    wrong_mark = frame(0x50, bytes.fromhex("0c0032ffce01f403"))
    assert unit.decode([b"", wrong_mark + second]).wrenches[0].age_cycles == 2


def test_inertial_units_need_all_three_frames() -> None:
    unit = decoder("torque")
    gyro = frame(0x432, bytes.fromhex("0200fe000100"))
    acceleration = frame(0x434, bytes.fromhex("0000000009d0"))
    orientation = frame(0x421, bytes.fromhex("7fff000000000000"))
    assert unit.decode([gyro + acceleration, b""]).imus == ()
    (sample,) = unit.decode([orientation + gyro + acceleration, b""]).imus
    assert sample.angular_velocity_in_imu == (1.0, -1.0, 0.5)
    assert sample.acceleration_in_imu == (0.0, 0.0, 9.8125)
    assert sample.orientation_imu_to_world == (1.0, 0.0, 0.0, 0.0)
    assert unit.decode([gyro, b""]).imus[0].age_cycles == 1


def test_broken_buffers_and_doubled_identifiers_are_refused() -> None:
    with pytest.raises(ProfileError, match="whole frames"):
        decoder("torque").decode([report(1)[:-1], b""])
    clash = wrist().model_copy(update={"bus": "a", "can_id": 0x181})
    with pytest.raises(HalError, match="wrist: identifier 0x181 is used twice"):
        # The description refuses it as well, when it is loaded.
        Decoder(robot("torque").model_copy(update={"force_torque_sensors": (clash,)}), np.zeros(1))
