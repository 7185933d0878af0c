"""OSQP behind the `Solver` protocol: one workspace, fixed dense sparsity, nothing that depends on time."""

from __future__ import annotations

import numpy as np
import osqp.ext_builtin as osqp
from scipy import sparse
from scipy.linalg import lapack

from controller_service.model import Array
from controller_service.qp import SOLVED, QpSolution, residuals, stationarity

CHECK_EVERY = 5
"""Iterations between tests of termination."""
RHO_EVERY = 25
"""Iterations between adaptations of ρ."""
ACCURACIES = (1e-2, 1e-4, 1e-6, 1e-8)
"""OSQP's own tolerances, one after the other until the polished point is within ours; mostly the first is enough."""
INFINITY = 1e30
"""OSQP's."""
POLISHING_PASSES = 20
"""Corrections of the active set that the polishing may make."""
BLOCK_PASSES = 5
"""As many of these change all rows that disagree, the rest one row each."""


class OsqpSolver:
    """OSQP on the scaled problem (unit rows of A, cost over its largest curvature), polished.

    Where the unconstrained minimiser is feasible it is the solution (all multipliers are 0), and OSQP is not asked: 0
    iterations. Else OSQP starts from the last solution and finds which rows are active; the equations of just these
    rows then give the point to rounding, so ratios of weights of 1000 : 1 and γ of 1e-6 do no harm. (OSQP's own
    polishing is off: it writes to the standard output where no row is active.)

    Args:
        n: variables.
        m: rows.
        iterations: upper bound, over all `ACCURACIES`.
        tolerance: of `residuals`; the status is `solved` only within it.

    """

    def __init__(self, n: int, m: int, iterations: int, tolerance: float) -> None:
        self._iterations = iterations
        self._tolerance = tolerance
        self._last = np.zeros(n)
        self._dual = np.zeros(m)
        columns, rows = np.tril_indices(n)
        self._upper_triangle = (rows, columns)
        """Of P, column by column: the order of OSQP's data."""
        settings = osqp.OSQPSettings()
        osqp.osqp_set_default_settings(settings)
        settings.verbose = 0
        settings.scaling = 0
        settings.rho = 1.0
        settings.adaptive_rho = 1  # on iterations; 2 would be on time
        settings.adaptive_rho_interval = RHO_EVERY
        settings.adaptive_rho_tolerance = 2.0
        settings.check_termination = CHECK_EVERY
        settings.check_dualgap = 0
        settings.polishing = 0
        settings.max_iter = iterations
        settings.eps_abs = settings.eps_rel = ACCURACIES[0]
        self._settings = settings
        # The binding itself: its Python wrapper costs some 40 µs a solve
        self._workspace = osqp.OSQPSolver(
            osqp.CSC(sparse.csc_matrix(np.triu(np.ones((n, n))))),
            np.zeros(n),
            osqp.CSC(sparse.csc_matrix(np.ones((m, n)))),
            -np.ones(m),
            np.ones(m),
            m,
            n,
            settings,
        )

    def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
        """Solve; see `Solver`."""
        factor, minimiser, fault = lapack.dposv(P, -q, lower=1)
        if fault != 0:
            return QpSolution(np.zeros_like(q), np.zeros_like(lower), 0, "P is not positive definite", np.inf, np.inf)
        reached = A.dot(minimiser)
        if np.logical_and.reduce((lower <= reached) & (reached <= upper)):
            self._last, self._dual = minimiser, np.zeros(len(lower))
            Px = P.dot(minimiser)
            error = stationarity(Px + q, Px, q)
            if error <= self._tolerance:
                return QpSolution(minimiser, self._dual, 0, SOLVED, 0.0, error)
        length = np.sqrt(np.einsum("ij,ij->i", A, A))
        cost = 1.0 / P.diagonal().max()
        self._workspace.update_data_vec(
            q=cost * q, l=np.maximum(lower / length, -INFINITY), u=np.minimum(upper / length, INFINITY)
        )
        self._workspace.update_data_mat(
            P_x=cost * P[self._upper_triangle], P_i=None, A_x=(A / length[:, None]).ravel(order="F"), A_i=None
        )
        self._workspace.warm_start(self._last, self._dual * (length * cost))
        solution = self._refine(P, q, A, lower, upper, factor, length, cost)
        keep = solution.solved
        self._last = solution.x if keep else np.zeros_like(q)
        self._dual = solution.dual if keep else np.zeros_like(lower)
        return solution

    def _refine(
        self, P: Array, q: Array, A: Array, lower: Array, upper: Array, factor: Array, length: Array, cost: float
    ) -> QpSolution:
        iterations = 0
        for accuracy in ACCURACIES:
            if accuracy != ACCURACIES[0]:
                self._set(accuracy, self._iterations - iterations)
            self._workspace.solve()
            info, found = self._workspace.info, self._workspace.solution
            status = str(info.status)
            iterations += int(info.iter)
            # Copies: the binding's arrays are views of its workspace
            x, scaled = np.array(found.x), np.array(found.y)
            dual = scaled / (length * cost)
            if dual.any() and "infeasible" not in status:
                x, dual = _polish(q, A, lower, upper, factor, x, dual, scaled * length, length)
            errors = residuals(P, q, A, lower, upper, x, dual)
            if all(error <= self._tolerance for error in errors):  # a NaN is not
                status = SOLVED
            elif status == SOLVED:
                status = "inaccurate"
            if status != "inaccurate" or iterations >= self._iterations:
                break
        if accuracy != ACCURACIES[0]:
            self._set(ACCURACIES[0], self._iterations)
        return QpSolution(x, dual, iterations, status, *errors)

    def _set(self, accuracy: float, iterations: int) -> None:
        self._settings.eps_abs = self._settings.eps_rel = accuracy
        self._settings.max_iter = iterations
        self._workspace.update_settings(self._settings)


