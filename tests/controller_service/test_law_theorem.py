"""Theorem 1 of [Benallegue 2021] on a rigid arm integrated beside the law, with and without external torques."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg

from controller_service.law import LawTerms, inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.null_space import invert
from schemas.load import Robot
from tests.controller_service.test_law_null_space import KINDS, LAMBDA, START, Kind, gain_of, law_of, task

DT = 1e-4
PUSH = np.linspace(5.0, -8.0, 9)
EXTERNAL: dict[str, Callable[[float], Array]] = {
    "free": lambda _: np.zeros(9),
    "constant": lambda _: PUSH,
    "varying": lambda t: PUSH * np.sin(30.0 * t + np.arange(9)),
}


@pytest.fixture(scope="module")
def model(arm: Robot) -> RobotModel:
    return RobotModel(arm, ("hand",))


@dataclass
class Record:
    """A run of the closed loop, one row a step."""

    a: Array
    rate: Array
    """−M⁻¹ ((C + G) a + τ_ext), what (23) says of ȧ."""
    storage: Array
    storage_rate: Array
    """−aᵀG a − aᵀτ_ext."""
    slowest: Array
    """Smallest eigenvalue of G against M."""
    task: Array
    """J a."""
    integral: Array
    """∫ J ṡ dt from the plant's accelerations, J s at the start."""


def close_loop(model: RobotModel, kind: Kind, share: float, external: Callable[[float], Array], steps: int) -> Record:
    """Law and rigid arm by Heun's method; s, e and ∫J ṡ are integrated here once more, by the trapezoidal rule."""

    def wanted(t: float, velocity: Array) -> Array:
        return np.asarray(np.cos(10.0 * t) * np.linspace(1.0, -1.0, 9) - 2.0 * velocity)

    def accelerate(at: Configuration, t: float, terms: LawTerms) -> Array:
        u = inverse_dynamics(at, wanted(t, at.velocity)) + terms.integral + external(t)
        return np.asarray(pin.aba(model.model, data, at.position, at.velocity, u))

    data, law = model.model.createData(), law_of(kind, share=share)
    now = model.configure(START, np.linspace(-0.5, 0.5, 9))
    law.reset(now)
    law.terms(now, task(now), DT)
    law.velocity_reference = law.velocity_reference + np.linspace(0.3, -0.2, 9)
    terms = law.terms(now, task(now), 0.0)
    assert terms.null_space_share == 1.0
    rows: list[tuple[Any, ...]] = []
    e, gained, before = np.zeros(6), task(now).jacobian @ (law.velocity_reference - now.velocity), None
    for k in range(steps):
        t, T = k * DT, task(now)
        s, a_r, acceleration = law.velocity_reference - now.velocity, wanted(t, now.velocity), accelerate(now, t, terms)
        rates = T.rate @ s, T.jacobian @ (a_r - acceleration)
        if before is not None:
            e, gained = e + 0.5 * DT * (before[0] + rates[0]), gained + 0.5 * DT * (before[1] + rates[1])
        before = rates
        found = invert(now, T, kind)
        assert found is not None
        a, G, x = s - found.inverse @ e, gain_of(now, kind, share), external(t)
        rate = -np.linalg.solve(now.mass, (now.coriolis + G) @ a + x)
        slowest = scipy.linalg.eigh(G, now.mass, eigvals_only=True)[0]
        rows.append((a, rate, 0.5 * a @ now.mass @ a, -a @ G @ a - a @ x, slowest, T.jacobian @ a, gained))
        ahead = model.configure(
            now.position + DT * now.velocity + 0.5 * DT**2 * acceleration, now.velocity + DT * acceleration
        )
        trial = copy.deepcopy(law)
        trial.integrate(0.5 * (a_r + wanted(t + DT, ahead.velocity)), DT)
        second = accelerate(ahead, t + DT, trial.terms(ahead, task(ahead), DT))
        now = model.configure(
            now.position + DT * now.velocity + DT**2 / 6.0 * (2.0 * acceleration + second),
            now.velocity + 0.5 * DT * (acceleration + second),
        )
        law.integrate(0.5 * (a_r + wanted(t + DT, now.velocity)), DT)
        terms = law.terms(now, task(now), DT)
    return Record(*(np.array(column) for column in zip(*rows, strict=True)))


def agree(found: Array, expected: Array, tolerance: float = 1e-5) -> bool:
    return bool(np.abs(found - expected).max() <= tolerance * np.abs(expected).max())


@pytest.mark.parametrize("external", EXTERNAL)
@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_theorem_1(model: RobotModel, kind: Kind, share: float, external: str) -> None:
    """(23) with an external torque: M ȧ = −(C + G) a − τ_ext, V̇ = −aᵀG a − aᵀτ_ext, G of (26) in the place of K.

    Closed with (1), M q̈ = u + τ_ext − h, (21) leaves M (q̈ᵃ − q̈) = −(C + G) a − τ_ext. G > 0 for μ > 0; for μ = 0 it is
    positive semidefinite, and V falls as long as J a is not zero.
    """
    found = close_loop(model, kind, share, EXTERNAL[external], 400)
    assert agree(np.gradient(found.a, DT, axis=0)[1:-1], found.rate[1:-1])
    assert agree(np.gradient(found.storage, DT)[1:-1], found.storage_rate[1:-1])
    assert agree(found.task, found.integral)  # (25)
    assert (found.slowest > -1e-9).all()
    if external == "free":
        assert (np.diff(found.storage) < 0.0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_falls_exponentially_and_the_task_s_error_integral_with_it(model: RobotModel, kind: Kind) -> None:
    """V ≤ V(0) e^(−2ct), c the smallest eigenvalue of G against M: half of λ here for μ = ½, where diag M is near M."""
    found = close_loop(model, kind, 0.5, EXTERNAL["free"], 3000)
    rate = float(found.slowest.min())
    assert rate > 0.4 * LAMBDA
    times = DT * np.arange(3000)
    assert (found.storage <= found.storage[0] * np.exp(-2.0 * rate * times) * (1.0 + 1e-6)).all()
    assert np.linalg.norm(found.task[-1]) < math.exp(-0.4 * LAMBDA * 0.3) * np.linalg.norm(found.task[0])
    stiff = close_loop(model, kind, 0.0, EXTERNAL["free"], 3000)
    assert np.linalg.norm(stiff.task[-1]) < math.exp(-0.4 * LAMBDA * 0.3) * np.linalg.norm(stiff.task[0])
