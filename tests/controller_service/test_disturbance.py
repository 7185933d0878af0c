"""The momentum observer: a first-order filter of the external torques, and of nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest

from controller_service.disturbance import MomentumObserver
from controller_service.errors import StateError
from controller_service.estimation import VelocityEstimator
from controller_service.friction import FrictionModel
from controller_service.model import Array, Configuration, RobotModel
from schemas.control_law import DisturbanceObserver
from schemas.load import Robot
from tests.controller_service.conftest import START, arm_description, arm_urdf

PERIOD = 0.002
BANDWIDTH = 15.0
NO_FRICTION = DisturbanceObserver(bandwidth=BANDWIDTH, coulomb=0.0, viscous=0.0)
FAST = (0.4, 1.3)
"""Amplitude [rad] and frequency [Hz]: over 3 rad/s."""
FORCE = np.array([30.0, -20.0, 15.0])
"""On the hand, world axes [N]."""


@dataclass(frozen=True)
class Sample:
    """At SYNC k: the true state, the motor torque of the interval before, and the low-passed external torque."""

    now: Configuration
    torque: Array
    elapsed_s: float
    external: Array
    """Jᵀ F through the exact first-order filter."""


def fly(
    robot: Robot,
    seconds: float,
    *,
    motion: tuple[float, float] = (0.0, 0.0),
    force: Callable[[float], Array] | None = None,
    friction: Callable[[Array], Array] | None = None,
    cycles: Sequence[int] = (1,),
    substeps: int = 4,
) -> list[Sample]:
    """Integrate the arm by Runge-Kutta while a computed torque, held over each interval, tracks sines in all joints.

    `cycles` are the lengths of the intervals in turn, over which the torque is held.
    """
    rigid = RobotModel(robot, ("hand",))
    amplitude, omega = motion[0], 2.0 * math.pi * motion[1]
    phase = np.linspace(0.0, 2.0, 9)
    q, v, t = START + amplitude * np.sin(phase), amplitude * omega * np.cos(phase), 0.0
    external, torque, last = np.zeros(9), np.zeros(9), 0.0
    samples: list[Sample] = []

    def pushed(now: Configuration) -> Array:
        return np.zeros(9) if force is None else now.frames["hand"].jacobian[:3].T @ force(t)

    def rate(q: Array, v: Array, push: Array) -> Array:
        resisted = 0.0 if friction is None else friction(v)
        return np.asarray(pin.aba(rigid.model, rigid.data, q, v, torque + push - resisted))

    k = 0
    while t < seconds:
        now = rigid.configure(q, v)
        samples.append(Sample(now, torque, last, external.copy()))
        angle = omega * t + phase
        wanted = (
            -amplitude * omega**2 * np.sin(angle)
            + 30.0 * (amplitude * omega * np.cos(angle) - v)
            + 400.0 * (START + amplitude * np.sin(angle) - q)
        )
        torque = now.mass @ wanted + now.nonlinear + (0.0 if friction is None else friction(v))
        last = cycles[k % len(cycles)] * PERIOD
        steps = substeps * cycles[k % len(cycles)]
        h = last / steps
        for _ in range(steps):
            here = rigid.configure(q, v) if force is not None else now
            push = pushed(here)
            pole = math.exp(-BANDWIDTH * h)
            external = pole * external + (1.0 - pole) * push
            a1 = rate(q, v, push)
            a2 = rate(q + 0.5 * h * v, v + 0.5 * h * a1, push)
            a3 = rate(q + 0.5 * h * v + 0.25 * h * h * a1, v + 0.5 * h * a2, push)
            a4 = rate(q + h * v + 0.5 * h * h * a2, v + h * a3, push)
            q = q + h * v + h * h / 6.0 * (a1 + a2 + a3)
            v = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            t += h
        k += 1
    return samples


def observe(of: MomentumObserver, samples: Sequence[Sample]) -> Array:
    """Return r after every sample, (len, n)."""
    of.reset(samples[0].now)
    return np.array([np.zeros(9), *(of.update(s.now, s.torque, s.elapsed_s) for s in samples[1:])])


def scale(samples: Sequence[Sample]) -> float:
    return max(float(np.abs(sample.torque).max()) for sample in samples)


def constant(_: float) -> Array:
    return FORCE


def after(start: float) -> Callable[[float], Array]:
    return lambda t: FORCE if t >= start - 1e-9 else np.zeros(3)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (6.0, -7.0, 3.0)])
def test_fast_motion_and_gravity_alone_give_nothing(gravity: tuple[float, float, float]) -> None:
    robot = Robot(arm_description(gravity_in_world=gravity), arm_urdf())
    samples = fly(robot, 1.5, motion=FAST)
    assert max(np.abs(sample.now.velocity).max() for sample in samples) > 3.0
    r = observe(MomentumObserver(robot.description, NO_FRICTION), samples)
    assert np.abs(r).max() < 1e-3 * scale(samples)


def test_a_push_is_followed_with_the_time_constant_of_the_bandwidth(arm: Robot) -> None:
    start = 0.1
    samples = fly(arm, 0.6, force=after(start))
    r = observe(MomentumObserver(arm.description, NO_FRICTION), samples)
    push = samples[-1].now.frames["hand"].jacobian[:3].T @ FORCE
    share = r @ push / (push @ push)
    k = int(np.argmax(share >= 1.0 - math.exp(-1.0)))
    reached = (k - 1 + (1.0 - math.exp(-1.0) - share[k - 1]) / (share[k] - share[k - 1])) * PERIOD
    assert reached - start == pytest.approx(1.0 / BANDWIDTH, rel=0.02)
    assert np.abs(r[: round(start / PERIOD)]).max() < 1e-6 * scale(samples)


@pytest.mark.parametrize("motion", [(0.0, 0.0), FAST])
def test_a_constant_push_is_estimated_without_bias_at_rest_and_in_fast_motion(
    arm: Robot, motion: tuple[float, float]
) -> None:
    samples = fly(arm, 1.5, motion=motion, force=constant)
    r = observe(MomentumObserver(arm.description, NO_FRICTION), samples)
    expected = np.array([sample.external for sample in samples])
    assert np.abs(expected[-1]).max() > 5.0
    assert np.abs(r - expected).max() < 1e-3 * scale(samples)
    assert np.abs(np.mean(r - expected, axis=0)).max() < 2e-4 * scale(samples)


def test_lost_states_leave_the_estimate_what_it_is(arm: Robot) -> None:
    samples = fly(arm, 1.0, motion=FAST, force=after(0.2), cycles=(1, 3, 1, 1, 2, 5, 1))
    assert len({round(sample.elapsed_s / PERIOD) for sample in samples[1:]}) == 4
    r = observe(MomentumObserver(arm.description, NO_FRICTION), samples)
    error = np.abs(r - np.array([sample.external for sample in samples]))
    assert error.max() < 3e-3 * scale(samples)


def test_a_torque_that_was_not_seen_leaves_an_error_that_decays(arm: Robot) -> None:
    samples = fly(arm, 0.6, motion=FAST)
    lost = 100
    kept = [*samples[:lost], *samples[lost + 1 :]]
    kept[lost] = Sample(kept[lost].now, kept[lost].torque, 2.0 * PERIOD, kept[lost].external)
    r = observe(MomentumObserver(arm.description, NO_FRICTION), kept)
    jump = np.abs(samples[lost].torque - samples[lost + 1].torque)
    pole = math.exp(-BANDWIDTH * 2.0 * PERIOD)
    assert np.all(np.abs(r[lost]) <= (1.0 - pole) * jump + 1e-3 * scale(samples))
    assert np.abs(r[-1]).max() < 1e-3 * scale(samples)


def test_late_velocities_are_allowed_for(arm: Robot) -> None:
    samples = fly(arm, 1.0, motion=FAST, force=after(0.5))
    rigid, estimator = RobotModel(arm), VelocityEstimator(PERIOD, 60.0)
    seen = [
        Sample(
            rigid.configure(s.now.position, estimator.estimate(s.now.position).velocity),
            s.torque,
            s.elapsed_s,
            s.external,
        )
        for s in samples
    ][100:]
    expected = np.array([sample.external for sample in seen])
    late, not_allowed_for = (
        np.abs(observe(MomentumObserver(arm.description, NO_FRICTION, cutoff), seen) - expected)
        for cutoff in (60.0, None)
    )
    before = round(0.5 / PERIOD) - 100
    assert late[:before].max() < 0.35 * not_allowed_for[:before].max()
    assert late[:before].max() < 0.01 * scale(samples)
    push = np.abs(expected).max()
    assert late.max() < 0.01 * scale(samples) + 0.0028 * BANDWIDTH * push


def dry(model: FrictionModel) -> Callable[[Array], Array]:
    """Friction with the model's parameters, its sign resolved over 1 mrad/s."""
    return lambda velocity: model.coulomb * np.tanh(velocity / 1e-3) + model.viscous * velocity


