"""OSQP and DAQP against the KKT conditions and against each other."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from controller_service.daqp_solver import DaqpSolver
from controller_service.model import Array
from controller_service.osqp_solver import OsqpSolver
from controller_service.qp import QpSolution, residuals
from schemas.errors import ConfigurationError

N, M, TOLERANCE = 9, 18, 1e-6
Problem = tuple[Array, Array, Array, Array, Array]
MAKERS: tuple[Callable[[], Any], ...] = (
    lambda: OsqpSolver(N, M, 1000, TOLERANCE),
    lambda: DaqpSolver(N, M, 1000, TOLERANCE),
)


def problem(rng: np.random.Generator, tightness: float, weight: float = 1000.0) -> Problem:
    """An arm's mass and hand Jacobian drawn at random; bounds around zero, tight where `tightness` is small."""
    B = 0.4 * rng.normal(size=(N, N))
    mass = B @ B.T + np.diag(rng.uniform(1.0, 12.0, N))
    J = 0.7 * rng.normal(size=(6, N))
    P = weight * J.T @ J + (1.0 + 1e-6) * np.eye(N)
    q = -weight * J.T @ rng.normal(scale=5.0, size=6) - rng.normal(scale=10.0, size=N)
    A = np.vstack((np.eye(N), mass))
    width = np.abs(A @ np.linalg.solve(P, q)) * rng.uniform(tightness, tightness + 0.8, M) + 0.1
    return P, q, A, -width, width


def kkt_holds(data: Problem, solution: QpSolution) -> None:
    assert solution.solved, solution
    primal, dual = residuals(*data, solution.x, solution.dual)
    assert max(primal, dual) <= TOLERANCE
    assert (primal, dual) == (solution.primal_residual, solution.dual_residual)


@pytest.mark.parametrize("make", MAKERS, ids=["osqp", "daqp"])
@pytest.mark.parametrize("tightness", [0.6, 0.9, 2.0])
def test_kkt_conditions_hold(make: Callable[[], Any], tightness: float) -> None:
    rng, solver = np.random.default_rng(11), make()
    for _ in range(60):
        data = problem(rng, tightness)
        kkt_holds(data, solver.solve(*data))


@pytest.mark.parametrize("weight", [1.0, 1e3])
def test_solvers_agree(weight: float) -> None:
    rng, osqp, daqp = np.random.default_rng(12), MAKERS[0](), MAKERS[1]()
    for _ in range(60):
        data = problem(rng, 0.6, weight)
        assert np.allclose(osqp.solve(*data).x, daqp.solve(*data).x, atol=1e-5)


def test_osqp_solves_nearly_all_of_unrelated_tight_problems_and_never_claims_a_wrong_one() -> None:
    rng, osqp, daqp = np.random.default_rng(19), MAKERS[0](), MAKERS[1]()
    solved = 0
    for _ in range(200):
        data = problem(rng, 0.2)
        solution, exact = osqp.solve(*data), daqp.solve(*data)
        kkt_holds(data, exact)
        solved += solution.solved
        assert not solution.solved or np.allclose(solution.x, exact.x, atol=1e-4)
    assert solved >= 198


def test_an_osqp_that_runs_out_of_iterations_says_so_and_recovers() -> None:
    rng, solver = np.random.default_rng(13), OsqpSolver(N, M, 5, TOLERANCE)
    statuses = set()
    for _ in range(60):
        data = problem(rng, 0.1)
        solution = solver.solve(*data)
        statuses.add(solution.status)
        assert solution.iterations <= 5
        assert solution.solved == (max(residuals(*data, solution.x, solution.dual)) <= TOLERANCE)
    assert len(statuses) > 1
    free = problem(rng, 2.0)
    kkt_holds(free, solver.solve(*free))


def test_free_problems_cost_no_iteration_and_are_exact() -> None:
    rng, solver = np.random.default_rng(14), MAKERS[0]()
    for _ in range(20):
        data = problem(rng, 1.2)
        solution = solver.solve(*data)
        assert solution.iterations == 0
        kkt_holds(data, solution)
        assert np.allclose(solution.x, np.linalg.solve(data[0], -data[1]))
        assert not solution.dual.any()


@pytest.mark.parametrize("make", MAKERS, ids=["osqp", "daqp"])
def test_contradicting_rows_are_not_solved_and_do_no_harm_to_the_next(make: Callable[[], Any]) -> None:
    rng, solver = np.random.default_rng(15), make()
    P, q, A, lower, upper = problem(rng, 0.5)
    A[N] = A[0]
    lower[0], upper[0], lower[N], upper[N] = 1.0, 2.0, -2.0, -1.0
    solution = solver.solve(P, q, A, lower, upper)
    assert not solution.solved
    data = problem(rng, 0.5)
    kkt_holds(data, solver.solve(*data))


def test_a_minimiser_at_a_bound_passes_smoothly_from_free_to_active() -> None:
    rng, solver = np.random.default_rng(20), MAKERS[0]()
    P, q, A, lower, upper = problem(rng, 1.2)
    minimiser = np.linalg.solve(P, -q)
    edge = A @ minimiser
    row = int(np.argmax(edge[:N]))
    for margin in (1e-3, 1e-6, -1e-6, -1e-3):
        upper[row] = edge[row] + margin
        solution = solver.solve(P, q, A, lower, upper)
        kkt_holds((P, q, A, lower, upper), solution)
        assert (solution.iterations > 0) == (margin < 0.0)
        assert np.abs(solution.x - minimiser).max() <= 1e-5 + 10.0 * max(-margin, 0.0)


def test_infinite_bounds_are_no_bounds() -> None:
    rng = np.random.default_rng(16)
    P, q, A, _, _ = problem(rng, 1.0)
    for make in MAKERS:
        solution = make().solve(P, q, A, np.full(M, -np.inf), np.full(M, np.inf))
        assert np.allclose(solution.x, np.linalg.solve(P, -q))


def test_the_same_problems_give_the_same_bits() -> None:
    def answers() -> list[bytes]:
        rng, solver = np.random.default_rng(17), MAKERS[0]()
        return [solver.solve(*problem(rng, 0.6)).x.tobytes() for _ in range(30)]

    assert answers() == answers()


def test_an_indefinite_hessian_is_refused() -> None:
    P, q, A, lower, upper = problem(np.random.default_rng(18), 1.0)
    assert "positive definite" in MAKERS[0]().solve(-P, q, A, lower, upper).status


def test_daqp_missing_is_one_clear_message(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ConfigurationError, match="pip install"):
        DaqpSolver(N, M, 10, TOLERANCE)
