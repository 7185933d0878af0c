from __future__ import annotations

import numpy as np
import pytest

from hal.drivers import DriverGroup
from hal.errors import HalError
from hal.setpoint import Hold, Setpoint
from schemas.base import ControlMode
from tests.hal.robots import frame, robot

ENABLE = 0x0F


def words(count: int) -> np.ndarray:
    return np.full(count, ENABLE, dtype=np.uint16)


def test_position_command_golden_bytes() -> None:
    # 2π at gear 100 and 4096 counts a turn is 409600 = 0x64000 counts; CSP is 8.
    group = DriverGroup(robot("position_pd"))
    sent = group.encode(Setpoint(0, ControlMode.POSITION, np.array([2 * np.pi])), words(1))
    assert sent == (frame(0x201, bytes.fromhex("0f 00 08 00 40 06 00")), b"")


def test_torque_command_golden_bytes() -> None:
    # 3 N·m delivered through a dead zone of 2 N·m is 5 N·m asked: 100 ‰ of 0.5 N·m · 100; reversed on the second joint.
    group = DriverGroup(robot("torque", "torque"))
    sent = group.encode(Setpoint(0, ControlMode.TORQUE, torque=np.array([3.0, 3.0])), words(2))
    assert sent == (
        frame(0x301, bytes.fromhex("0f 00 0a 64 00")),
        frame(0x302, bytes.fromhex("0f 00 0a 9c ff")),
    )


def test_servo_command_golden_bytes() -> None:
    group = DriverGroup(robot("servo"))
    setpoint = Setpoint(0, ControlMode.SERVO, np.array([0.0]), torque_limit=np.array([10.0]))
    assert group.encode(setpoint, words(1))[0] == frame(0x201, bytes.fromhex("0f 00 00 00 00 00 c8 00"))
    # In mode position the joint's own limit of 100 N·m holds: 2000 ‰.
    setpoint = Setpoint(0, ControlMode.POSITION, np.array([0.0]))
    assert group.encode(setpoint, words(1))[0] == frame(0x201, bytes.fromhex("0f 00 00 00 00 00 d0 07"))


def test_what_is_left_of_a_hold_goes_on_the_bus() -> None:
    group = DriverGroup(robot("torque"))
    hold = Hold(np.array([2 * np.pi]), 10, 5)
    sent = group.encode(Setpoint(0, ControlMode.POSITION, np.array([np.pi]), hold=hold), words(1))
    assert sent[0] == frame(0x201, bytes.fromhex("0f 00 08 00 40 06 00"))


def test_kinds_mix_on_the_buses_in_joint_order() -> None:
    description = robot("servo", "position_pd", "torque", "position_pd")
    group = DriverGroup(description)
    sent = group.encode(Setpoint(0, ControlMode.POSITION, np.array([0.0, 0.1, 0.2, 0.3])), words(4))
    assert sent == (
        frame(0x201, bytes.fromhex("0f 00 00 00 00 00 d0 07")) + frame(0x203, bytes.fromhex("0f 00 08 00 00 00 00")),
        frame(0x202, bytes.fromhex("0f 00 08 00 00 00 00")) + frame(0x204, bytes.fromhex("0f 00 08 00 00 00 00")),
    )
    assert group.reports_torque.tolist() == [True, False, True, False]


def test_a_mode_needs_every_drive() -> None:
    group = DriverGroup(robot("torque", "position_pd"))
    assert group.modes == {ControlMode.POSITION}
    assert group.lacking(ControlMode.TORQUE).tolist() == [1]
    assert group.lacking(ControlMode.SERVO).tolist() == [0, 1]
    with pytest.raises(HalError, match="torque is not one of"):
        group.encode(Setpoint(0, ControlMode.TORQUE, torque=np.zeros(2)), words(2))
