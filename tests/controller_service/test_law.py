"""The law (2)-(4) with leak (12)-(14) and the limit of u_K: M ṡ = −(C + K) s, V̇ = −sᵀ K s, and where it starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from controller_service.law import IntegralLaw, LawTerms, LeakyState, integral_gain, inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from schemas.controller import ControllerConfig
from schemas.load import Robot

LAMBDA = 4.0
PERIOD = 0.002
LIMITS = np.linspace(250.0, 80.0, 9)
LEAK = {"slow_rate": 0.3, "fast_rate": 80.0, "fast_share": 0.4}
UNLIMITED = {"method": "none"}
SHARE = 0.1
"""`torque_share` of the schema."""

LawOf = Callable[..., IntegralLaw]


@pytest.fixture(scope="module")
def law_of() -> LawOf:
    """law_of(**configuration), λ = `LAMBDA`."""

    def build(**changes: Any) -> IntegralLaw:
        data = {"lambda": LAMBDA, "phases": [{"name": "x", "mode": "torque", "duration_s": 1.0}]} | changes
        return IntegralLaw(9, ControllerConfig.model_validate(data), LIMITS)

    return build


@pytest.fixture(scope="module")
def rest(arm: Robot) -> Configuration:
    return RobotModel(arm).configure(np.full(9, 0.2), np.zeros(9))


@pytest.fixture(scope="module")
def moving(arm: Robot) -> Configuration:
    return RobotModel(arm).configure(np.full(9, 0.2), np.linspace(-1, 1, 9))


def pull(law: IntegralLaw, now: Configuration, acceleration: Array, ticks: int) -> list[LawTerms]:
    """Ticks at a configuration that does not follow."""
    found = []
    for _ in range(ticks):
        law.integrate(acceleration, PERIOD)
        found.append(law.terms(now, None, PERIOD))
    return found


def test_on_a_perfect_model_the_storage_function_falls_as_the_theory_says(arm: Robot, law_of: LawOf) -> None:
    model = RobotModel(arm)
    q, v = np.full(9, 0.3), np.linspace(-0.5, 0.5, 9)
    dt, law = 1e-4, law_of(anti_windup=UNLIMITED)
    law.reset(model.configure(q, v))
    law.velocity_reference = law.velocity_reference + np.linspace(0.3, -0.2, 9)
    storage, rate = [], []
    for k in range(600):
        now = model.configure(q, v)
        terms = law.terms(now, None, dt if k else 0.0)
        s = terms.velocity_error
        storage.append(0.5 * s @ now.mass @ s)
        rate.append(-LAMBDA * s @ (now.mass.diagonal() * s))
        wanted = np.cos(10 * k * dt) * np.linspace(1.0, -1.0, 9) - 2.0 * v
        u = inverse_dynamics(now, wanted) + terms.integral
        a = pin.aba(model.model, model.data, q, v, u)
        assert np.allclose(now.mass @ (wanted - a), -(now.coriolis + LAMBDA * np.diag(now.mass.diagonal())) @ s)
        law.integrate(wanted, dt)
        q, v = q + dt * v, v + dt * a
    assert np.all(np.diff(storage) < 0.0)
    assert np.allclose(np.gradient(storage, dt)[1:-1], rate[1:-1], rtol=5e-3)


@pytest.mark.parametrize("leak", [None, LEAK, LEAK | {"fast_share": 0.0}, LEAK | {"fast_share": 0.9}])
def test_the_law_starts_at_the_torque_it_is_given(
    law_of: LawOf, moving: Configuration, leak: dict[str, float] | None
) -> None:
    torque = np.linspace(-90.0, 120.0, 9)
    law = law_of(leak=leak)
    law.reset(moving, torque)
    assert np.allclose(law.terms(moving, None, 0.0).integral, torque)
    law.reset(moving)
    terms = law.terms(moving, None, 0.0)
    assert not terms.integral.any()
    assert not terms.velocity_error.any()
    assert np.array_equal(terms.bound, SHARE * LIMITS)


def test_without_integral_all_terms_are_zero(law_of: LawOf, moving: Configuration) -> None:
    law = law_of(integral="none", leak=LEAK, null_space={})
    law.reset(moving, np.ones(9))
    law.integrate(np.ones(9), 1.0)
    terms = law.terms(moving, None, 1.0)
    for value in (terms.velocity_error, terms.inertial, terms.windup, terms.limited, terms.integral):
        assert not value.any()


def test_gain_is_coriolis_plus_lambda_times_the_mass_diagonal(law_of: LawOf, moving: Configuration) -> None:
    expected = moving.coriolis + 3.0 * np.diag(np.diag(moving.mass))
    assert np.allclose(integral_gain(moving, 3.0), expected)
    law = law_of(**{"lambda": 3.0, "anti_windup": UNLIMITED})
    law.reset(moving)
    (terms,) = pull(law, moving, np.linspace(20.0, -30.0, 9), 1)
    assert np.allclose(terms.velocity_error, PERIOD * np.linspace(20.0, -30.0, 9))
    assert np.allclose(terms.integral, expected @ terms.velocity_error)
    assert np.allclose(terms.inertial, moving.coriolis @ terms.velocity_error)


def test_a_leaky_state_is_the_sum_of_its_faded_increments() -> None:
    """(13) at any division of time: s_k = Σ_i e^(−θ (t_k − t_i)) Δ_i, here written out."""
    rng, rate = np.random.default_rng(61), 7.0
    state, time, past = LeakyState(3, rate), 0.0, []
    state.start(np.array([1.0, -2.0, 0.0]))
    past.append((0.0, state.error))
    for _ in range(60):
        increment, elapsed = rng.normal(size=3), rng.uniform(0.0, 0.05)
        time += elapsed
        past.append((time, increment))
        state.advance(increment, None, elapsed)
        expected = sum(math.exp(-rate * (time - then)) * one for then, one in past)
        assert np.allclose(state.error, expected, rtol=1e-12, atol=1e-14)
        assert state.drift is None


def test_a_steady_ramp_ends_at_its_slope_over_the_rate_and_a_pure_integrator_never() -> None:
    """Σ r T e^(−θ k T) = r T/(1 − e^(−θT)): r/θ for a short T."""
    leaky, pure = LeakyState(1, 5.0), LeakyState(1, 0.0)
    for _ in range(4000):
        for state in (leaky, pure):
            state.advance(np.array([3.0 * PERIOD]), None, PERIOD)
    assert leaky.error[0] == pytest.approx(3.0 * PERIOD / (1.0 - math.exp(-5.0 * PERIOD)), rel=1e-12)
    assert leaky.error[0] == pytest.approx(3.0 / 5.0, rel=0.51 * 5.0 * PERIOD)
    assert pure.error[0] == pytest.approx(3.0 * 8.0)


def test_the_mixed_error_takes_the_place_of_s(law_of: LawOf, moving: Configuration) -> None:
    """(14) from sums of its own: C s̃ and K s̃ with s̃ = μ s^θf + (1 − μ) s^θs; the trace still tells s."""
    rng, torque = np.random.default_rng(62), np.linspace(30.0, -20.0, 9)
    law = law_of(leak=LEAK, anti_windup=UNLIMITED)
    law.reset(moving, torque)
    law.terms(moving, None, 0.0)
    mu, gain = LEAK["fast_share"], LAMBDA * moving.mass.diagonal()
    start = np.linalg.solve(integral_gain(moving, LAMBDA), torque) / (1.0 - mu)
    total, slow, fast = start, start, np.zeros(9)
    for _ in range(50):
        acceleration, elapsed = rng.normal(scale=20.0, size=9), PERIOD * int(rng.integers(1, 4))
        law.integrate(acceleration, elapsed)
        terms = law.terms(moving, None, elapsed)
        step = elapsed * acceleration
        total = total + step
        slow = math.exp(-LEAK["slow_rate"] * elapsed) * slow + step
        fast = math.exp(-LEAK["fast_rate"] * elapsed) * fast + step
        mixed = mu * fast + (1.0 - mu) * slow
        assert np.allclose(terms.velocity_error, total)
        assert np.allclose(terms.inertial, moving.coriolis @ mixed)
        assert np.allclose(terms.windup, gain * mixed)
        assert np.array_equal(terms.limited, terms.windup)
        assert terms.null_space_share == 0.0


def test_the_torque_at_the_start_is_forgotten_at_the_slow_rate_alone(law_of: LawOf, rest: Configuration) -> None:
    torque = np.linspace(9.0, -7.0, 9)
    law = law_of(leak=LEAK)
    law.reset(rest, torque)
    law.terms(rest, None, 0.0)
    last = pull(law, rest, np.zeros(9), 250)[-1]
    assert np.allclose(last.integral, math.exp(-LEAK["slow_rate"] * 250 * PERIOD) * torque, rtol=1e-9)
    assert np.allclose(last.velocity_error, law.velocity_reference)


@pytest.mark.parametrize("leak", [None, LEAK])
def test_the_bound_starts_where_the_torque_needs_it_and_falls(
    law_of: LawOf, rest: Configuration, leak: dict[str, float] | None
) -> None:
    torque = np.concatenate((np.full(4, 60.0), np.full(5, -2.0)))
    law = law_of(leak=leak, anti_windup={"torque_share": SHARE, "decay_s": 0.4})
    law.reset(rest, torque)
    first = law.terms(rest, None, 0.0)
    final = SHARE * LIMITS
    assert np.allclose(first.bound, np.maximum(final, np.abs(torque)))
    assert np.allclose(first.limited, torque)
    later = pull(law, rest, np.zeros(9), 100)[-1]
    excess = np.maximum(np.abs(torque) - final, 0.0) * math.exp(-100 * PERIOD / 0.4)
    assert np.allclose(later.bound, final + excess)
    assert (np.abs(later.limited) <= later.bound).all()
    if leak is None:
        assert np.allclose(later.windup, torque)
        assert np.allclose(later.limited[:4], later.bound[:4])
        assert np.array_equal(later.limited[4:], later.windup[4:])


@pytest.mark.parametrize("leak", [None, LEAK | {"slow_rate": 0.0, "fast_rate": 0.0}])
def test_back_calculation_leads_the_slow_state_to_where_the_torque_is_at_its_bound(
    law_of: LawOf, rest: Configuration, leak: dict[str, float] | None
) -> None:
    """Without a further error u_K − ũ_K falls by 1 − κT a tick, whatever the share of the slow state."""
    kappa = 50.0
    law = law_of(leak=leak, anti_windup={"back_calculation": kappa})
    law.reset(rest)
    law.terms(rest, None, 0.0)
    pull(law, rest, np.full(9, 300.0), 100)
    over = [terms.windup - terms.limited for terms in pull(law, rest, np.zeros(9), 250)]
    assert (over[0] > 1.0).all()
    for before, after in itertools.pairwise(over[:20]):
        assert np.allclose(after, (1.0 - kappa * PERIOD) * before, rtol=1e-6)
    assert np.allclose(over[-1], 0.0, atol=1e-6)


def test_with_back_calculation_the_torque_leaves_its_limit_as_soon_as_the_error_turns_round(
    law_of: LawOf, rest: Configuration
) -> None:
    def ticks_at_the_limit(kappa: float) -> int:
        law = law_of(anti_windup={"back_calculation": kappa})
        law.reset(rest)
        law.terms(rest, None, 0.0)
        push = np.full(9, 200.0)
        wound = pull(law, rest, push, 300)[-1]
        assert np.allclose(wound.limited, SHARE * LIMITS)
        back = pull(law, rest, -push, 600)
        return next(k for k, terms in enumerate(back) if (terms.limited < terms.bound).all())

    # The other way the error needs as long as it was beyond the bound; κ = 1/T keeps no memory of it
    assert ticks_at_the_limit(0.0) > 100
    assert ticks_at_the_limit(100.0) < 6
    assert ticks_at_the_limit(1.0 / PERIOD) == 0


def test_the_state_of_the_law_is_not_changed_in_place(law_of: LawOf, rest: Configuration) -> None:
    """What a tick told stays as it was."""
    law = law_of(leak=LEAK, anti_windup={"back_calculation": 100.0})
    law.reset(rest, np.full(9, 50.0))
    told = pull(law, rest, np.full(9, 100.0), 3)
    kept = [(t.velocity_error.copy(), t.windup.copy(), t.limited.copy(), t.bound.copy()) for t in told]
    pull(law, rest, np.full(9, -300.0), 20)
    for terms, copies in zip(told, kept, strict=True):
        values = (terms.velocity_error, terms.windup, terms.limited, terms.bound)
        assert all(np.array_equal(value, copy) for value, copy in zip(values, copies, strict=True))
