from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.profile.units import DriveUnits
from tests.hal.robots import robot

UNITS = DriveUnits.of(robot("torque", "torque"))
"""Gear 100, 4096 counts a turn, 0.5 N·m rated; the second joint reversed, zero at 0.1 rad."""


def test_a_joint_turn_is_gear_times_encoder_counts_with_direction_and_offset() -> None:
    counts = np.array([409600, 409600])
    assert UNITS.position_from_counts(counts) == pytest.approx([2 * math.pi, 0.1 - 2 * math.pi])
    assert UNITS.counts_from_position(np.array([2 * math.pi, 0.1 - 2 * math.pi])).tolist() == [409600, 409600]


def test_rated_torque_is_a_thousand_per_mille_times_the_gear() -> None:
    assert UNITS.torque_from_per_mille(np.array([1000, 1000])) == pytest.approx([50.0, -50.0])
    assert UNITS.per_mille_from_torque(np.array([50.0, 50.0])).tolist() == [1000, -1000]


def test_torque_limits_are_magnitudes_rounded_down() -> None:
    assert UNITS.per_mille_from_limit(np.array([10.04, 10.0])).tolist() == [200, 200]
    assert UNITS.limit_from_per_mille(np.array([200, 200], dtype=np.uint16)) == pytest.approx([10.0, 10.0])


def test_numbers_beyond_the_bus_saturate() -> None:
    assert UNITS.counts_from_position(np.array([1e9, 1e9])).tolist() == [2**31 - 1, -(2**31 - 1)]
    assert UNITS.per_mille_from_torque(np.array([1e9, -1e9])).tolist() == [32767, 32767]
    assert UNITS.per_mille_from_limit(np.array([1e9, -1.0])).tolist() == [65535, 0]


@settings(deadline=None)
@given(st.integers(-(2**30), 2**30), st.integers(-32767, 32767))
def test_round_trips_are_exact(counts: int, per_mille: int) -> None:
    both = np.array([counts, counts])
    assert (UNITS.counts_from_position(UNITS.position_from_counts(both)) == both).all()
    torque = np.array([per_mille, per_mille])
    assert (UNITS.per_mille_from_torque(UNITS.torque_from_per_mille(torque)) == torque).all()


def test_select_keeps_the_scales_of_the_joints_named() -> None:
    picked = UNITS.select(np.array([1]))
    assert picked.position_from_counts(np.array([0])) == pytest.approx([0.1])
    assert picked.radian_per_count[0] == UNITS.radian_per_count[1]