def test_known_friction_in_motion_is_not_taken_for_a_push(arm: Robot) -> None:
    friction = FrictionModel(arm.description, 0.04, 0.0005)
    samples = fly(arm, 1.0, motion=FAST, friction=dry(friction), substeps=16)
    known = MomentumObserver(arm.description, DisturbanceObserver(bandwidth=BANDWIDTH))
    known.reset(samples[0].now)
    numerical = 2e-3 * scale(samples)
    narrow = 0
    for sample in samples[1:]:
        r = known.update(sample.now, sample.torque, sample.elapsed_s)
        assert np.all(np.abs(r - sample.external) <= known.half_width + numerical)
        narrow += int(np.count_nonzero(known.half_width < 0.2 * friction.coulomb))
    assert narrow > 0.6 * 9 * len(samples)
    unknown = observe(MomentumObserver(arm.description, NO_FRICTION), samples)
    assert np.abs(unknown).max() > np.max(friction.coulomb)


def test_at_rest_the_estimate_is_an_interval_as_wide_as_the_friction(arm: Robot) -> None:
    now = RobotModel(arm).configure(START, np.zeros(9))
    of = MomentumObserver(arm.description, DisturbanceObserver(bandwidth=BANDWIDTH))
    friction = FrictionModel(arm.description, 0.04, 0.0005)
    of.reset(now)
    held = 0.7 * friction.coulomb
    for _ in range(500):
        r = of.update(now, now.gravity + held, PERIOD)
    assert r == pytest.approx(-held, rel=1e-5)
    assert of.half_width == pytest.approx(friction.coulomb)
    assert np.all(np.abs(r) < of.half_width), "no push at all lies within the interval"


