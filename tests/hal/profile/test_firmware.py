from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.profile.firmware import (
    SMOOTHING,
    FirmwareGains,
    dead_zone,
    holding_offset,
    inverse_dead_zone,
    position_torque,
)
from tests.hal.robots import robot

GAINS = FirmwareGains.of(robot("torque"))
"""k_p 4000, k_d 40, d 2, limit 100."""
torques = st.floats(-90.0, 90.0)


def one(value: float) -> np.ndarray:
    return np.array([value])


def test_dead_zone() -> None:
    assert dead_zone(np.array([-5.0, -2.0, 0.5, 2.0, 5.0]), one(2.0)).tolist() == [-3.0, 0.0, 0.0, 0.0, 3.0]


@settings(deadline=None)
@given(torques)
def test_the_exact_inverse_is_undone_by_the_dead_zone(torque: float) -> None:
    assert dead_zone(inverse_dead_zone(one(torque), one(2.0)), one(2.0))[0] == pytest.approx(torque, abs=1e-12)


@settings(deadline=None)
@given(torques)
def test_the_smoothed_inverse_falls_short_only_inside_its_band(torque: float) -> None:
    error = dead_zone(inverse_dead_zone(one(torque), one(2.0), SMOOTHING), one(2.0))[0] - torque
    assert abs(error) <= (SMOOTHING * 2.0 if abs(torque) < SMOOTHING * 2.0 else 1e-12)


@settings(deadline=None)
@given(torques, st.floats(-1e-3, 1e-3))
def test_the_smoothed_inverse_is_continuous(torque: float, step: float) -> None:
    change = inverse_dead_zone(one(torque + step), one(2.0), SMOOTHING) - inverse_dead_zone(
        one(torque), one(2.0), SMOOTHING
    )
    assert abs(change[0]) <= abs(step) * (1.0 + 1.0 / SMOOTHING) + 1e-9


def test_without_dead_zone_the_inverse_is_the_identity() -> None:
    assert inverse_dead_zone(np.array([-3.0, 0.0, 3.0]), np.zeros(3), SMOOTHING).tolist() == [-3.0, 0.0, 3.0]


def test_position_torque_by_hand() -> None:
    # 4000 · 0.01 + 40 · (0 − 0.5) = 20, less the dead zone 2.
    assert position_torque(one(0.01), one(0.0), one(0.0), one(0.5), GAINS)[0] == pytest.approx(18.0)
    assert position_torque(one(1.0), one(0.0), one(0.0), one(0.0), GAINS)[0] == 100.0


@settings(deadline=None)
@given(torques, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_the_firmware_gives_the_held_torque_at_the_holding_target(
    torque: float, position: float, velocity: float
) -> None:
    target = one(position) + holding_offset(one(torque), one(velocity), GAINS)
    assert position_torque(target, one(0.0), one(position), one(velocity), GAINS)[0] == pytest.approx(torque, abs=1e-8)
