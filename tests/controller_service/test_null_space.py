"""Generalized inverses: J J⁺ = I, symmetry in their metric, dJ⁺/dt by differences, torques without task force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest
import scipy.linalg

from controller_service.model import Array, Configuration, RobotModel
from controller_service.null_space import TaskInverse, TaskJacobian, invert, smallest_singular_value
from schemas.load import Robot

Kind = Literal["pseudo", "dynamic"]
KINDS: tuple[Kind, ...] = ("pseudo", "dynamic")
ROWS = (slice(0, 6), slice(0, 3), slice(3, 6))
STEP = 1e-6

At = Callable[[Array, Array], Configuration]


@pytest.fixture(scope="module")
def at(arm: Robot) -> At:
    return RobotModel(arm, ("hand",)).configure


def states(count: int) -> list[tuple[Array, Array]]:
    rng = np.random.default_rng(71)
    return [(rng.uniform(-1.5, 1.5, 9), rng.normal(size=9)) for _ in range(count)]


def task(now: Configuration, rows: slice = ROWS[0]) -> TaskJacobian:
    hand = now.frames["hand"]
    return TaskJacobian(hand.jacobian[rows], hand.jacobian_rate[rows])


def inverse_of(now: Configuration, kind: Kind, rows: slice = ROWS[0]) -> TaskInverse:
    found = invert(now, task(now, rows), kind)
    assert found is not None
    return found


@pytest.mark.parametrize("rows", ROWS, ids=["pose", "position", "orientation"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_right_inverse_whose_projection_is_symmetric_in_its_metric(at: At, kind: Kind, rows: slice) -> None:
    """W⁻¹ J⁺J is symmetric: of all q̇ with J q̇ = z, J⁺z is the shortest in the metric W⁻¹."""
    for q, v in states(10):
        now = at(q, v)
        found = inverse_of(now, kind, rows)
        J, plus = found.task.jacobian, found.inverse
        metric = np.eye(9) if kind == "pseudo" else now.mass
        assert plus.shape == (9, len(J))
        assert np.allclose(J @ plus, np.eye(len(J)), atol=1e-10)
        assert np.allclose(metric @ plus @ J, (metric @ plus @ J).T, atol=1e-9)
        assert np.allclose(plus @ J @ plus, plus, atol=1e-9)
        assert np.allclose(found.task_mass, np.linalg.inv(J @ np.linalg.inv(metric) @ J.T), rtol=1e-8)
        if kind == "pseudo":
            assert np.allclose(plus, np.linalg.pinv(J), atol=1e-9)


@pytest.mark.parametrize("rows", ROWS, ids=["pose", "position", "orientation"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_rate_agrees_with_finite_differences(at: At, kind: Kind, rows: slice) -> None:
    rng = np.random.default_rng(72)
    for q, v in states(10):
        after, before = (inverse_of(at(q + sign * STEP * v, v), kind, rows).inverse for sign in (1, -1))
        rate = (after - before) / (2 * STEP)
        found = inverse_of(at(q, v), kind, rows)
        for z in (*np.eye(rate.shape[1]), rng.normal(size=rate.shape[1])):
            assert np.allclose(found.rate_times(z), rate @ z, rtol=1e-5, atol=1e-5 * np.abs(rate).max())
        # J J⁺ = I at all times: J̇ J⁺ + J dJ⁺/dt = 0
        z = rng.normal(size=rate.shape[1])
        assert np.allclose(found.task.jacobian @ found.rate_times(z), -found.task.rate @ found.inverse @ z, atol=1e-9)


def test_the_two_inverses_and_their_rates_differ(at: At) -> None:
    now = at(*states(1)[0])
    one, other = (inverse_of(now, kind) for kind in KINDS)
    z = np.ones(6)
    assert np.abs(one.inverse - other.inverse).max() > 0.1
    assert np.abs(one.rate_times(z) - other.rate_times(z)).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_torques_without_a_task_force_move_the_task_unless_the_inverse_is_dynamically_consistent(
    at: At, kind: Kind
) -> None:
    """τ with J⁺ᵀτ = 0 gives the task the acceleration J M⁻¹τ: 0 for the dynamically consistent inverse alone.

    Conversely M q̈ of a motion q̈ = J⁺z then has no power on null-space motions: zᵀM J⁺ = 0 for J z = 0.
    """
    moved, worked = [], []
    for q, v in states(10):
        now = at(q, v)
        found = inverse_of(now, kind)
        torques = scipy.linalg.null_space(found.inverse.T)
        motions = scipy.linalg.null_space(found.task.jacobian)
        assert torques.shape == motions.shape == (9, 3)
        moved.append(np.abs(found.task.jacobian @ np.linalg.solve(now.mass, torques)).max())
        worked.append(np.abs(motions.T @ now.mass @ found.inverse).max())
    if kind == "dynamic":
        assert max(moved) < 1e-12
        assert max(worked) < 1e-10
    else:
        assert min(moved) > 1e-3
        assert min(worked) > 1e-2


@pytest.mark.parametrize("kind", KINDS)
def test_a_task_without_full_rank_has_no_inverse(at: At, kind: Kind) -> None:
    now = at(*states(1)[0])
    J = task(now).jacobian.copy()
    J[4] = 0.0
    assert invert(now, TaskJacobian(J, np.zeros((6, 9))), kind) is None
    assert smallest_singular_value(J) == 0.0


def test_a_mass_matrix_that_is_not_positive_definite_has_no_dynamic_inverse(at: At) -> None:
    now = at(*states(1)[0])
    wrong = Configuration(now.position, now.velocity, -now.mass, now.coriolis, now.nonlinear, now.frames)
    assert invert(wrong, task(now), "dynamic") is None
    assert invert(wrong, task(now), "pseudo") is not None


def test_the_smallest_singular_value_is_that_of_the_decomposition(at: At) -> None:
    for q, v in states(10):
        for rows in ROWS:
            J = task(at(q, v), rows).jacobian
            assert smallest_singular_value(J) == pytest.approx(np.linalg.svd(J, compute_uv=False)[-1], rel=1e-6)
