"""The joint filter: the gain solves its equation, what the model knows is not late, what it does not know is found."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from controller_service.errors import StateError
from controller_service.joint_filter import JointKalman, JointMotion
from controller_service.model import Array
from schemas.errors import ConfigurationError

PERIOD = 0.001
NOISE = np.array([3e-6, 1e-5, 1e-4])
ACCELERATION, DISTURBANCE = 2.0, 20.0


def filter_of_three() -> JointKalman:
    return JointKalman(PERIOD, NOISE, ACCELERATION, DISTURBANCE)


def residual(of: JointKalman, joint: int, t: float, sigma_q: float, sigma_a: float, sigma_d: float) -> float:
    """Of the Riccati equation in SI units as the module's docstring has it, in units of P's deviations."""
    a = transition(t)
    drive = np.array([t * t / 2.0, t, 0.0])
    q = sigma_a**2 * np.outer(drive, drive) + np.diag([0.0, 0.0, sigma_d**2 * t])
    p = of.predicted_covariance[joint]
    error = a @ p @ a.T - a @ np.outer(p[:, 0], p[0]) @ a.T / (p[0, 0] + sigma_q**2) + q - p
    deviation = np.sqrt(np.diag(p))
    assert np.linalg.eigvalsh(p / np.outer(deviation, deviation)).min() > -1e-12
    return float(np.abs(error / np.outer(deviation, deviation)).max())


def transition(t: float) -> Array:
    return np.array([[1.0, t, t * t / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])


class Joint:
    """Joints that move exactly: accelerations are constant over a period."""

    def __init__(self, position: Array, velocity: Array) -> None:
        self.position, self.velocity = position, velocity

    def move(self, acceleration: Array) -> None:
        self.position = self.position + PERIOD * self.velocity + PERIOD**2 / 2.0 * acceleration
        self.velocity = self.velocity + PERIOD * acceleration


def follow(of: JointKalman, true: Array, believed: Array, velocity: Array) -> tuple[list[JointMotion], Array]:
    """Estimates of joints that accelerate by `true` (K, n) while the model says `believed`, and their true [q, q̇]."""
    joint = Joint(np.array([0.4, -1.0, 2.0]), velocity)
    motions, states = [of.correct(joint.position)], [np.array([joint.position, joint.velocity])]
    for acceleration, u in zip(true, believed, strict=True):
        joint.move(acceleration)
        of.predict(u)
        motions.append(of.correct(joint.position))
        states.append(np.array([joint.position, joint.velocity]))
    return motions, np.array(states)


def settled(of: JointKalman, share: float) -> int:
    """Cycles until the slowest pole has left this share of an error."""
    return math.ceil(math.log(share) / math.log(np.abs(of.poles).max()))


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_the_gain_solves_the_riccati_equation(joint: int) -> None:
    of = filter_of_three()
    assert residual(of, joint, PERIOD, NOISE[joint], ACCELERATION, DISTURBANCE) < 1e-12
    p = of.predicted_covariance[joint]
    variance = p[0, 0] + NOISE[joint] ** 2
    assert of.gain[joint] == pytest.approx(p[:, 0] / variance, rel=1e-12)
    assert of.innovation_deviation[joint] == pytest.approx(math.sqrt(variance))


@pytest.mark.parametrize("white", [0.0, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("walk", [1.01e-10, 1e-3, 1.0, 0.99e4])
def test_up_to_the_bounds_the_equation_is_solved_and_the_poles_are_stable(white: float, walk: float) -> None:
    of = JointKalman(1.0, np.ones(1), white, walk)
    assert np.abs(of.poles).max() < 1.0
    assert residual(of, 0, 1.0, 1.0, white, walk) < 1e-9


def test_the_poles_are_those_of_the_error_and_stable() -> None:
    of = filter_of_three()
    assert of.poles.shape == (3, 3)
    assert np.abs(of.poles).max() < 1.0
    for joint in range(3):
        of_error = np.linalg.eigvals((np.eye(3) - np.outer(of.gain[joint], [1.0, 0.0, 0.0])) @ transition(PERIOD))
        assert np.sort_complex(of.poles[joint]) == pytest.approx(np.sort_complex(of_error), abs=1e-8)
    assert np.abs(of.poles[2]).max() > np.abs(of.poles[0]).max(), "worse encoders are trusted more slowly"


def test_the_pace_of_the_disturbance_is_what_the_documentation_says() -> None:
    smooth = JointKalman(PERIOD, np.array([1e-4]), 0.0, 1.0)
    assert np.abs(np.log(smooth.poles) / PERIOD) == pytest.approx(
        np.full((1, 3), (1.0 / (1e-4 * math.sqrt(PERIOD))) ** (1 / 3)), rel=0.02
    )
    rough = JointKalman(PERIOD, np.array([1e-6]), 10.0, 10.0)
    assert -PERIOD / math.log(np.abs(rough.poles).max()) == pytest.approx(math.sqrt(PERIOD), rel=0.05)
    assert JointKalman(PERIOD, np.array([1e-8]), 10.0, 10.0).poles.real.min() < -0.9


def simulate(of: JointKalman, cycles: int) -> tuple[Array, Array]:
    """Innovations in their deviations and errors of velocity, (cycles − 500, n), with `filter_of_three`'s noises."""
    rng = np.random.default_rng(17)
    joint, disturbance = Joint(np.zeros(3), np.zeros(3)), np.zeros(3)
    innovations, errors = np.zeros((2, cycles, 3))
    for k in range(cycles):
        u = 30.0 * np.sin(0.01 * k + np.arange(3))
        motion = of.correct(joint.position + NOISE * rng.standard_normal(3))
        innovations[k] = of.innovation / of.innovation_deviation
        errors[k] = motion.velocity - joint.velocity
        joint.move(u + disturbance + ACCELERATION * rng.standard_normal(3))
        disturbance = disturbance + DISTURBANCE * math.sqrt(PERIOD) * rng.standard_normal(3)
        of.predict(u)
    return innovations[500:], errors[500:]


