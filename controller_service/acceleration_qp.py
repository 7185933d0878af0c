"""The QP of a tick: tasks and limits in, reference acceleration q̈ʳ out, and what happens when they conflict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from controller_service.constraints import JointLimits
from controller_service.daqp_solver import DaqpSolver
from controller_service.errors import QpError
from controller_service.model import Array, Configuration
from controller_service.osqp_solver import OsqpSolver
from controller_service.qp import QpSolution, Solver, objective
from controller_service.tasks import Task
from schemas.controller import QpConfig
from schemas.robot import RobotDescription

RELAXED = "solved, range and speed limits relaxed"
"""Start of the status when the limits of torque and those of range and speed could not all be met."""


class AccelerationQp:
    """(5) of [Benallegue 2021] over q̈, with one solver for the life of the controller.

    Torque limits are always met. Where range and speed limits ask for more torque than there is (a joint thrown towards
    its limit), the tasks are given up and q̈ʳ is the acceleration nearest to these limits that the torques allow, in the
    metric of M; the status says so. A program that is still not solved raises: q̈ʳ is never used unsolved.

    Args:
        description: of the robot.
        config: solver, iterations, tolerance, γ, damper.

    Raises:
        ConfigurationError: the solver's package is not installed.

    """

    def __init__(self, description: RobotDescription, config: QpConfig) -> None:
        self._n = len(description.joints)
        self._regularization = config.regularization
        self.limits = JointLimits(description, config.damper_s)
        size = (self._n, 2 * self._n, config.iterations, config.tolerance)
        self._solver: Solver = OsqpSolver(*size) if config.solver == "osqp" else DaqpSolver(*size)

    def solve(self, now: Configuration, tasks: Sequence[Task], integral: Array, sequence: int) -> QpSolution:
        """q̈ʳ = `x` (n,) [rad/s²] at a configuration, with L s = `integral` (n,) [N·m] in the torque rows.

        Raises:
            QpError: not solved, not even with range and speed limits relaxed.

        """
        P, q = objective(tasks, self._n, self._regularization)
        rows = self.limits.rows(now, integral)
        solution = self._solver.solve(P, q, rows.A, rows.lower, rows.upper)
        if solution.solved:
            return solution
        n, first = self._n, solution
        wanted = np.clip(np.linalg.solve(P, -q), rows.lower[:n], rows.upper[:n])
        rows = rows.without_kinematics()
        solution = self._solver.solve(now.mass, -(now.mass @ wanted), rows.A, rows.lower, rows.upper)
        if not solution.solved:
            raise QpError(solution.status, solution.primal_residual, solution.dual_residual, sequence)
        iterations = first.iterations + solution.iterations
        return replace(solution, status=f"{RELAXED} ({first.status})", iterations=iterations)
