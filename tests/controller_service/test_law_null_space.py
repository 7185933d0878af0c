"""The null-space compliant law (16)-(26): the range of (26), J a with leak, fading in and out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
import scipy.linalg

from controller_service.law import IntegralLaw, LeakyState, integral_gain
from controller_service.model import Array, Configuration, RobotModel
from controller_service.null_space import TaskJacobian, invert
from schemas.controller import ControllerConfig
from schemas.load import Robot

LAMBDA = 20.0
PERIOD = 0.002
LIMITS = np.linspace(250.0, 80.0, 9)
START = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
PUSH = np.linspace(5.0, -8.0, 9)
AT_ONCE = 1e-12
"""A `fade_s` that has passed after any step."""

Kind = Literal["pseudo", "dynamic"]
KINDS: tuple[Kind, ...] = ("pseudo", "dynamic")


def law_of(inverse: Kind = "dynamic", fade_s: float = AT_ONCE, share: float = 0.0, **changes: Any) -> IntegralLaw:
    data = {
        "lambda": LAMBDA,
        "anti_windup": {"method": "none"},
        "leak": {"slow_rate": 0.0, "fast_rate": 0.0, "fast_share": share},
        "null_space": {"inverse": inverse, "fade_s": fade_s},
        "phases": [{"name": "x", "mode": "torque", "duration_s": 1.0}],
    }
    return IntegralLaw(9, ControllerConfig.model_validate(data | changes), LIMITS)


def task(now: Configuration) -> TaskJacobian:
    hand = now.frames["hand"]
    return TaskJacobian(hand.jacobian, hand.jacobian_rate)


def gain_of(now: Configuration, kind: Kind, share: float) -> Array:
    """Return (26) as a matrix on a, with both rates alike."""
    found = invert(now, task(now), kind)
    assert found is not None
    projection, K = found.inverse @ found.task.jacobian, LAMBDA * np.diag(now.mass.diagonal())
    return np.asarray((1.0 - share) * projection.T @ K @ projection + share * K)


@pytest.fixture(scope="module")
def model(arm: Robot) -> RobotModel:
    return RobotModel(arm, ("hand",))


def along(model: RobotModel, count: int, moving: bool = True) -> list[Configuration]:
    """Configurations of a path with a Jacobian that changes by some per mille a tick, the last one standing still."""
    speed = np.linspace(1.2, -0.8, 9)
    path = [model.configure(START + k * PERIOD * speed, speed if moving else np.zeros(9)) for k in range(count - 1)]
    return [*path, model.configure(path[-1].position, np.zeros(9))]


def feed(law: IntegralLaw, path: list[Configuration], tasks: Callable[[Configuration], TaskJacobian | None]) -> None:
    rng = np.random.default_rng(75)
    law.reset(path[0], PUSH)
    law.terms(path[0], None, 0.0)
    for now in path:
        law.integrate(rng.normal(scale=15.0, size=9), PERIOD)
        law.terms(now, tasks(now), PERIOD)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_the_gain_of_26(model: RobotModel, kind: Kind, share: float) -> None:
    """The slow memory's torque is Jᵀ f: no power on z with J z = 0. With a fast share the gain is positive definite."""
    now = model.configure(START, np.linspace(-0.5, 0.5, 9))
    T, law = task(now), law_of(kind, share=share)
    slow, both = np.empty((9, 9)), np.empty((9, 9))
    for i, unit in enumerate(np.eye(9)):
        law.reset(now, (1.0 - share) * integral_gain(now, LAMBDA) @ unit)  # s₀ = unit, in the slow state alone
        slow[:, i] = law.terms(now, T, PERIOD).windup
        law.reset(now)
        law.velocity_reference = law.velocity_reference + unit
        both[:, i] = law.terms(now, T, PERIOD).windup
    motions = scipy.linalg.null_space(T.jacobian)
    assert np.abs(motions.T @ slow).max() < 1e-10 * np.abs(slow).max()
    assert np.linalg.matrix_rank(slow, tol=1e-8 * np.abs(slow).max()) == 6
    assert np.allclose(slow, slow.T)
    assert np.linalg.eigvalsh(slow).min() > -1e-10 * np.abs(slow).max()
    assert np.allclose(both, gain_of(now, kind, share))
    if share > 0.0:
        assert np.linalg.eigvalsh(both).min() > 0.1 * share * LAMBDA * now.mass.diagonal().min()


