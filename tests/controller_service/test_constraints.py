"""Limits as bounds: torque beside what the law adds, speed and range with and without u_K, always lower ≤ upper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_service.constraints import JointLimits
from controller_service.model import Configuration, RobotModel
from schemas.load import Robot


@pytest.fixture(scope="module")
def limits(arm: Robot) -> JointLimits:
    return JointLimits(arm.description, 0.05)


def at(arm: Robot, q: float, v: float) -> Configuration:
    return RobotModel(arm).configure(np.full(9, q), np.full(9, v))


def test_torque_bounds_are_met_exactly_when_the_whole_torque_is_within_its_limit(
    arm: Robot, limits: JointLimits
) -> None:
    now = at(arm, 0.3, 0.4)
    added = np.linspace(-40.0, 40.0, 9)
    lower, upper = limits.torque_bounds(now, added)
    for torque, edge in ((limits.torque, upper), (-limits.torque, lower)):
        acceleration = np.linalg.solve(now.mass, torque - now.nonlinear - added)
        assert np.allclose(now.mass @ acceleration, edge)
    assert np.allclose(limits.torque_bounds(now, np.zeros(9)) - (lower, upper), added)


@pytest.mark.parametrize("q", [-4.0, -2.6, -2.499, -1.0, 0.0, 2.49, 2.5, 2.51, 9.0])
@pytest.mark.parametrize("v", [-5.0, -1.0, 0.0, 3.0, 8.0])
def test_bounds_never_cross(arm: Robot, limits: JointLimits, q: float, v: float) -> None:
    now = at(arm, q, v)
    lower, upper = limits.acceleration_bounds(now)
    assert (lower <= upper).all()
    for size in (1.0, 50.0, 5000.0):
        narrowed = limits.acceleration_bounds(now, size * np.linspace(-1.0, 1.0, 9))
        assert (narrowed[0] <= narrowed[1]).all()
    if q > 2.5 and v == 0.0:
        assert (upper < 0.0).all()
    if q < -2.5 and v == 0.0:
        assert (lower > 0.0).all()


def test_the_reference_and_the_motion_without_the_disturbance_both_keep_the_bounds(
    arm: Robot, limits: JointLimits
) -> None:
    """Every q̈ʳ within the narrowed bounds: l ≤ q̈ʳ ≤ u and l ≤ q̈ʳ + M⁻¹u_K ≤ u; one at each end is on the edge."""
    model, rng = RobotModel(arm), np.random.default_rng(24)
    for _ in range(200):
        now = model.configure(rng.uniform(-2.45, 2.45, 9), rng.uniform(-3.0, 3.0, 9))
        caused = rng.normal(scale=20.0, size=9)
        wide, narrow = limits.acceleration_bounds(now), limits.acceleration_bounds(now, caused)
        for end in narrow:
            for acceleration in (end, end + caused):
                assert (wide[0] - 1e-9 <= acceleration).all()
                assert (acceleration <= wide[1] + 1e-9).all()
        assert np.allclose(np.minimum(narrow[0], narrow[0] + caused), wide[0])
        assert np.allclose(np.maximum(narrow[1], narrow[1] + caused), wide[1])
        assert np.array_equal(limits.acceleration_bounds(now, np.zeros(9)), wide)


def test_a_joint_beyond_its_range_changes_no_other_joints_bounds(arm: Robot, limits: JointLimits) -> None:
    now = at(arm, 0.7, 0.4)
    inside = limits.acceleration_bounds(now)
    for i, q in ((0, 2.6), (4, -2.6), (8, 3.5)):
        position = now.position.copy()
        position[i] = q
        bounds = limits.acceleration_bounds(replace(now, position=position))
        assert np.array_equal(np.delete(bounds, i, axis=1), np.delete(inside, i, axis=1))


def test_a_joint_pushed_as_hard_as_allowed_stops_at_its_range_and_keeps_its_speed(
    arm: Robot, limits: JointLimits
) -> None:
    """Every joint alone with gravity balanced, at the upper bound of its acceleration for two seconds."""
    period = arm.description.period_s
    model = RobotModel(arm)
    q, v = np.zeros(9), np.zeros(9)
    deceleration = np.zeros(9)
    for _ in range(1000):
        now = model.configure(q, v)
        upper = limits.acceleration_bounds(now)[1]
        a = np.minimum(upper, 20.0)
        deceleration = np.minimum(deceleration, a)
        q, v = q + period * v + 0.5 * period**2 * a, v + period * a
        assert (q <= 2.5 + 1e-4).all()
        assert (np.abs(v) <= 3.0 + 1e-9).all()
    assert (q > 2.45).all()
    assert (-deceleration * now.mass.diagonal() < limits.torque).all()
