from __future__ import annotations

import numpy as np
import pytest

from hal.holding import HISTORY, HoldingRule, Predictor
from hal.profile.firmware import FirmwareGains, position_torque
from hal.setpoint import Hold
from tests.hal.robots import robot


def test_the_prediction_is_exact_for_constant_acceleration() -> None:
    period, start, speed, acceleration = 0.002, 0.3, -0.7, 11.0

    def position(time: float) -> float:
        return start + speed * time + 0.5 * acceleration * time**2

    predictor = Predictor(np.array([position(0.0)]), period)
    for cycle in range(1, HISTORY + 3):
        predictor.update(np.array([position(cycle * period)]))
    last = (HISTORY + 2) * period
    for cycles in (1, 2):
        ahead, velocity = predictor.ahead(cycles)
        assert ahead[0] == pytest.approx(position(last + cycles * period), abs=1e-12)
        assert velocity[0] == pytest.approx(speed + acceleration * (last + cycles * period), abs=1e-9)


def test_at_rest_the_prediction_is_the_position_itself() -> None:
    position, velocity = Predictor(np.array([0.123456789]), 0.001).ahead(2)
    assert (position[0], velocity[0]) == (0.123456789, 0.0)


@pytest.mark.parametrize("torque", [-80.0, -2.0, 0.5, 30.0])
@pytest.mark.parametrize("velocity", [0.0, 0.4])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_first_position_torque_is_the_last_torque_mode_torque(
    torque: float, velocity: float, direction: int
) -> None:
    description = robot("torque", joint={"direction": direction})
    rule, gains = HoldingRule(description), FirmwareGains.of(description)
    target = rule.target(np.array([torque]), np.array([0.2]), np.array([velocity]))
    first = position_torque(target, np.zeros(1), np.array([0.2]), np.array([velocity]), gains)
    # Half a per mille of 50 N·m: how finely the torque was commanded.
    assert first[0] == pytest.approx(torque, abs=0.025 + 1e-9)


def test_a_wrong_dead_zone_makes_no_step_either() -> None:
    description = robot("torque")
    true = FirmwareGains.of(robot("torque", drive={"dead_zone": 3.0}))
    rule = HoldingRule(description)
    effort = rule.effort(np.array([20.0]))
    delivered = effort - 3.0
    target = rule.target(np.array([20.0]), np.array([0.0]), np.array([0.0]))
    assert position_torque(target, np.zeros(1), np.zeros(1), np.zeros(1), true)[0] == pytest.approx(
        delivered[0], abs=1e-9
    )


def test_a_hold_ramps_to_nothing_and_starts_and_ends_without_slope() -> None:
    hold: Hold | None = Hold(np.array([4.0]), 100, 100)
    offsets = []
    while hold is not None:
        offsets.append(float(hold.offset[0]))
        hold = hold.advanced()
    steps = -np.diff([*offsets, 0.0])
    assert offsets[0] == 4.0
    assert len(offsets) == 100
    assert (steps > 0.0).all()
    assert offsets[50] == pytest.approx(2.0)
    assert max(steps[0], steps[-1]) < 0.05 * steps[50]


def test_the_ramp_lasts_hold_ramp_s() -> None:
    assert HoldingRule(robot("torque")).cycles == 10


@pytest.mark.parametrize("elapsed", [2, 3, HISTORY + 4])
def test_left_out_syncs_keep_the_velocity(elapsed: int) -> None:
    period, speed = 0.002, 1.7
    predictor = Predictor(np.zeros(1), period)
    cycle = 0
    for step in [1] * HISTORY + [elapsed, 1, elapsed]:
        cycle += step
        predictor.update(np.array([speed * cycle * period]), step)
        if cycle >= HISTORY:
            assert predictor.mean_velocity[0] == pytest.approx(speed, abs=1e-9)
            ahead, velocity = predictor.ahead(1)
            assert ahead[0] == pytest.approx(speed * (cycle + 1) * period, abs=1e-9)
            assert velocity[0] == pytest.approx(speed, abs=1e-6)