def correlation(of: Array) -> Array:
    """Over the lags 1 to 10, (10, n), of innovations of unit deviation."""
    return np.array([np.mean(of[lag:] * of[:-lag], axis=0) for lag in range(1, 11)])


def test_innovations_are_white_and_errors_as_large_as_said_when_the_noises_are() -> None:
    of = filter_of_three()
    white, errors = simulate(of, 20000)
    bound = 4.0 / math.sqrt(len(white))
    assert np.abs(white.mean(axis=0)).max() < bound
    assert np.std(white, axis=0) == pytest.approx(np.ones(3), abs=bound / math.sqrt(2.0))
    assert np.abs(correlation(white)).max() < bound
    corrected = of.predicted_covariance[:, 1, 1] - (of.gain[:, 1] * of.innovation_deviation) ** 2
    # neighbouring errors are alike, so there are fewer independent ones than cycles
    assert np.std(errors, axis=0) == pytest.approx(np.sqrt(corrected), rel=0.1)


def test_innovations_are_coloured_when_the_model_is_trusted_too_much() -> None:
    coloured, _ = simulate(JointKalman(PERIOD, NOISE, ACCELERATION, 0.1 * DISTURBANCE), 20000)
    assert np.abs(correlation(coloured)).max() > 12.0 / math.sqrt(len(coloured))


def test_a_constant_error_of_the_model_is_found_and_leaves_nothing() -> None:
    of = filter_of_three()
    count = settled(of, 1e-11)
    wave = 5.0 * np.sin(0.02 * np.arange(count))[:, None] * np.array([1.0, -1.0, 0.5])
    error = np.array([3.0, -0.7, 10.0])
    motions, states = follow(of, wave + error, wave, np.zeros(3))
    assert motions[-1].acceleration - wave[-1] == pytest.approx(error, rel=1e-7)
    assert motions[-1].velocity == pytest.approx(states[-1, 1], abs=1e-8)
    assert motions[-1].position == pytest.approx(states[-1, 0], abs=1e-12)
    assert np.abs(motions[3].acceleration - wave[2] - error).max() > 0.1, "it has to be found first"


def test_a_ramp_is_not_late_without_any_model() -> None:
    of = filter_of_three()
    none = np.zeros((settled(of, 1e-11), 3))
    speed = np.array([1.0, -2.0, 0.3])
    motions, states = follow(of, none, none, speed)
    assert motions[-1].velocity == pytest.approx(speed, abs=1e-8)
    assert motions[-1].position == pytest.approx(states[-1, 0], abs=1e-11)


@pytest.mark.parametrize("frequency_hz", [1.0, 50.0])
def test_what_the_model_knows_is_not_late_at_any_frequency(frequency_hz: float) -> None:
    of = filter_of_three()
    omega = 2.0 * math.pi * frequency_hz
    t = PERIOD * (np.arange(3000) + 0.5)
    known = 20.0 * np.cos(omega * t)[:, None] * np.array([1.0, 0.5, -1.0])
    motions, states = follow(of, known, known, np.zeros(3))
    for motion, state, acceleration in zip(motions[1:], states[1:], known, strict=True):
        assert motion.position == pytest.approx(state[0], abs=1e-12)
        assert motion.velocity == pytest.approx(state[1], abs=1e-9)
        assert motion.acceleration == pytest.approx(acceleration, abs=1e-6)


def test_what_the_model_does_not_know_is_late() -> None:
    of = filter_of_three()
    omega = 2.0 * math.pi * 5.0
    t = PERIOD * (np.arange(3000) + 0.5)
    unknown = 20.0 * np.cos(omega * t)[:, None] * np.ones(3)
    motions, _ = follow(of, unknown, np.zeros((3000, 3)), np.zeros(3))
    acceleration = np.array([motion.acceleration for motion in motions[1:]])[1000:]
    fit = np.linalg.lstsq(np.column_stack((np.cos(omega * t), np.sin(omega * t)))[1000:], acceleration, rcond=None)[0]
    late = np.arctan2(fit[1], fit[0]) / omega
    assert np.all(late > PERIOD)
    assert np.all(np.diff(late) > 0.0), "the worse the encoder, the later"


