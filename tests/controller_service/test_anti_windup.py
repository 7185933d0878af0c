"""(10) and (11): box, half-space, optimality by the KKT conditions, agreement of two solvers; the bound in time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest

from controller_service.anti_windup import (
    EPSILON,
    SMALLEST,
    AntiWindupError,
    AntiWindupLimit,
    OsqpProjection,
    Projection,
    project,
    scale,
    scaling_factor,
)
from controller_service.daqp_solver import DaqpSolver
from controller_service.model import Array
from schemas.control_law import AntiWindup
from schemas.errors import ConfigurationError

SIZES = (1, 2, 9, 38)
Case = tuple[Array, Array, Array]
"""u, s, b."""


def source(rng: np.random.Generator, kind: int, n: int) -> Case:
    """Where u comes from: K s with diagonal or full K, another vector, (26)'s gain, small integers (ties)."""
    s, b = rng.normal(size=n), rng.uniform(2.0, 20.0, n)
    if kind == 0:
        return s * rng.uniform(1.0, 40.0, n), s, b
    if kind == 1:
        B = rng.normal(size=(n, n))
        return (8.0 / math.sqrt(n) * B @ B.T + np.eye(n)) @ s, s, b
    if kind == 2:
        return rng.choice([3.0, 15.0, 100.0]) * rng.normal(size=n), s, b
    if kind == 3:
        J = rng.normal(size=(max(1, n // 2), n))
        N = np.linalg.pinv(J) @ J
        return N.T @ (rng.uniform(1.0, 60.0, n) * (N @ s)), 0.5 * N @ s + 0.5 * rng.normal(size=n), b
    u, s, b = (rng.integers(low, high, n).astype(float) for low, high in ((-6, 7), (-2, 3), (0, 4)))
    return u, s, b


@cache
def cases(n: int) -> tuple[Case, ...]:
    """Each source with: nothing more; zeros in s; a wide and a small s; bounds of 0; u in its box; all joints over."""
    rng, found = np.random.default_rng((31, n)), []
    for _ in range(75):
        for kind in range(5):
            for twist in range(7):
                u, s, b = source(rng, kind, n)
                if twist == 1:
                    s = s * (rng.random(n) < 0.6)
                elif twist == 2:
                    s = s * 10.0 ** rng.uniform(-3.0, 0.0, n)
                elif twist == 3:
                    s = s * 10.0 ** rng.uniform(-12.0, 9.0)
                elif twist == 4:
                    b = b * (rng.random(n) < 0.8)
                elif twist == 5:
                    u = scale(u, b)
                elif twist == 6:
                    u = np.where(u < 0.0, -1.0, 1.0) * (np.abs(u) + b)
                found.append((u, s, b))
    assert len(found) * len(SIZES) >= 10_000
    return tuple(found)


def everything() -> Iterator[Case]:
    for n in SIZES:
        yield from cases(n)


def rounding(u: Array, s: Array, b: Array) -> float:
    """What n products and sums of torques up to |u| + b may lose."""
    return 4.0 * len(u) * EPSILON * float(np.abs(s) @ (np.abs(u) + b))


def clip(u: Array, b: Array) -> Array:
    return np.clip(u, -b, b)


def active(u: Array, s: Array, b: Array) -> bool:
    """Clipping alone violates the half-space, beyond rounding."""
    return bool(s @ clip(u, b) < scaling_factor(u, b) * (s @ u) - rounding(u, s, b))


def multiplier(u: Array, s: Array, b: Array, x: Array) -> float:
    """ν that x tells of: by the joint inside the box with the largest s, else the least that holds all."""
    inside = (np.abs(x) < b) & (s != 0.0)
    if inside.any():
        i = int(np.argmax(np.where(inside, np.abs(s), 0.0)))
        return float((x[i] - u[i]) / s[i])
    held = (x == np.copysign(b, s)) & (x != clip(u, b)) & (s != 0.0)
    return float(((x - u)[held] / s[held]).max(initial=0.0))


def test_the_cases_hold_what_they_are_meant_to() -> None:
    for n in SIZES[1:]:
        counted = [active(*case) for case in cases(n)]
        assert 0.1 < np.mean(counted) < 0.9
    drawn = list(everything())
    over = [int(np.count_nonzero(np.abs(u) > b)) for u, _, b in drawn]
    assert min(over.count(0), over.count(1), sum(k == len(c[0]) for k, c in zip(over, drawn, strict=True))) > 500
    assert sum(not s.any() for _, s, _ in drawn) > 50
    assert sum(bool(u @ s < 0.0) for u, s, _ in drawn) > 1000
    assert sum(bool(((b == 0.0) & (u != 0.0)).any()) for u, _, b in drawn) > 500


def test_the_factor_is_the_largest_that_fits() -> None:
    for u, _, b in everything():
        factor = scaling_factor(u, b)
        assert 0.0 <= factor <= 1.0
        assert (np.abs(factor * u) <= b * (1.0 + 2.0 * EPSILON)).all()
        assert (np.abs(scale(u, b)) <= b).all()
        if factor < 1.0:
            assert (np.abs((1.0 + 1e-9) * factor * u) > b).any() or (b[u != 0.0] == 0.0).any()
        else:
            assert (np.abs(u) <= b).all()
    with np.errstate(all="raise"):
        assert scaling_factor(np.array([0.0, 0.0]), np.array([0.0, 1.0])) == 1.0
        assert scaling_factor(np.array([0.0, -4.0]), np.array([0.0, 1.0])) == 0.25
        assert scaling_factor(np.array([1e-300, 1.0]), np.array([0.0, 1.0])) == 0.0


def test_the_solution_is_in_the_box_and_in_the_half_space_and_no_further_away_than_the_scaled_torque() -> None:
    with np.errstate(all="raise", under="ignore"):
        for u, s, b in everything():
            x, scaled = project(u, s, b), scale(u, b)
            assert (np.abs(x) <= b).all()
            assert s @ x >= scaling_factor(u, b) * (s @ u) - rounding(u, s, b)
            assert np.linalg.norm(x - u) <= np.linalg.norm(scaled - u) * (1.0 + 1e-12) + 1e-12


def test_kkt_conditions_hold() -> None:
    """x = clip(u + ν s), ν ≥ 0, and ν = 0 or sᵀx = λ_w sᵀu: sufficient, since (11) is convex."""
    for u, s, b in everything():
        x = project(u, s, b)
        if not active(u, s, b):
            slack = s @ clip(u, b) - scaling_factor(u, b) * (s @ u)
            assert np.array_equal(x, clip(u, b)) or slack <= rounding(u, s, b)
            if np.array_equal(x, clip(u, b)):
                continue
        nu = multiplier(u, s, b, x)
        assert nu >= 0.0
        assert np.allclose(x, clip(u + nu * s, b), rtol=0.0, atol=1e-9 * (np.abs(u) + b).max())
        assert abs(s @ x - scaling_factor(u, b) * (s @ u)) <= rounding(u, s, b)


def with_active_half_space(n: int, count: int) -> Iterator[Case]:
    rng = np.random.default_rng((36, n))
    while count:
        u, s, b = source(rng, int(rng.integers(1, 5)), n)
        if active(u, s, b):
            count -= 1
            yield u, s, b


def test_dual_and_osqp_agree() -> None:
    """Within 1e-6 of the largest bound, on 10 000 cases with an active half-space: only there OSQP is asked."""
    for n, count in ((2, 5000), (9, 5000), (38, 200)):
        osqp = OsqpProjection(n)
        for u, s, b in with_active_half_space(n, count):
            x = project(u, s, b)
            assert not np.array_equal(x, clip(u, b))
            assert np.abs(osqp(u, s, b) - x).max() <= 1e-6 * b.max()


def test_dual_and_osqp_agree_on_all_other_cases_too() -> None:
    for n in SIZES:
        osqp = OsqpProjection(n)
        for u, s, b in cases(n):
            assert np.abs(osqp(u, s, b) - project(u, s, b)).max() <= 1e-6 * b.max()


def test_dual_and_an_active_set_solver_of_the_problem_as_it_stands_agree() -> None:
    """DAQP gets (11) as it is written, rows [I; sᵀ], torques over the largest bound, s at unit length."""
    for n in SIZES[1:3]:
        daqp, identity = DaqpSolver(n, n + 1, 500, 1e-6), np.eye(n)
        for u, s, b in (*cases(n), *with_active_half_space(n, 500)):
            if not s.any() or not b.any():
                continue
            unit, row = b.max(), s / np.linalg.norm(s)
            lower = np.append(-b, scaling_factor(u, b) * (row @ u)) / unit
            upper = np.append(b / unit, np.inf)
            solution = daqp.solve(identity, -u / unit, np.vstack((identity, row)), lower, upper)
            assert np.abs(solution.x * unit - project(u, s, b)).max() <= 1e-6 * unit


def test_a_diagonal_gain_never_activates_the_half_space_and_keeps_signs_and_passivity() -> None:
    """(3) with K = λ diag(M): not even by rounding, so x is the clipped torque, bit for bit."""
    rng = np.random.default_rng(32)
    for k in range(10_000):
        n = SIZES[k % 4]
        s = rng.normal(size=n) * 10.0 ** rng.uniform(-6.0, 3.0, n)
        u = s * rng.uniform(0.1, 40.0, n) * 10.0 ** rng.uniform(0.0, 4.0)
        b = rng.uniform(0.1, 20.0, n)
        x = project(u, s, b)
        assert np.array_equal(x, clip(u, b))
        assert x @ s > 0.0
        assert (x * u > 0.0).all()
        assert (np.abs(x) <= np.abs(u)).all()


def test_a_full_gain_keeps_passivity_where_clipping_loses_it() -> None:
    rng = np.random.default_rng(33)
    lost = 0
    for _ in range(5000):
        u, s, b = source(rng, 1, 9)
        b *= rng.uniform(0.01, 1.0, 9)
        assert u @ s > 0.0
        lost += bool(clip(u, b) @ s <= 0.0)
        assert project(u, s, b) @ s > 0.0
    assert lost > 20


def test_a_full_gain_may_turn_a_component_round() -> None:
    """The counterexample of `project`: sᵀu > 0, so a K > 0 with u = K s exists; ν = 0.15 takes x_1 through 0."""
    u, s, b = np.array([10.0, 0.1, 4.0]), np.array([1.0, -1.0, -0.1]), np.ones(3)
    K = np.outer(u, u) / (s @ u) + np.eye(3) - np.outer(s, s) / (s @ s)
    assert np.allclose(K @ s, u)
    assert np.linalg.eigvalsh(K).min() > 0.0
    assert np.allclose(project(u, s, b), [1.0, -0.05, 1.0])


def test_joints_within_their_bound_are_left_alone_unless_the_half_space_needs_them() -> None:
    rng = np.random.default_rng(34)
    for _ in range(300):
        u, s, b = source(rng, 0, 9)
        free = np.abs(u) <= b
        assert np.array_equal(project(u, s, b)[free], u[free])
    u, s, b = np.array([4.0, 0.5]), np.array([1.0, -1.0]), np.ones(2)
    assert np.allclose(scale(u, b), [1.0, 0.125])
    assert np.allclose(project(u, s, b), [1.0, 0.125])
    assert np.array_equal(project(u, -s, b), [1.0, 0.5])


def test_two_joints_as_in_figure_2() -> None:
    """λ_w = ½, clip(u) = (1, −1), sᵀclip(u) = 1 < λ_w sᵀu = 1.5: ν = ½ takes x_1 from u_1 = −1 to −½."""
    x = project(np.array([2.0, -1.0]), np.array([2.0, 1.0]), np.ones(2))
    assert np.allclose(x, [1.0, -0.5], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("solve", [project, OsqpProjection(3)], ids=["dual", "osqp"])
def test_degenerate_cases(solve: Projection) -> None:
    u, s, b = np.array([4.0, -0.5, 3.0]), np.array([1.0, 2.0, -1.0]), np.array([1.0, 1.0, 2.0])
    zero = np.zeros(3)
    with np.errstate(all="raise"):
        assert np.array_equal(solve(u, zero, b), clip(u, b))
        assert np.array_equal(solve(u, s, zero), zero)
        assert np.array_equal(solve(zero, s, b), zero)
        assert np.array_equal(solve(b, s, b), b)
        assert np.array_equal(solve(100.0 * u, s * [1.0, -1.0, -1.0], b), clip(100.0 * u, b))
        inside = 0.1 * u
        assert np.array_equal(solve(inside, s, b), inside)
        assert solve(inside, s, b) is not inside
        # b_0 = 0 leaves λ_w = 0: sᵀx ≥ 0, met with the joints that are left
        x = solve(u, s, np.array([0.0, 1.0, 2.0]))
        assert x[0] == 0.0
        assert np.allclose(s @ x, 0.0, atol=1e-7)
        # sᵀu < 0: the bound is on the negative work, here met by clipping less of the third
        x = solve(np.array([-4.0, 0.1, 3.0]), np.array([1.0, 0.0, -1.0]), b)
        assert np.allclose(x, [-1.0, 0.1, 0.75], atol=1e-6)


def test_all_joints_at_their_bounds_is_the_last_way_out() -> None:
    """The target is max g: only the corner along s meets it, wherever clipping stands; by rounding it may be beyond."""
    rng = np.random.default_rng(35)
    for _ in range(2000):
        s = rng.normal(size=9)
        b = rng.uniform(0.1, 20.0, 9)
        u = np.copysign(b, s) * rng.uniform(1.0, 50.0)
        x = project(u, s, b)
        assert (np.abs(x) <= b).all()
        assert np.abs(s) @ b - s @ x <= rounding(u, s, b)


def test_the_length_of_s_counts_for_nothing() -> None:
    for u, s, b in cases(9)[:500]:
        assert np.array_equal(project(u, s, b), project(u, 2.0**40 * s, b))
        assert np.array_equal(project(u, s, b), project(u, 2.0**-40 * s, b))


def test_tiny_components_of_s_do_no_harm() -> None:
    u, s, b = np.array([2.0, -1.0, 0.5]), np.array([2.0, 1.0, 1e-20]), np.ones(3)
    with np.errstate(all="raise", under="ignore"):
        assert np.allclose(project(u, s, b), [1.0, -0.5, 0.5])
        s[2] = 0.1 * SMALLEST
        assert np.allclose(project(u, s, b), [1.0, -0.5, 0.5])
        assert np.array_equal(project(u, SMALLEST * 1e-100 * s, b), clip(u, b))
        # What is lacking (2.5e-21) is rounding of what the others give
        u, s = np.array([2.0, 2.0, 0.5]), np.array([1.0, 1.0, -1e-20])
        assert np.array_equal(project(u, s, b), clip(u, b))


def test_nothing_is_changed_in_place() -> None:
    for u, s, b in cases(9)[:200]:
        kept = u.copy(), s.copy(), b.copy()
        project(u, s, b)
        OsqpProjection(9)(u, s, b)
        assert all(np.array_equal(before, now) for before, now in zip(kept, (u, s, b), strict=True))


def test_an_osqp_without_iterations_says_what_to_do() -> None:
    def answer() -> None:
        for case in with_active_half_space(9, 200):
            OsqpProjection(9, iterations=1)(*case)

    with pytest.raises(AntiWindupError, match=r"after 1 iterations .*solver to dual") as caught:
        answer()
    u, b = caught.value.torque, caught.value.bound
    assert u.shape == b.shape == (9,)
    assert (np.abs(u) > b).any()


LIMITS = np.array([100.0, 50.0, 10.0])
TORQUE, DIRECTION = np.array([40.0, -3.0, 0.2]), np.array([1.0, 0.5, 1.0])


def test_each_method_limits_as_it_says() -> None:
    bound = 0.1 * LIMITS
    for method, expected in (
        ("qp", project(TORQUE, DIRECTION, bound)),
        ("scaling", 0.25 * TORQUE),
        ("none", TORQUE),
    ):
        limit = AntiWindupLimit(LIMITS, AntiWindup.model_validate({"method": method}))
        assert np.array_equal(limit.bound, bound)
        found = limit.limit(TORQUE, DIRECTION)
        assert np.array_equal(found, expected)
        assert found is not TORQUE
    osqp = AntiWindupLimit(LIMITS, AntiWindup(solver="osqp", torque_share=0.1))
    assert np.allclose(osqp.limit(TORQUE, DIRECTION), project(TORQUE, DIRECTION, bound), atol=1e-6)
    assert isinstance(osqp._solve, OsqpProjection)


def test_the_bound_starts_at_the_torque_of_the_change_and_falls_exactly() -> None:
    limit = AntiWindupLimit(LIMITS, AntiWindup(torque_share=0.2, decay_s=0.5))
    final = 0.2 * LIMITS
    limit.start(np.array([-60.0, 4.0, 2.0]))
    first = limit.bound
    assert np.array_equal(first, [60.0, 10.0, 2.0])
    assert np.array_equal(limit.limit(np.array([-60.0, 4.0, 2.0]), np.ones(3)), [-60.0, 4.0, 2.0])
    for _ in range(250):
        limit.advance(0.002)
    assert np.array_equal(first, [60.0, 10.0, 2.0])
    assert np.allclose(limit.bound, final + np.array([40.0 * math.exp(-1.0), 0.0, 0.0]), rtol=1e-13)
    once = AntiWindupLimit(LIMITS, AntiWindup(torque_share=0.2, decay_s=0.5))
    once.start(np.array([-60.0, 4.0, 2.0]))
    once.advance(0.0)
    assert np.array_equal(once.bound, first)
    once.advance(0.5)
    assert np.allclose(limit.bound, once.bound, rtol=1e-13)
    previous = limit.bound
    for _ in range(12_000):
        limit.advance(0.002)
        assert (limit.bound <= previous).all()
        previous = limit.bound
    assert np.array_equal(limit.bound, final)
    limit.start(np.array([25.0, 0.0, -3.0]))
    assert np.array_equal(limit.bound, [25.0, 10.0, 3.0])


def test_without_a_start_time_changes_nothing() -> None:
    limit = AntiWindupLimit(LIMITS, AntiWindup())
    limit.advance(1.0)
    assert np.array_equal(limit.bound, 0.1 * LIMITS)


@pytest.mark.parametrize("torque", [np.array([1.0, np.nan, 0.0]), np.array([1.0, np.inf, 0.0]), np.zeros(2)])
def test_a_start_without_a_torque_is_refused_and_changes_nothing(torque: Array) -> None:
    limit = AntiWindupLimit(LIMITS, AntiWindup())
    with pytest.raises(AntiWindupError, match="change of mode"):
        limit.start(torque)
    assert np.array_equal(limit.bound, 0.1 * LIMITS)


@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf])
def test_torque_limits_that_are_none_are_refused(wrong: float) -> None:
    with pytest.raises(ConfigurationError, match=r"joint 1 is .*N·m"):
        AntiWindupLimit(np.array([1.0, wrong]), AntiWindup())


def test_the_same_torques_give_the_same_bits() -> None:
    def answers() -> list[bytes]:
        osqp = OsqpProjection(9)
        return [solve(*case).tobytes() for case in cases(9)[:200] for solve in (project, osqp)]

    assert answers() == answers()
