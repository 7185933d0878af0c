"""What can go wrong in the controller."""

from __future__ import annotations

from schemas.errors import CosimError


class ControllerError(CosimError):
    """Base of the controller's errors: the service stops, and the HAL holds the robot by itself."""


class StateError(ControllerError):
    """A robot state that the controller cannot answer: out of sequence, or of another robot."""


class QpError(ControllerError):
    """The quadratic program was not solved, not even with the range and speed limits relaxed.

    Attributes:
        sequence: the state that was to be answered; −1 where it is not known.
        status: the solver's word.
        primal_residual, dual_residual: as in `QpSolution`.

    """

    def __init__(self, status: str, primal_residual: float, dual_residual: float, sequence: int = -1) -> None:
        super().__init__(
            f"state {sequence}: the acceleration QP ended with {status!r} (primal residual {primal_residual:.2g}, dual"
            f" {dual_residual:.2g}). Raise controller.qp.iterations, or check torque limits and gains."
        )
        self.sequence = sequence
        self.status = status
        self.primal_residual = primal_residual
        self.dual_residual = dual_residual