def test_missed_cycles_are_as_repeated_predictions() -> None:
    rng = np.random.default_rng(23)
    one, many = filter_of_three(), filter_of_three()
    for _ in range(50):
        position, u, cycles = rng.standard_normal(3), 50.0 * rng.standard_normal(3), int(rng.integers(1, 6))
        motion, other = one.correct(position), many.correct(position)
        assert motion.position == pytest.approx(other.position, rel=1e-9, abs=1e-9)
        assert motion.velocity == pytest.approx(other.velocity, rel=1e-9, abs=1e-6)
        one.predict(u, cycles)
        for _ in range(cycles):
            many.predict(u)
    assert np.abs(motion.velocity).max() > 1.0


def test_the_first_position_is_at_rest_whatever_was_predicted() -> None:
    of, position = filter_of_three(), np.array([0.5, -0.2, 1.0])
    of.predict(np.full(3, 7.0))
    motion = of.correct(position)
    assert np.array_equal(motion.position, position)
    assert not motion.velocity.any()
    assert not motion.acceleration.any()
    assert not of.innovation.any()


def test_every_joint_is_a_filter_of_its_own() -> None:
    rng = np.random.default_rng(29)
    together, alone = filter_of_three(), [JointKalman(PERIOD, NOISE[[j]], ACCELERATION, DISTURBANCE) for j in range(3)]
    for _ in range(30):
        position, u = 1e-3 * rng.standard_normal(3), rng.standard_normal(3)
        motion = together.correct(position)
        together.predict(u)
        for j, single in enumerate(alone):
            assert single.correct(position[[j]]).velocity == pytest.approx(motion.velocity[[j]], rel=1e-12)
            single.predict(u[[j]])


def test_what_was_returned_and_what_was_given_stay_their_owners() -> None:
    of, other = filter_of_three(), filter_of_three()
    position, u = np.array([0.1, 0.2, 0.3]), np.ones(3)
    motion = of.correct(position)
    kept = dataclasses.astuple(motion)
    of.predict(u)
    other.correct(position.copy())
    other.predict(u.copy())
    position[:], u[:] = 9.0, 9.0
    later, expected = of.correct(np.full(3, 0.25)), other.correct(np.full(3, 0.25))
    assert np.array_equal(later.acceleration, expected.acceleration)
    assert np.array_equal(later.velocity, expected.velocity)
    motion.position[:] = 5.0
    assert np.array_equal(kept[0], [0.1, 0.2, 0.3])
    assert np.array_equal(of.correct(np.full(3, 0.3)).position, other.correct(np.full(3, 0.3)).position)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"period_s": 0.0}, "period"),
        ({"period_s": math.inf}, "period"),
        ({"measurement_noise": np.array([1e-5, 0.0])}, "measurement_noise"),
        ({"measurement_noise": np.array([1e-5, math.nan])}, "measurement_noise"),
        ({"measurement_noise": np.zeros(0)}, "measurement_noise"),
        ({"measurement_noise": np.full((2, 2), 1e-5)}, "measurement_noise"),
        ({"acceleration_noise": -1.0}, "acceleration_noise"),
        ({"acceleration_noise": math.nan}, "acceleration_noise"),
        ({"disturbance_noise": 0.0}, "disturbance_noise"),
        ({"disturbance_noise": math.inf}, "disturbance_noise"),
        ({"disturbance_noise": 1e-9}, "too far apart"),
        ({"disturbance_noise": 1e9}, "too far apart"),
        ({"acceleration_noise": 1e5}, "too far apart"),
        ({"measurement_noise": np.array([1e-5, 1e-300])}, "too far apart"),
    ],
)
def test_a_filter_that_cannot_be_is_refused(change: dict[str, Any], says: str) -> None:
    fits: dict[str, Any] = {
        "period_s": PERIOD,
        "measurement_noise": np.full(2, 1e-5),
        "acceleration_noise": 0.0,
        "disturbance_noise": 1.0,
    }
    JointKalman(**fits)
    with pytest.raises(ConfigurationError, match=says):
        JointKalman(**(fits | change))


@pytest.mark.parametrize(
    "values", [np.zeros(2), np.zeros((1, 3)), np.array([0.0, math.nan, 0.0]), np.full(3, math.inf)]
)
def test_what_does_not_fit_is_refused_and_changes_nothing(values: Array) -> None:
    of, other = filter_of_three(), filter_of_three()
    with pytest.raises(StateError, match="3 finite positions"):
        of.correct(values)
    for each in (of, other):
        each.correct(np.ones(3))
    with pytest.raises(StateError, match="3 finite accelerations"):
        of.predict(values)
    with pytest.raises(StateError, match="over 0"):
        of.predict(np.zeros(3), 0)
    with pytest.raises(StateError, match="3 finite positions"):
        of.correct(values)
    for each in (of, other):
        each.predict(np.ones(3))
    assert np.array_equal(of.correct(np.zeros(3)).velocity, other.correct(np.zeros(3)).velocity)
