"""The quadratic program (5) over q̈, and what a solver of it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from controller_service.model import Array
from controller_service.tasks import Task

SOLVED = "solved"


@dataclass(frozen=True, slots=True)
class QpSolution:
    """What a solver found, with residuals measured on the problem as given (`residuals`), not the solver's own."""

    x: Array
    dual: Array
    """y (m,): P x + q + Aᵀ y = 0, y > 0 at an upper bound, y < 0 at a lower one."""
    iterations: int
    status: str
    """`solved`, or the solver's word for why not."""
    primal_residual: float
    dual_residual: float

    @property
    def solved(self) -> bool:
        """Both residuals are within the solver's tolerance."""
        return self.status == SOLVED


class Solver(Protocol):
    """Solves min ½ xᵀ P x + qᵀ x subject to l ≤ A x ≤ u, P (n, n) positive definite, A (m, n), n and m fixed.

    Bounds may be infinite. An implementation keeps one workspace, bounds its iterations, reads no clock, and returns
    the same solution for the same sequence of problems.
    """

    def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
        """Solve; failure is a status, never an exception."""
        ...


def residuals(P: Array, q: Array, A: Array, lower: Array, upper: Array, x: Array, dual: Array) -> tuple[float, float]:
    """Relative KKT residuals, both 0 at the optimum.

    primal: largest violation of l ≤ A x ≤ u, over 1 + |A x| of the row.
    dual: largest of |P x + q + Aᵀ y| over its terms' scale 1 + max(|q|, |P x|), and of the products y⁺ (u − A x),
    y⁻ (A x − l) (complementarity), over 1 + (|q| + |P x|)·|x|.
    """
    Ax = A.dot(x)
    excess = np.maximum(lower - Ax, Ax - upper)
    primal = float((np.maximum(excess, 0.0) / (1.0 + np.abs(Ax))).max()) if excess.max() > 0.0 else 0.0
    Px = P.dot(x)
    if not dual.any():
        return primal, stationarity(Px + q, Px, q)
    stationary = stationarity(Px + q + dual.dot(A), Px, q)
    active = dual != 0.0
    bound = np.where(dual > 0.0, upper, lower)[active]
    products = np.abs(dual[active] * (bound - Ax[active])).max() / (1.0 + (np.abs(q) + np.abs(Px)) @ np.abs(x))
    return primal, max(stationary, float(products))


def stationarity(gradient: Array, Px: Array, q: Array) -> float:
    """Return the largest |∇ₓL| (n,) over its terms' scale 1 + max(|q|, |P x|)."""
    scale = max(np.maximum.reduce(np.abs(q)), np.maximum.reduce(np.abs(Px)))
    return float(np.maximum.reduce(np.abs(gradient)) / (1.0 + scale))


def objective(tasks: Sequence[Task], n: int, regularization: float) -> tuple[Array, Array]:
    """P (n, n) and q (n,) of (5): ½ Σ w_t ‖A_t x − b_t‖² + ½ γ ‖x‖² = ½ xᵀ P x + qᵀ x + const.

    P = Σ w_t A_tᵀ A_t + γ I, q = −Σ w_t A_tᵀ b_t. A task's weight multiplies its squared norm: 𝒲 of (5) is √w_t.
    """
    P = np.zeros((n, n))
    P.flat[:: n + 1] = regularization
    q = np.zeros(n)
    for task in tasks:
        task.add_to(P, q)
    return P, q
