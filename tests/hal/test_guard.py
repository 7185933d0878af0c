"""In torque mode no clamped target bounds the motion: too fast or out of range stops the robot."""

from __future__ import annotations

import numpy as np
import pytest

from hal.guard import OVERSPEED, RANGE_MARGIN, MotionGuard
from schemas.base import ControlMode
from schemas.messages import HalStatus
from tests.hal.robots import robot
from tests.hal.test_cycle import Loop

T = ControlMode.TORQUE
ROBOT = robot("torque", "torque")
LIMIT = np.array([joint.velocity_limit for joint in ROBOT.joints])
HIGH = np.array([joint.position_max for joint in ROBOT.joints])
LOW = np.array([joint.position_min for joint in ROBOT.joints])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_bounds_are_those_of_the_description_and_their_margins(sign: float) -> None:
    guard = MotionGuard(ROBOT)
    assert guard.review(np.zeros(2), sign * 0.999 * OVERSPEED * LIMIT) == []
    notices = guard.review(np.zeros(2), np.array([0.0, sign * 1.001 * OVERSPEED * LIMIT[1]]))
    assert [(notice.kind, notice.joint, notice.stops) for notice in notices] == [("overspeed", 1, True)]
    assert ROBOT.joint_names[1] in notices[0].text
    end = HIGH if sign > 0.0 else LOW
    margin = RANGE_MARGIN * (HIGH - LOW)
    assert guard.review(end + sign * 0.99 * margin, np.zeros(2)) == []
    outside = np.array([end[0] + sign * 1.01 * margin[0], 0.0])
    assert [notice.kind for notice in guard.review(outside, np.zeros(2))] == ["out_of_range"]


def test_a_runaway_in_torque_mode_is_stopped_by_the_hal_alone() -> None:
    loop = Loop(positions=[0.0, 0.0])
    for _ in range(10):
        loop.cycle(T, torque=(0.0, 0.0))
    assert loop.core.status is HalStatus.ACTIVE
    loop.velocity = np.array([2.0 * LIMIT[0], 0.0])
    for _ in range(12):
        loop.position = loop.position + loop.velocity * loop.robot.period_s
        loop.cycle(T, torque=(0.0, 0.0))
    assert loop.core.status is HalStatus.SAFE_STOP
    event = next(event for event in loop.core.drain_events() if event.kind == "overspeed")
    assert event.joint == loop.robot.joint_names[0]
    assert set(loop.modes) == {8}
