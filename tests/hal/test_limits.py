from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.limits import Limits, Onsets
from tests.hal.robots import robot

LIMITS = Limits.of(robot("torque", "torque"))
"""Range ±2 rad, 5 rad/s and 20 kN·m/s at 500 Hz: steps of 0.01 rad and 40 N·m; ±100 N·m."""
number = st.floats(-1e6, 1e6)


def acted(result: tuple[tuple[str, np.ndarray], ...]) -> dict[str, list[bool]]:
    return {name: mask.tolist() for name, mask in result}


def test_a_position_moves_one_step_a_cycle_within_the_range() -> None:
    limited = LIMITS.position(np.array([1.0, 3.0]), np.array([0.0, 1.995]))
    assert limited.value == pytest.approx([0.01, 2.0])
    assert acted(limited.acted) == {"position range": [False, True], "velocity limit": [True, False]}


def test_a_joint_out_of_its_range_is_led_back_not_thrown() -> None:
    assert LIMITS.position(np.array([3.0, 0.0]), np.array([3.0, 0.0])).value == pytest.approx([2.99, 0.0])


def test_torque_and_its_rate() -> None:
    limited = LIMITS.torque(np.array([150.0, -50.0]), np.array([90.0, 10.0]))
    assert limited.value == pytest.approx([100.0, -30.0])
    assert acted(limited.acted) == {"torque limit": [True, False], "torque rate limit": [False, True]}


@settings(deadline=None)
@given(number, number)
def test_no_command_passes_the_limits(commanded: float, previous: float) -> None:
    held = float(np.clip(previous, -2.0, 2.0))
    value = LIMITS.position(np.array([commanded] * 2), np.array([held] * 2)).value
    assert (np.abs(value) <= 2.0).all()
    assert (np.abs(value - held) <= 0.01 + 1e-12).all()
    torque = float(np.clip(previous, -100.0, 100.0))
    value = LIMITS.torque(np.array([commanded] * 2), np.array([torque] * 2)).value
    assert (np.abs(value) <= 100.0).all()
    assert (np.abs(value - torque) <= 40.0 + 1e-9).all()


def test_a_servos_limit_lies_between_zero_and_the_joints() -> None:
    assert LIMITS.servo_limit(np.array([-1.0, 500.0])).value.tolist() == [0.0, 100.0]
    assert LIMITS.servo_limit(np.array([7.0, 8.0])).value.tolist() == [7.0, 8.0]


def test_onsets_are_told_once_and_again_after_a_release() -> None:
    onsets, yes, no = Onsets(2), np.array([True, False]), np.array([False, False])
    assert onsets.update((("a", yes),)) == [("a", 0)]
    assert onsets.update((("a", yes),)) == []
    assert onsets.update((("a", no),)) == []
    assert onsets.update((("a", yes),)) == [("a", 0)]
    assert onsets.update((("a", np.array([True, True])),)) == [("a", 1)]