def test_the_interval_closes_in_motion_and_one_flickering_count_does_not_close_it(arm: Robot) -> None:
    model = RobotModel(arm)
    friction = FrictionModel(arm.description, 0.04, 0.0005)
    count = 2.0 * math.pi / 4096 / np.array([joint.gear_ratio for joint in arm.description.joints])
    for counts_a_cycle, low, high in ((0.5, 0.98, 1.0), (4.0, 0.0, 0.01)):
        now = model.configure(START, counts_a_cycle * count / PERIOD)
        of = MomentumObserver(arm.description, DisturbanceObserver(bandwidth=BANDWIDTH))
        for _ in range(500):
            of.update(now, now.gravity, PERIOD)
        assert np.all(of.half_width >= low * friction.coulomb)
        assert np.all(of.half_width <= high * friction.coulomb)


def test_equal_states_give_equal_estimates_and_a_reset_forgets(arm: Robot) -> None:
    samples = fly(arm, 0.2, motion=FAST, force=constant)
    of = MomentumObserver(arm.description, DisturbanceObserver(), 60.0)
    first = observe(of, samples)
    assert np.abs(first[-1]).max() > 1.0
    assert np.array_equal(first, observe(of, samples))


def test_the_first_state_gives_zero_and_what_was_returned_stays(arm: Robot) -> None:
    model = RobotModel(arm)
    now = model.configure(START, np.zeros(9))
    of = MomentumObserver(arm.description, NO_FRICTION)
    assert not of.update(now, np.full(9, 50.0), PERIOD).any()
    r = of.update(now, now.gravity + 10.0, PERIOD)
    kept = r.copy()
    r += 1e3
    assert of.update(now, now.gravity + 10.0, PERIOD) == pytest.approx(kept * (1.0 + math.exp(-BANDWIDTH * PERIOD)))


@pytest.mark.parametrize(("torques", "elapsed_s"), [(8, PERIOD), (1, PERIOD), (9, 0.0), (9, -PERIOD), (9, math.nan)])
def test_what_does_not_fit_is_refused(arm: Robot, torques: int, elapsed_s: float) -> None:
    now = RobotModel(arm).configure(START, np.zeros(9))
    of = MomentumObserver(arm.description, NO_FRICTION)
    with pytest.raises(StateError, match="9 motor torques over a positive time"):
        of.update(now, np.zeros(torques), elapsed_s)
