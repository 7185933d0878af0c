"""The minimum of the asymmetric penalty (8) of [Del Prete 2016]: by Newton's method, and as the program (9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import osqp
from scipy import sparse

from controller_service.model import Array
from controller_service.motor_samples import Regression

QP_ITERATIONS: Final = 20_000
QP_TOLERANCE: Final = 1e-9
ARMIJO: Final = 1e-4
"""Share of the decrease that the gradient promises, below which a step is halved."""
HALVINGS: Final = 40


@dataclass(frozen=True, slots=True)
class AsymmetricQp:
    """Solution of (9)."""

    gains: Array
    """x (k,)."""
    over: Array
    """y^p (m,) = max(r, 0)."""
    under: Array
    """y^n (m,) = max(−r, 0)."""
    multipliers: Array
    """λ ≥ 0 (4, m) of y^p ≥ r, y^n ≥ −r, y^p ≥ 0, y^n ≥ 0."""
    iterations: int
    solved: bool


@dataclass(frozen=True, slots=True)
class Minimum:
    """What a solver found: `gains` (unknowns,), Σ Φ(r) [rad²] as `cost`."""

    gains: Array
    iterations: int
    cost: float
    gradient_residual: float


def minimise(problem: Regression, weight: float, free: Sequence[int], start: Array, iterations: int) -> Minimum:
    """Newton's method on (8) in the unknowns `free`, the others as in `start`, from the least-squares solution.

    The penalty is quadratic between the hyperplanes r_i = 0: once the set of over-estimated samples is right, a full
    step ends in the minimum, and the iteration ends when that set has stayed or the step is rounding. Steps that do not
    decrease the penalty as the gradient promises are halved, which makes the method converge from anywhere.
    """
    gram = problem.gram()
    chosen = np.array(free)
    square = np.ix_(chosen, chosen)
    gains = start.copy()
    gains[chosen] += np.linalg.solve(gram[square], (gram[:-1, -1] - gram[:-1, :-1] @ start)[chosen])
    sums = problem.penalty(gains, weight, gram)
    done, settled = 0, False
    while done < iterations and not settled:
        done += 1
        step = np.zeros_like(gains)
        step[chosen] = np.linalg.solve(sums.weighted[square], -sums.gradient[chosen])
        slope = 2.0 * float(step @ sums.gradient)
        scale = float(sums.weighted[-1, -1])
        # What the sum of squares may be off by, from the rounding of each error
        rounding = 1e-14 * np.sqrt(sums.cost * scale) + 1e-30 * scale
        share = 1.0
        for _ in range(HALVINGS):
            trial = problem.penalty(gains + share * step, weight, gram)
            if trial.cost <= sums.cost + ARMIJO * share * slope + rounding:
                break
            share *= 0.5
        else:
            break
        settled = share == 1.0 and np.array_equal(trial.over, sums.over)
        settled |= bool((step * step * gram.diagonal()[:-1] <= 1e-28 * gram[-1, -1]).all())
        gains, sums = gains + share * step, trial
    return Minimum(gains, done, sums.cost, sums.residual(chosen))


def solve_qp(problem: Regression, weight: float) -> AsymmetricQp:
    """Solve (9) as it stands, x, y^p and y^n the variables, by OSQP on columns and Δq of unit length.

    Rows keep the order of the samples. Where Δq = 0 the row counts for both signs, so its y^n weighs w as well.
    """
    m, k = len(problem.samples), problem.unknowns
    whole = np.concatenate([block.copy() for _, block in problem.blocks()], axis=1)
    scale = np.sqrt(np.mean(whole * whole, axis=1))
    sign = np.where(whole[-1] < 0.0, -1.0, 1.0)
    A, b = sparse.csc_matrix((whole[:-1] * sign).T / scale[:-1]), whole[-1] * sign / scale[-1]
    one = sparse.identity(m, format="csc")
    P = sparse.diags(np.concatenate([np.zeros(k), np.full(m, 2.0 * weight), np.where(b == 0.0, 2.0 * weight, 2.0)]))
    rows = sparse.bmat([[-A, one, None], [A, None, one], [None, one, None], [None, None, one]], format="csc")
    lower = np.concatenate([-b, b, np.zeros(2 * m)])
    solver = osqp.OSQP(algebra="builtin")
    solver.setup(
        P.tocsc(),
        np.zeros(k + 2 * m),
        rows,
        lower,
        np.full(4 * m, np.inf),
        verbose=False,
        eps_abs=QP_TOLERANCE,
        eps_rel=QP_TOLERANCE,
        max_iter=QP_ITERATIONS,
        adaptive_rho=1,  # on iterations; 2 would be on time
        adaptive_rho_interval=25,
        polishing=True,
    )
    result = solver.solve(raise_error=False)  # failure shows in the gradient
    x = np.array(result.x)
    y = np.array(result.y).reshape(4, m)
    return AsymmetricQp(
        x[:k] * scale[-1] / scale[:-1],
        x[k : k + m] * scale[-1],
        x[k + m :] * scale[-1],
        -y * scale[-1],
        int(result.info.iter),
        str(result.info.status) == "solved",
    )