def _polish(
    q: Array, A: Array, lower: Array, upper: Array, factor: Array, x: Array, dual: Array, pull: Array, length: Array
) -> tuple[Array, Array]:
    """Point and multipliers of the active rows' equations, the active set corrected while signs or bounds disagree.

    A row is taken for active where its multiplier (`pull`, in the row's units) exceeds the distance from its bound.

    With S the active rows and b their bounds: (A_S P⁻¹ A_Sᵀ) y = −(b + A_S P⁻¹ q), x = −P⁻¹(q + A_Sᵀ y).
    """
    n = len(q)
    Ax = A.dot(x)
    at_upper = upper - Ax < pull
    at_lower = Ax - lower < -pull
    inverse = lapack.dpotrs(factor, np.column_stack((A.T, q)), lower=1)[0]
    for done in range(POLISHING_PASSES):
        rows = np.flatnonzero(at_upper | at_lower)
        if len(rows) > n:
            return x, dual
        y = np.zeros(len(dual))
        free = inverse[:, -1]
        if len(rows):
            active = A[rows]
            bound = np.where(at_upper, upper, lower)[rows]
            _, multipliers, fault = lapack.dposv(active.dot(inverse[:, rows]), -(bound + active.dot(free)), lower=1)
            if fault != 0:
                return x, dual
            y[rows] = multipliers
        point = -(free + inverse[:, :-1].dot(y))
        point_Ax = A.dot(point)
        slack = 1e-9 * (1.0 + np.abs(point_Ax))
        wrong = (at_upper & (y < 0.0)) | (at_lower & (y > 0.0))
        # Active rows are at their bound but for rounding, which may be more than the slack
        over, under = (point_Ax > upper + slack) & ~at_upper, (point_Ax < lower - slack) & ~at_lower
        if not np.count_nonzero(wrong | over | under):
            return point, y
        if done >= BLOCK_PASSES:  # one row at a time, lest the set goes round in circles
            blame = np.where(wrong, np.abs(y) * length, np.maximum(point_Ax - upper, lower - point_Ax) / length)
            worst = int(np.argmax(np.where(wrong | over | under, blame, -1.0)))
            single = np.zeros_like(wrong)
            single[worst] = True
            wrong, over, under = wrong & single, over & single, under & single
        at_upper = (at_upper & ~wrong) | over
        at_lower = (at_lower & ~wrong) | under
    return x, dual
