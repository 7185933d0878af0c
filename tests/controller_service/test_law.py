"""The law (2)-(4): M ṡ = −(C + K) s, V̇ = −sᵀ K s, and the initialisation of the integral term."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from controller_service.law import IntegralTerm, integral_gain, inverse_dynamics
from controller_service.model import RobotModel
from schemas.load import Robot

LAMBDA = 4.0


def test_on_a_perfect_model_the_storage_function_falls_as_the_theory_says(arm: Robot) -> None:
    model = RobotModel(arm)
    q, v = np.full(9, 0.3), np.linspace(-0.5, 0.5, 9)
    dt, integral = 1e-4, IntegralTerm(9, LAMBDA)
    integral.reset(model.configure(q, v))
    integral.velocity_reference += np.linspace(0.3, -0.2, 9)
    storage, rate = [], []
    for k in range(600):
        now = model.configure(q, v)
        s, extra = integral.terms(now)
        storage.append(0.5 * s @ now.mass @ s)
        rate.append(-LAMBDA * s @ (now.mass.diagonal() * s))
        wanted = np.cos(10 * k * dt) * np.linspace(1.0, -1.0, 9) - 2.0 * v
        u = inverse_dynamics(now, wanted) + extra
        a = pin.aba(model.model, model.data, q, v, u)
        assert np.allclose(now.mass @ (wanted - a), -(now.coriolis + LAMBDA * np.diag(now.mass.diagonal())) @ s)
        integral.advance(wanted, dt)
        q, v = q + dt * v, v + dt * a
    assert np.all(np.diff(storage) < 0.0)
    assert np.allclose(np.gradient(storage, dt)[1:-1], rate[1:-1], rtol=5e-3)


def test_the_integral_term_starts_at_the_torque_it_is_given(arm: Robot) -> None:
    now = RobotModel(arm).configure(np.full(9, 0.2), np.linspace(-1, 1, 9))
    torque = np.linspace(-30.0, 50.0, 9)
    integral = IntegralTerm(9, LAMBDA)
    integral.reset(now, torque)
    assert np.allclose(integral.terms(now)[1], torque)
    integral.reset(now)
    assert not integral.terms(now)[1].any()


def test_without_integral_s_is_zero(arm: Robot) -> None:
    now = RobotModel(arm).configure(np.zeros(9), np.ones(9))
    integral = IntegralTerm(9, LAMBDA, enabled=False)
    integral.reset(now, np.ones(9))
    integral.advance(np.ones(9), 1.0)
    assert not any(term.any() for term in integral.terms(now))


def test_gain_is_coriolis_plus_lambda_times_the_mass_diagonal(arm: Robot) -> None:
    now = RobotModel(arm).configure(np.zeros(9), np.ones(9))
    assert np.allclose(integral_gain(now, 3.0), now.coriolis + 3.0 * np.diag(np.diag(now.mass)))
