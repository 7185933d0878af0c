"""(10) to (14) of [Del Prete 2016]: both forms of the law are one, gains there and back, a bounded integral."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest

from controller_service.model import Array
from controller_service.position_torque import (
    Errors,
    Motors,
    OffsetTerms,
    PositionTorqueLaw,
    feedback_gains,
    force_gain_of,
    stiffness_of,
)
from schemas.control_law import PositionTorque

N = 6
LIMIT = np.linspace(50.0, 250.0, N)
PERIOD = 0.001


@dataclass(frozen=True)
class Instant:
    """Everything that the law may know of one instant, drawn at random."""

    mass: Array
    nonlinear: Array
    jacobian: Array
    acceleration: Array
    acceleration_desired: Array
    wrench: Array
    wrench_desired: Array
    position_error: Array
    velocity_error: Array
    velocity: Array

    @property
    def torque(self) -> Array:
        """τ̂ = M q̈̂ + ĥ − Jᵀ f̂."""
        return self.mass @ self.acceleration + self.nonlinear - self.jacobian.T @ self.wrench

    @property
    def reference(self) -> Array:
        """M q̈^d + ĥ − Jᵀ f^d."""
        return self.mass @ self.acceleration_desired + self.nonlinear - self.jacobian.T @ self.wrench_desired

    @property
    def errors(self) -> Errors:
        """Desired less measured."""
        return Errors(
            self.position_error,
            self.velocity_error,
            self.acceleration_desired - self.acceleration,
            self.wrench_desired - self.wrench,
        )


def instant(seed: int) -> Instant:
    draw = np.random.default_rng(seed).standard_normal
    root = draw((N, N))
    return Instant(
        mass=root @ root.T + np.eye(N),
        nonlinear=30.0 * draw(N),
        jacobian=draw((6, N)),
        acceleration=draw(N),
        acceleration_desired=draw(N),
        wrench=50.0 * draw(6),
        wrench_desired=50.0 * draw(6),
        position_error=0.1 * draw(N),
        velocity_error=draw(N),
        velocity=draw(N),
    )


def motors(seed: int = 0, coulomb: bool = True) -> Motors:
    draw = np.random.default_rng([seed, 1]).uniform
    return Motors(draw(4e-5, 2e-4, N), draw(0.01, 0.02, N), draw(1e-4, 1e-3, N) if coulomb else np.zeros(N), 0.1)


def config(**values: Any) -> PositionTorque:
    return PositionTorque.model_validate(values)


def law(seed: int = 0, **values: Any) -> PositionTorqueLaw:
    return PositionTorqueLaw(config(**values), motors(seed), LIMIT)


def offset_of(terms: OffsetTerms) -> Array:
    return terms.of_torque + terms.friction


@pytest.mark.parametrize("seed", range(8))
def test_feedforward_and_feedback_are_the_torque_loop_of_the_inverse_dynamics(seed: int) -> None:
    """(13) + (14) = (10) with (11) and (12), τ̂ being what the same model makes of the estimates."""
    draw = np.random.default_rng([seed, 2]).uniform
    gains = {
        "torque_gain": draw(0, 3),
        "force_gain": draw(0, 2),
        "position_gain": draw(0, 1),
        "velocity_gain": draw(0, 0.05),
    }
    at, own = instant(seed), motors(seed)
    k_p, k_f = gains["torque_gain"], gains["force_gain"]
    stiffness = gains["position_gain"] / (own.torque_gain * (1.0 + k_p))
    damping = gains["velocity_gain"] / (own.torque_gain * (1.0 + k_p))
    wanted = at.wrench_desired + k_f * (at.wrench_desired - at.wrench)  # f*
    desired = at.mass @ at.acceleration_desired + at.nonlinear - at.jacobian.T @ wanted
    desired += stiffness * at.position_error + damping * at.velocity_error
    star = desired + k_p * (desired - at.torque)
    friction = own.velocity_gain * at.velocity + own.coulomb * np.tanh(at.velocity / own.coulomb_velocity)
    expected = own.torque_gain * star + friction

    terms = law(seed, **gains).terms(at.reference, at.velocity, at.errors, at.mass, at.jacobian, k_f, PERIOD)
    assert offset_of(terms) == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert terms.friction == pytest.approx(friction, rel=1e-12)
    assert not terms.integral.any()


@pytest.mark.parametrize("seed", range(3))
def test_the_integral_is_that_of_the_torque_error(seed: int) -> None:
    """K_i ∫ (τ^d − τ̂) over ticks of unequal length, computed without any torque."""
    gains = {"torque_gain": 1.5, "torque_integral": 0.2, "position_gain": 0.3, "velocity_gain": 0.01}
    one, own, total = law(seed, **gains), motors(seed), np.zeros(N)
    for tick, elapsed in enumerate((0.001, 0.003, 0.001, 0.002)):
        at = instant(100 * seed + tick)
        desired = at.reference - at.jacobian.T @ (0.7 * (at.wrench_desired - at.wrench))
        desired += stiffness_of(np.full(N, 0.3), own.torque_gain, np.array(1.5)) * at.position_error
        desired += stiffness_of(np.full(N, 0.01), own.torque_gain, np.array(1.5)) * at.velocity_error
        total += 0.2 * elapsed * (desired - at.torque)
        terms = one.terms(at.reference, at.velocity, at.errors, at.mass, at.jacobian, 0.7, elapsed)
        assert np.abs(total).max() < LIMIT.min()
        assert terms.integral == pytest.approx(own.torque_gain * total, rel=1e-10)
    one.reset()
    at = instant(0)
    terms = one.terms(at.reference, at.velocity, at.errors, at.mass, at.jacobian, 0.7, 0.0)
    assert not terms.integral.any()


def test_the_integral_does_not_wind_up() -> None:
    one, own, zero = law(torque_integral=5.0), motors(), np.zeros(N)
    pull = np.resize([1.0, -1.0], N) * 1000.0
    for _ in range(1000):
        held = one.torque_terms(zero, zero, pull, 0.01).integral
    assert held == pytest.approx(own.torque_gain * np.sign(pull) * LIMIT)
    back = one.torque_terms(zero, zero, -pull, 0.001).integral
    assert np.abs(back) == pytest.approx(own.torque_gain * (LIMIT - 5.0))  # leaves the bound at once


@pytest.mark.parametrize("seed", range(3))
def test_a_torque_from_elsewhere_is_given_by_10_and_11(seed: int) -> None:
    """τ^d of the QP: Δq = K_τ (τ^d + K_p e_τ + K_i ∫e_τ) + K_v q̇ + k_c tanh(q̇/v₀)."""
    draw, own = np.random.default_rng(seed).standard_normal, motors(seed)
    one, total = law(seed, torque_gain=1.2, torque_integral=2.0), np.zeros(N)
    for _ in range(3):
        desired, velocity, error = 40.0 * draw(N), draw(N), 5.0 * draw(N)
        total += 2.0 * PERIOD * error
        terms = one.torque_terms(desired, velocity, error, PERIOD)
        expected = own.torque_gain * (desired + 1.2 * error + total) + own.friction(velocity)
        assert offset_of(terms) == pytest.approx(expected, rel=1e-12, abs=1e-14)
        assert not any(part.any() for part in (terms.position, terms.velocity, terms.force))


def test_a_hand_without_wrench_control_gives_way_as_k_p_says() -> None:
    """K_f = 0, no f^d: an external wrench is then met by K_p alone, as in (11) with τ^d without feedback of forces."""
    at, own = instant(4), motors()
    gains = {"torque_gain": 2.0, "force_gain": 1.0, "position_gain": 0.0}
    errors = Errors(np.zeros(N), np.zeros(N), np.zeros(N), -at.wrench)
    terms = law(0, **gains).terms(at.reference, at.velocity, errors, at.mass, at.jacobian, 0.0, PERIOD)
    assert terms.force == pytest.approx(own.torque_gain * 2.0 * (at.jacobian.T @ at.wrench), rel=1e-12)
    blind = Errors(np.zeros(N), np.zeros(N), np.zeros(N), None)
    assert not law(0, **gains).terms(at.reference, at.velocity, blind, at.mass, at.jacobian, 0.0, PERIOD).force.any()
    assert not law(0, **gains).terms(at.reference, at.velocity, errors, at.mass, None, 0.0, PERIOD).force.any()


def test_a_share_of_the_feedforward_leaves_the_feedback() -> None:
    at, gains = instant(5), {"position_gain": 0.5, "velocity_gain": 0.02}
    arguments = (at.reference, at.velocity, at.errors, at.mass, at.jacobian, 1.0, PERIOD)
    whole, none = law(**gains).terms(*arguments), law(**gains, feedforward=0.0).terms(*arguments)
    for name in (field.name for field in fields(OffsetTerms)):
        if name in ("torque", "friction"):
            assert getattr(whole, name).all()
            assert not getattr(none, name).any()
        else:
            assert np.array_equal(getattr(whole, name), getattr(none, name)), name


@pytest.mark.parametrize("seed", range(4))
def test_gains_there_and_back(seed: int) -> None:
    """K_s, K_d, K_f → K₆, K₇, K₉ → K_s, K_d, K_f at a given K_p, different for every joint and direction."""
    draw, own, at = np.random.default_rng([seed, 3]).uniform, motors(seed), instant(seed)
    k_p, k_s, k_d, k_f = draw(0, 3, N), draw(10, 5000, N), draw(0, 50, N), draw(0, 2, 6)
    gains = feedback_gains(own.torque_gain, k_p, k_s, k_d, k_f, at.mass, at.jacobian)
    assert stiffness_of(gains.position, own.torque_gain, k_p) == pytest.approx(k_s, rel=1e-12)
    assert stiffness_of(gains.velocity, own.torque_gain, k_p) == pytest.approx(k_d, rel=1e-12)
    assert force_gain_of(gains.force, own.torque_gain, k_p, at.jacobian) == pytest.approx(k_f, rel=1e-9)
    tau, k = np.diag(own.torque_gain), np.diag(k_p)
    assert gains.acceleration == pytest.approx(tau @ k @ at.mass, rel=1e-12)
    force = -tau @ (k @ at.jacobian.T @ (np.eye(6) + np.diag(k_f)) + at.jacobian.T @ np.diag(k_f))
    assert gains.force == pytest.approx(force, rel=1e-12, abs=1e-18)


@pytest.mark.parametrize("seed", range(4))
def test_the_law_s_parts_are_the_gains_times_the_errors(seed: int) -> None:
    at, own, k_p, k_f = instant(seed), motors(seed), 1.7, 0.6
    terms = law(seed, torque_gain=k_p, position_gain=0.4, velocity_gain=0.03).terms(
        at.reference, at.velocity, at.errors, at.mass, at.jacobian, k_f, PERIOD
    )
    k_s, k_d = (stiffness_of(np.full(N, gain), own.torque_gain, np.array(k_p)) for gain in (0.4, 0.03))
    gains = feedback_gains(own.torque_gain, np.full(N, k_p), k_s, k_d, np.full(6, k_f), at.mass, at.jacobian)
    errors = at.errors
    assert errors.wrench is not None
    assert terms.position == pytest.approx(gains.position * errors.position, rel=1e-12)
    assert terms.velocity == pytest.approx(gains.velocity * errors.velocity, rel=1e-12)
    assert terms.acceleration == pytest.approx(gains.acceleration @ errors.acceleration, rel=1e-12, abs=1e-15)
    assert terms.force == pytest.approx(gains.force @ errors.wrench, rel=1e-12, abs=1e-15)


def test_force_feedback_that_no_gain_gives_is_met_as_nearly_as_can_be() -> None:
    own, at, k_p = motors(), instant(7), np.full(N, 2.0)
    wanted = np.random.default_rng(8).standard_normal((N, 6)) * 1e-4

    def distance(k_f: Array) -> float:
        given = feedback_gains(own.torque_gain, k_p, np.zeros(N), np.zeros(N), k_f, at.mass, at.jacobian)
        return float(np.linalg.norm(given.force - wanted))

    best = force_gain_of(wanted, own.torque_gain, k_p, at.jacobian)
    for direction in np.eye(6):
        for step in (1e-3, -1e-3):
            assert distance(best) < distance(best + step * direction)


@pytest.mark.parametrize("coulomb", [False, True])
def test_the_motor_s_torque_is_6_solved(coulomb: bool) -> None:
    own, draw = motors(coulomb=coulomb), np.random.default_rng(9).standard_normal
    for _ in range(5):
        torque, velocity = 100.0 * draw(N), 2.0 * draw(N)
        offset = own.torque_gain * torque + own.friction(velocity)
        assert own.torque(offset, velocity) == pytest.approx(torque, rel=1e-12)
        assert own.friction(-velocity) == pytest.approx(-own.friction(velocity))
        held = np.abs(own.friction(velocity)) <= own.velocity_gain * np.abs(velocity) + own.coulomb
        assert held.all()


def test_motors_stand_in_the_order_of_the_joints() -> None:
    models = {
        "knee": {"torque_gain": 1e-4, "velocity_gain": 0.01, "coulomb": 2e-4},
        "hip": {"torque_gain": 5e-5, "velocity_gain": 0.02},
    }
    own = Motors.of(config(motors=models, coulomb_velocity=0.3), ("hip", "knee"))
    assert own.torque_gain.tolist() == [5e-5, 1e-4]
    assert own.velocity_gain.tolist() == [0.02, 0.01]
    assert own.coulomb.tolist() == [0.0, 2e-4]
    assert own.friction(np.array([0.3, 0.3])) == pytest.approx([0.006, 0.003 + 2e-4 * np.tanh(1.0)])