def test_the_place_of_s_in_11_is_taken_by_the_error_whose_storage_is_to_fall(
    model: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """s̃ for (3), ã for (26), of which V̇ = −ãᵀũ_K: negative also where the limit acts (μ = 0, any null-space memory)."""
    share, seen = 0.0, []
    law = law_of(share=share, anti_windup={"method": "qp", "torque_share": 0.02})
    limit = law._limit.limit

    def spy(torque: Array, direction: Array) -> Array:
        seen.append(direction)
        return limit(torque, direction)

    monkeypatch.setattr(law._limit, "limit", spy)
    rng, now = np.random.default_rng(76), model.configure(START, np.zeros(9))
    found = invert(now, task(now), "dynamic")
    assert found is not None
    null = np.eye(9) - found.inverse @ found.task.jacobian
    for _ in range(100):
        offset = rng.normal(size=9)
        offset += 20.0 * null @ rng.normal(size=9)
        for T, expected in ((None, offset), (task(now), offset)):
            law.reset(now)
            law.velocity_reference = law.velocity_reference + offset
            terms = law.terms(now, T, PERIOD)
            assert np.allclose(seen[-1], expected)
            assert (np.abs(terms.limited) <= terms.bound).all()
            assert (np.abs(terms.windup) > terms.bound).any()
            assert expected @ terms.limited > 0.0


def test_j_a_is_the_leaky_sum_of_the_task_s_error_increments_exactly() -> None:
    """J_k s_k^θ − e_k^θ = Σ e^(−θ(t_k − t_i)) ½ (J_i + J_{i−1})(s_i − s_{i−1}), whatever J does and how time passes."""
    rng, rate = np.random.default_rng(77), 12.0
    J, state = rng.normal(size=(6, 9)), LeakyState(9, rate)
    state.start(rng.normal(size=9))
    state.drift = np.zeros(6)
    expected = J @ state.error
    for _ in range(200):
        change, increment, elapsed = 0.3 * rng.normal(size=(6, 9)), rng.normal(size=9), rng.uniform(0.0, 0.02)
        state.advance(increment, change, elapsed)
        expected = math.exp(-rate * elapsed) * expected + (J + 0.5 * change) @ increment
        J = J + change
        assert np.allclose(J @ state.error - state.drift, expected, rtol=0.0, atol=1e-12 * np.abs(J).max())
    # A tick without a Jacobian before it moves the error alone
    drift = state.drift
    state.advance(rng.normal(size=9), None, 0.0)
    assert np.array_equal(state.drift, drift)


@pytest.mark.parametrize("kind", KINDS)
def test_the_faded_law_is_between_the_two(model: RobotModel, kind: Kind) -> None:
    """(1 − σ)·(3) + σ·(21), all terms, with the same memory."""
    path, leak = along(model, 60), {"slow_rate": 0.3, "fast_rate": 80.0, "fast_share": 0.4}
    laws = [law_of(kind, fade_s, leak=leak) for fade_s in (1e15, 0.3, AT_ONCE)]
    for law in laws:
        law._forget_rate = 0.0
        feed(law, path, task)
    now = model.configure(path[-1].position, np.linspace(0.4, -0.6, 9))
    none, some, whole = (law.terms(now, task(now), PERIOD) for law in laws)
    share = 61 * PERIOD / 0.3
    assert (none.null_space_share, whole.null_space_share) == (pytest.approx(0.0, abs=1e-12), 1.0)
    assert some.null_space_share == pytest.approx(share)
    for name in ("inertial", "windup"):
        one, between, other = (getattr(terms, name) for terms in (none, some, whole))
        assert np.allclose(between, (1.0 - share) * one + share * other)
        assert np.abs(one - other).max() > 0.5
    bare = law_of(kind, leak=leak)
    feed(bare, path, lambda _: None)
    assert np.allclose(bare.terms(now, None, PERIOD).integral, none.integral)


def test_the_slow_memory_forgets_the_null_space_and_keeps_the_task(model: RobotModel) -> None:
    """(I − J⁺J) s^θs falls by e^(−θ_f t) once σ = 1; J s^θs knows of θ_s alone."""
    leak = {"slow_rate": 0.5, "fast_rate": 40.0, "fast_share": 0.3}
    law, now = law_of("dynamic", AT_ONCE, leak=leak), model.configure(START, np.zeros(9))
    found = invert(now, task(now), "dynamic")
    assert found is not None
    law.reset(now, np.linspace(20.0, -30.0, 9))
    before = law._slow.error
    for _ in range(50):
        law.terms(now, task(now), PERIOD)
    J, time = found.task.jacobian, 50 * PERIOD
    assert np.allclose(J @ law._slow.error, math.exp(-0.5 * time) * (J @ before))
    null = np.eye(9) - found.inverse @ J
    assert np.allclose(null @ law._slow.error, math.exp(-40.5 * time) * (null @ before))


def test_sigma_grows_evenly_from_no_step_at_all(model: RobotModel) -> None:
    path = along(model, 2, moving=False)
    law, bare = law_of(fade_s=0.5, share=0.4), law_of(fade_s=0.5, share=0.4)
    for one in (law, bare):
        feed(one, path, lambda _: None)
    now = path[-1]
    first, without = law.terms(now, task(now), PERIOD), bare.terms(now, None, PERIOD)
    assert np.abs(without.integral).max() > 5.0
    assert np.abs(first.integral - without.integral).max() < 2.0 * PERIOD / 0.5 * np.abs(without.integral).max()
    shares = [law.terms(now, task(now), PERIOD).null_space_share for _ in range(300)]
    assert np.allclose(shares[:249], PERIOD / 0.5 * np.arange(2, 251))
    assert shares[-1] == 1.0


def flat(now: Configuration) -> TaskJacobian:
    """Make a task that is nearly singular: its smallest singular value is below the schema's 0.03."""
    T = task(now)
    u, sizes, v = np.linalg.svd(T.jacobian, full_matrices=False)
    sizes[-1] = 0.02
    return TaskJacobian((u * sizes) @ v, T.rate)


@pytest.mark.parametrize("lost", [lambda _: None, flat], ids=["no task", "singular"])
@pytest.mark.parametrize(
    "limit", [{"method": "none"}, {"method": "qp", "torque_share": 0.02, "decay_s": 1e-3}], ids=["free", "limited"]
)
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_torque_goes_on_where_the_task_is_lost(
    model: RobotModel, share: float, limit: dict[str, Any], lost: Callable[[Configuration], TaskJacobian | None]
) -> None:
    """ũ_K of (21) becomes u_K of (3); at rest that is all of the torque. After it σ begins at 0 again."""
    path = along(model, 60)
    law = law_of(share=share, anti_windup=limit)
    feed(law, path, task)
    now = path[-1]
    before = law.terms(now, task(now), PERIOD)
    after = law.terms(now, lost(now), PERIOD)
    assert before.null_space_share == 1.0
    assert np.abs(before.limited).max() > 1.0
    assert (before.windup.tolist() == before.limited.tolist()) == (limit["method"] == "none")
    assert np.allclose(after.windup, before.limited, rtol=1e-12, atol=1e-10)
    assert np.allclose(after.integral, before.integral, rtol=1e-9, atol=1e-9)
    assert after.null_space_share == 0.0
    step = law.velocity_reference + 0.1
    law.velocity_reference = step
    again = law.terms(now, None, PERIOD)
    assert np.allclose(again.windup - after.windup, 0.1 * LAMBDA * now.mass.diagonal())


def test_the_law_without_null_space_takes_no_notice_of_a_task(model: RobotModel) -> None:
    path = along(model, 30)
    with_task, without = (law_of(null_space=None) for _ in range(2))
    feed(with_task, path, task)
    feed(without, path, lambda _: None)
    now = path[-1]
    one, other = with_task.terms(now, task(now), PERIOD), without.terms(now, None, PERIOD)
    assert np.array_equal(one.integral, other.integral)
    assert one.null_space_share == 0.0


def test_a_law_started_anew_remembers_no_task(model: RobotModel) -> None:
    path = along(model, 40)
    used, fresh = law_of(share=0.4), law_of(share=0.4)
    feed(used, path, task)
    for law in (used, fresh):
        feed(law, path, task)
    one, other = (law.terms(path[-1], task(path[-1]), PERIOD) for law in (used, fresh))
    assert np.array_equal(one.integral, other.integral)


@pytest.mark.parametrize("leak", [None, {"slow_rate": 0.1, "fast_rate": 100.0, "fast_share": 0.3}])
def test_back_calculation_leads_the_compliant_torque_to_its_bound_too(
    model: RobotModel, leak: dict[str, float] | None
) -> None:
    """With (26)'s full gain −K⁻¹ (u_K − ũ_K) is not the straight way, but it leads there."""
    now, push = model.configure(START, np.zeros(9)), np.linspace(8.0, -6.0, 9)

    def beyond(kappa: float) -> tuple[float, int]:
        """Excess at rest, and ticks at a limit once the error turns round."""
        law = law_of(leak=leak, anti_windup={"torque_share": 0.05, "back_calculation": kappa})
        law.reset(now)

        def tick(acceleration: Array) -> float:
            law.integrate(acceleration, PERIOD)
            terms = law.terms(now, task(now), PERIOD)
            return float(np.abs(terms.windup - terms.limited).max())

        for _ in range(100):
            tick(push)
        excess = [tick(np.zeros(9)) for _ in range(400)][-1]
        return excess, next(k for k in range(1000) if tick(-push) == 0.0)

    (wound, late), (led, at_once) = beyond(0.0), beyond(20.0)
    assert wound > 10.0
    assert led < 0.1
    assert late > 50
    assert at_once < 5
