"""DAQP, an active-set solver, behind the `Solver` protocol; an optional extra."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from controller_service.model import Array
from controller_service.qp import SOLVED, QpSolution, residuals
from schemas.errors import ConfigurationError

EXIT = {1: SOLVED, 2: "soft optimal", -1: "primal infeasible", -2: "cycling", -3: "unbounded", -4: "maximum iterations"}
"""DAQP's exit flags."""
INFINITY = 1e30


class DaqpSolver:
    """DAQP with the same rows; exact up to rounding, so `iterations` counts changes of the active set.

    Args:
        n: variables.
        m: rows.
        iterations: upper bound.
        tolerance: of `residuals`; the status is `solved` only within it.

    Raises:
        ConfigurationError: the package is not installed.

    """

    def __init__(self, n: int, m: int, iterations: int, tolerance: float) -> None:
        try:
            self._daqp: Any = importlib.import_module("daqp")
        except ImportError as error:
            raise ConfigurationError(
                "controller.qp.solver: daqp is not installed; run `pip install hrp-cosim[daqp]` or choose osqp"
            ) from error
        self._iterations = iterations
        self._tolerance = tolerance
        self._sense = np.zeros(m, dtype=np.int32)

    def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
        """Solve; see `Solver`."""
        scale = 1.0 / float(P.diagonal().max())
        x, _, flag, info = self._daqp.solve(
            np.ascontiguousarray(scale * P),
            scale * q,
            np.ascontiguousarray(A),
            np.minimum(upper, INFINITY),
            np.maximum(lower, -INFINITY),
            self._sense.copy(),
            iter_limit=self._iterations,
            primal_tol=0.01 * self._tolerance,
            dual_tol=1e-12,
        )
        dual = np.asarray(info["lam"]) / scale
        errors = residuals(P, q, A, lower, upper, x, dual)
        status = EXIT.get(flag, f"exit flag {flag}")
        if status == SOLVED and not all(error <= self._tolerance for error in errors):  # a NaN is not
            status = "inaccurate"
        return QpSolution(np.asarray(x), dual, int(info["iterations"]), status, *errors)
