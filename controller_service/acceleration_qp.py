"""The QP of a tick: tasks and limits in, q̈ʳ and wrench Fʳ out, and what happens when they conflict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from controller_service.collision import CollisionModel
from controller_service.constraints import ConstraintRows, JointLimits
from controller_service.daqp_solver import DaqpSolver
from controller_service.errors import QpError
from controller_service.force_tasks import WrenchVariables
from controller_service.model import Array, Configuration
from controller_service.osqp_solver import OsqpSolver
from controller_service.qp import QpSolution, Solver, objective
from controller_service.tasks import Task
from schemas.controller import QpConfig

PENALTY = 1e2
"""Weight of a relaxed limit's squared excess over the largest curvature of the tasks."""
RELAXED_BY = 1e-3
"""Excess [rad/s², m/s²] from which a limit counts as relaxed."""


@dataclass(frozen=True, slots=True)
class ReferenceMotion:
    """What the QP of a tick decided."""

    acceleration: Array
    """q̈ʳ (n,) [rad/s²]."""
    wrench: Array | None
    """Fʳ (6,) of the environment on the hand, world axes; None without a wrench task."""
    solution: QpSolution
    relaxed: tuple[str, ...] = ()
    """Limits of range, speed and distance that could not be kept beside those of torque, by name."""


class AccelerationQp:
    """(5) of [Benallegue 2021] over x = [q̈; Fʳ], with one solver for the life of the controller.

    Torque limits are always met, and can be: q̈ = M⁻¹(τ − h − added) satisfies them. Where the limits of range, speed
    and distance do not fit beside them (a joint thrown towards its limit), these get slack variables σ with the penalty
    ½ ρ ‖σ‖², ρ = `PENALTY` times the tasks' largest curvature; the result says by name which were exceeded. A program
    that is still not solved raises: q̈ʳ is never used unsolved.

    Args:
        limits: of the joints.
        config: solver, iterations, tolerance, γ.
        collision: distances to keep.
        wrench: the hand's wrench as a variable.

    Raises:
        ConfigurationError: the solver's package is not installed.

    """

    def __init__(
        self,
        limits: JointLimits,
        config: QpConfig,
        collision: CollisionModel | None = None,
        wrench: WrenchVariables | None = None,
    ) -> None:
        self._n = len(limits.names)
        self._config = config
        self._collision, self._wrench = collision, wrench
        self.limits = limits
        pairs = 0 if collision is None else collision.max_pairs
        self._soft = self._n + pairs
        """The first rows may be relaxed."""
        self._size = self._n + (0 if wrench is None else 6)
        self._rows = 2 * self._n + pairs + (self._size - self._n)
        self._solver = self._make_solver(self._size, self._rows)
        self._relaxing = self._make_solver(self._size + self._soft, self._rows)

    def solve(
        self, now: Configuration, tasks: Sequence[Task], added: Array, sequence: int, driving: Array | None = None
    ) -> ReferenceMotion:
        """q̈ʳ and Fʳ at a configuration.

        Args:
            now: configuration.
            tasks: on q̈.
            added: (n,) [N·m] all that the law adds to uʳ, part of the torque rows.
            sequence: for the error.
            driving: (n,) [N·m] the part of it that accelerates the robot if the disturbance it stands for is gone; None
                is none.

        Raises:
            QpError: not solved, not even with range, speed and distance limits relaxed.

        """
        P, q = self._objective(tasks)
        rows, names = self._constraints(now, added, driving)
        solution = self._solver.solve(P, q, rows.A, rows.lower, rows.upper)
        if solution.solved:
            return self._motion(solution)
        return self._relaxed(P, q, rows, names, solution, sequence)

    def _objective(self, tasks: Sequence[Task]) -> tuple[Array, Array]:
        n = self._n
        P, q = objective(tasks, n, self._config.regularization)
        if self._wrench is None:
            return P, q
        whole, linear = np.zeros((self._size, self._size)), np.zeros(self._size)
        whole[:n, :n], linear[:n] = P, q
        whole.flat[n * (self._size + 1) :: self._size + 1] = self._config.regularization
        self._wrench.add_to(whole, linear)
        return whole, linear

    def _constraints(
        self, now: Configuration, added: Array, driving: Array | None
    ) -> tuple[ConstraintRows, tuple[tuple[str, str], ...]]:
        """Rows in the order: joints' acceleration, distances, torque, wrench; and the pairs of the distances."""
        n, soft = self._n, self._soft
        A = np.zeros((self._rows, self._size))
        lower, upper = np.empty(self._rows), np.empty(self._rows)
        caused: Array | None = None if driving is None else lapack.dposv(now.mass, driving, lower=1)[1]
        A[:n, :n].flat[:: n + 1] = 1.0
        lower[:n], upper[:n] = self.limits.acceleration_bounds(now, caused)
        pairs: tuple[tuple[str, str], ...] = ()
        if self._collision is not None:
            near = self._collision.rows(now)
            A[n:soft, :n], lower[n:soft], upper[n:soft] = near.A, near.lower, np.inf
            if caused is not None:
                lower[n:soft] -= np.minimum(near.A.dot(caused), 0.0)
            pairs = near.names
        A[soft : soft + n, :n] = now.mass
        lower[soft : soft + n], upper[soft : soft + n] = self.limits.torque_bounds(now, added)
        if self._wrench is not None:
            A[soft : soft + n, n:] = self._wrench.coupling(now)
            A[soft + n :, n:].flat[::7] = 1.0
            lower[soft + n :], upper[soft + n :] = self._wrench.lower, self._wrench.upper
        return ConstraintRows(A, lower, upper), pairs

    def _motion(self, solution: QpSolution, relaxed: tuple[str, ...] = ()) -> ReferenceMotion:
        n = self._n
        wrench = None if self._wrench is None else solution.x[n : self._size]
        return ReferenceMotion(solution.x[:n], wrench, solution, relaxed)

    def _relaxed(
        self,
        P: Array,
        q: Array,
        rows: ConstraintRows,
        pairs: tuple[tuple[str, str], ...],
        first: QpSolution,
        sequence: int,
    ) -> ReferenceMotion:
        """Solve again over [x; σ] with l ≤ A x + σ ≤ u in the soft rows."""
        size, soft = self._size, self._soft
        whole, linear = np.zeros((size + soft, size + soft)), np.zeros(size + soft)
        whole[:size, :size], linear[:size] = P, q
        whole.flat[size * (size + soft + 1) :: size + soft + 1] = PENALTY * float(P.diagonal().max())
        A = np.zeros((self._rows, size + soft))
        A[:, :size] = rows.A
        A[:soft, size:].flat[:: soft + 1] = 1.0
        solution = self._relaxing.solve(whole, linear, A, rows.lower, rows.upper)
        if not solution.solved:
            raise QpError(solution.status, solution.primal_residual, solution.dual_residual, sequence)
        solution = replace(solution, iterations=first.iterations + solution.iterations)
        labels = [f"range or speed of {name}" for name in self.limits.names] + [
            f"distance {a} to {b}" for a, b in pairs
        ]
        excess = np.abs(solution.x[size:]) > RELAXED_BY
        relaxed = tuple(label for label, over in zip(labels, excess.tolist(), strict=False) if over)
        return self._motion(solution, relaxed)

    def _make_solver(self, n: int, m: int) -> Solver:
        size = (n, m, self._config.iterations, self._config.tolerance)
        return OsqpSolver(*size) if self._config.solver == "osqp" else DaqpSolver(*size)
