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


class ContactError(ControllerError):
    """The observer's external torque is over a threshold whose reaction is to stop.

    Attributes:
        joint: its name.
        torque: estimated [N·m].
        threshold: [N·m].

    """

    def __init__(self, joint: str, torque: float, threshold: float, sequence: int) -> None:
        super().__init__(
            f"state {sequence}: {joint} feels {torque:.1f} N·m from outside, more than its threshold of"
            f" {threshold:.1f} N·m, and controller.observer.reaction is stop. Free the robot and start again."
        )
        self.joint = joint
        self.torque = torque
        self.threshold = threshold
