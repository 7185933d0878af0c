"""Friction compensation: passive against every friction not below its share, at any delay; smooth slow motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from controller_service.estimation import VelocityEstimator
from controller_service.friction import FrictionCompensator, FrictionModel, slope_limit
from controller_service.model import Array
from schemas.control_law import FrictionCompensation
from schemas.controller import TaskGains
from schemas.errors import ConfigurationError
from schemas.load import Robot

PERIOD = 0.002
GEAR = 250.0
INERTIA = 3.0
SUBSTEPS = 20
COUNT = 2.0 * math.pi / (4096 * GEAR)
LOOP = TaskGains(stiffness=25.0, damping=10.0, weight=1.0)
LAMBDA = 10.0
GRID = np.concatenate([np.linspace(-3.0, 3.0, 301), np.geomspace(1e-6, 1.0, 60), -np.geomspace(1e-6, 1.0, 60)])


def compensator(arm: Robot, **changes: object) -> FrictionCompensator:
    return FrictionCompensator(arm.description, FrictionCompensation.model_validate(changes))


def torques(of: FrictionCompensator, velocities: Array) -> Array:
    return np.array([of.torque(np.full(9, velocity)) for velocity in velocities])


def test_the_model_reaches_the_joint_through_its_gear_and_entries_hold_at_the_joint(arm: Robot) -> None:
    entries = FrictionCompensation.model_validate({"joints": {"joint2": {"coulomb": 7.0, "viscous": 3.0}}}).joints
    model = FrictionModel(arm.description, 0.04, 0.0005, entries)
    assert model.coulomb == pytest.approx([10, 10, 7, 10, 10, 10, 8, 8, 8])
    assert model.viscous == pytest.approx([31.25, 31.25, 3.0, 31.25, 31.25, 31.25, 20, 20, 20])


def test_an_unknown_joint_is_refused_with_the_known_ones(arm: Robot) -> None:
    with pytest.raises(ConfigurationError, match=r"friction_compensation\.joints: .*'elbow'.*joint0, .*joint8"):
        compensator(arm, joints={"elbow": {"coulomb": 1.0, "viscous": 1.0}})


def test_the_torque_is_the_share_of_the_model_odd_and_zero_at_rest(arm: Robot) -> None:
    of = compensator(arm, share=0.6, smoothing_velocity=0.02)
    velocity = np.linspace(-2.0, 2.0, 9)
    expected = 0.6 * (of.model.coulomb * np.tanh(velocity / 0.02) + of.model.viscous * velocity)
    assert of.torque(velocity) == pytest.approx(expected, rel=1e-14)
    assert np.array_equal(of.torque(-velocity), -of.torque(velocity))
    assert not of.torque(np.zeros(9)).any()


def test_the_slope_is_bounded_and_the_bound_is_reached_at_rest(arm: Robot) -> None:
    of = compensator(arm, smoothing_velocity=0.05)
    velocities = np.linspace(-0.3, 0.3, 2001)
    slopes = np.diff(torques(of, velocities), axis=0) / np.diff(velocities)[:, np.newaxis]
    assert np.all(slopes > 0.0)
    assert np.all(slopes <= of.slope * (1.0 + 1e-9))
    assert slopes.max(axis=0) == pytest.approx(of.slope, rel=1e-4)
    assert of.slope == pytest.approx(0.6 * (of.model.coulomb / 0.05 + of.model.viscous))


def test_no_true_friction_of_at_least_the_share_is_over_compensated(arm: Robot) -> None:
    random = np.random.default_rng(1)
    for _ in range(50):
        share, smoothing = random.uniform(0.0, 1.0), 10.0 ** random.uniform(-4, 0)
        of = compensator(arm, share=share, smoothing_velocity=smoothing)
        coulomb = share * of.model.coulomb * random.uniform(1.0, 2.0, 9)
        viscous = share * of.model.viscous * random.uniform(1.0, 2.0, 9)
        breakaway, stribeck = coulomb * random.uniform(1.0, 1.5, 9), 10.0 ** random.uniform(-4, -1)
        velocity = GRID[:, np.newaxis]
        bound = coulomb + (breakaway - coulomb) * np.exp(-((velocity / stribeck) ** 2))
        true = np.sign(velocity) * bound + viscous * velocity
        assert np.all((true - torques(of, GRID)) * velocity >= -1e-12)


@dataclass
class Joint:
    """One joint with Stribeck friction solved by impulses, its encoder, velocity estimate and delayed compensation."""

    of: FrictionCompensator | None
    velocity: float = 0.0
    position: float = 0.0
    motor: float = 0.04
    delay: int = 1
    work: float = 0.0
    """∫ (τ_fc − τ_f) q̇ dt."""
    velocities: list[float] = field(default_factory=list)
    commands: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._estimator = VelocityEstimator(PERIOD, 60.0)
        self._waiting = [0.0] * self.delay

    def cycle(self, push: float = 0.0, loop: PositionLoop | None = None) -> None:
        measured = round(self.position / COUNT) * COUNT
        estimate = float(self._estimator.estimate(np.array([measured])).velocity[0])
        command = 0.0 if self.of is None else float(self.of.torque(np.full(9, estimate))[0])
        self._waiting.append(command + (0.0 if loop is None else loop.torque(measured, estimate)))
        torque, step = self._waiting.pop(0), PERIOD / SUBSTEPS
        for _ in range(SUBSTEPS):
            drag = GEAR**2 * 0.0005 * self.velocity
            bound = GEAR * (self.motor + 0.01 * math.exp(-((GEAR * self.velocity / 0.2) ** 2)))
            free = self.velocity + step * (torque + push - drag) / INERTIA
            impulse = max(-bound * step, min(bound * step, INERTIA * free))
            before, self.velocity = self.velocity, free - impulse / INERTIA
            self.position += step * self.velocity
            self.work += (step * (torque - drag) - impulse) * 0.5 * (before + self.velocity)
        self.velocities.append(self.velocity)
        self.commands.append(torque)

    def go(self, seconds: float, push: float = 0.0, loop: PositionLoop | None = None) -> Joint:
        for _ in range(round(seconds / PERIOD)):
            self.cycle(push, loop)
        return self


class PositionLoop:
    """The law (3) on one joint: I (q̈ʳ + λ s) along a ramp."""

    def __init__(self, speed: float) -> None:
        self._speed, self._target, self._reference = speed, 0.0, 0.0

    def torque(self, position: float, velocity: float) -> float:
        wanted = LOOP.stiffness * (self._target - position) + LOOP.damping * (self._speed - velocity)
        torque = INERTIA * (wanted + LAMBDA * (self._reference - velocity))
        self._target += PERIOD * self._speed
        self._reference += PERIOD * wanted
        return torque


@pytest.mark.parametrize("smoothing", [0.001, 0.02, 0.2])
@pytest.mark.parametrize("delay", [1, 5])
def test_a_joint_comes_to_rest_and_stays_without_chatter_at_any_slope_and_delay(
    arm: Robot, smoothing: float, delay: int
) -> None:
    joint = Joint(compensator(arm, smoothing_velocity=smoothing), velocity=1.0, delay=delay).go(2.0)
    assert max(map(abs, joint.velocities[250:])) == 0.0
    assert max(map(abs, joint.commands[250:])) < 1e-6 * GEAR * 0.04
    moving = np.array(joint.velocities[:250])
    assert np.all(moving >= 0.0)
    assert np.all(np.diff(moving[: np.count_nonzero(moving)]) < 0.0)


@pytest.mark.parametrize("delay", [1, 5, 20])
def test_friction_and_compensation_together_take_energy_from_any_motion(arm: Robot, delay: int) -> None:
    random = np.random.default_rng(delay)
    joint = Joint(compensator(arm, share=1.0, smoothing_velocity=0.005), delay=delay)
    for _ in range(60):
        push = 60.0 * random.standard_normal()
        for _ in range(int(random.integers(5, 50))):
            joint.cycle(push)
            assert joint.work <= 1e-9
    assert joint.work < -1.0


def test_a_smaller_push_keeps_it_moving_but_none_smaller_starts_it(arm: Robot) -> None:
    def slowest(of: FrictionCompensator | None, push: float) -> float:
        return Joint(of, velocity=0.3).go(3.0, push).velocity

    of = compensator(arm, smoothing_velocity=0.2)
    assert slowest(None, 9.5) == 0.0
    assert slowest(of, 9.5) > 0.3
    assert slowest(of, 0.4 * GEAR * 0.04) == 0.0
    for of_none in (None, of):
        assert Joint(of_none).go(0.5, 12.4).velocity == 0.0
        assert Joint(of_none).go(0.5, 12.6).velocity > 0.0
    assert Joint(of).go(0.5, 12.6).velocity > 2.0 * Joint(None).go(0.5, 12.6).velocity


@pytest.mark.parametrize("speed", [0.005, 0.02])
def test_slow_motion_is_smooth_within_the_slope_limit_and_sticks_and_slips_far_beyond(arm: Robot, speed: float) -> None:
    limit = slope_limit(np.full(9, INERTIA), LAMBDA, LOOP)
    assert limit == pytest.approx(0.5 * INERTIA * (10.0 + 10.0 - 2.0))
    coulomb = 0.6 * GEAR * 0.04

    def unevenness(slope: float) -> float:
        of = compensator(arm, smoothing_velocity=coulomb / slope)
        assert of.dry_slope[0] == pytest.approx(slope)
        return float(np.std(Joint(of).go(8.0, loop=PositionLoop(speed)).velocities[2000:])) / speed

    assert unevenness(limit[0]) < 0.01
    assert unevenness(4.0 * limit[0]) > 1.0


def test_the_slope_limit_without_any_gain_of_a_task_is_that_of_the_integral_term() -> None:
    assert slope_limit(np.array([2.0]), 4.0, TaskGains(stiffness=0.0, damping=0.0, weight=0.0)) == pytest.approx([4.0])


def test_nothing_is_shared_by_two_calls(arm: Robot) -> None:
    of = compensator(arm)
    first = of.torque(np.ones(9))
    kept = first.copy()
    of.torque(np.zeros(9))
    assert np.array_equal(first, kept)
