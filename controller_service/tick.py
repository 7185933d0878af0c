"""What a tick was made of, and what is told of it: the trace and the events."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

from controller_service.acceleration_qp import ReferenceMotion
from controller_service.errors import ControllerError
from controller_service.estimation import Estimate
from controller_service.model import Array, Configuration
from controller_service.motion_sensing import MotionEstimate
from controller_service.position_interface import InterfaceTick
from controller_service.schedule import PhaseTime
from controller_service.tasks import PoseTarget, PostureTarget
from controller_service.torque_mode import TorqueTick
from schemas.base import ControlMode, Vector
from schemas.messages import ControllerTrace, Event, JointCommand, MotionTrace, OffsetTrace, PoseSample, RobotState

SERVICE = "controller"
REPORT_AGAIN_S = 1.0
"""A limit that stays relaxed is told of no more often than this."""


@dataclass(frozen=True, slots=True)
class Tick:
    """What a stage made of a state: all that command and trace need."""

    mode: ControlMode
    now: Configuration
    motion: ReferenceMotion
    velocity_reference: Array
    position_reference: Array
    position_command: Array | None
    """None in torque mode."""
    torque: Array
    """u within its limits, or the computed torque in the position modes."""
    terms: TorqueTick | None
    """None outside torque mode."""
    interface: InterfaceTick | None = None
    """Under torque control through the position interface."""
    posture: PostureTarget | None = None
    """What that follows."""


@dataclass(frozen=True, slots=True)
class HandTrace:
    """Desired and estimated pose of the hand."""

    desired: PoseTarget | None
    estimated: tuple[Array, Array] | None
    """Position (3,) and rotation (3, 3)."""


class EventLog:
    """Events of the controller, each told once as it begins.

    Args:
        names: of the joints.
        contacts: contacts are told.

    """

    def __init__(self, names: tuple[str, ...], *, contacts: bool = True) -> None:
        self._names = names
        self._contacts = contacts
        self._events: list[Event] = []
        self._relaxed: dict[str, int] = {}
        """When each relaxed limit was last told of [ns]."""

    def drain(self) -> list[Event]:
        """Take the events since the last call."""
        events, self._events = self._events, []
        return events

    def tell(
        self,
        state: RobotState,
        kind: str,
        text: str,
        severity: Literal["info", "warning", "error"] = "info",
        joint: str | None = None,
    ) -> None:
        """Add an event at a state."""
        self._events.append(
            Event(
                sequence=state.sequence,
                time_ns=state.time_ns,
                service=SERVICE,
                kind=kind,
                severity=severity,
                text=text,
                joint=joint,
            )
        )

    def note(self, state: RobotState, tick: Tick) -> None:
        """Add the events that a tick gives rise to."""
        for name in tick.motion.relaxed:
            told_ns = self._relaxed.get(name)
            if told_ns is None or state.time_ns - told_ns >= REPORT_AGAIN_S * 1e9:
                self._relaxed[name] = state.time_ns
                self.tell(state, "constraint_relaxed", f"{name}: cannot be kept with the torque there is", "warning")
        if tick.interface is not None:
            self._note_limits(state, tick.interface.limited)
        if tick.terms is None:
            return
        contact, hand = tick.terms.sensed.contact if self._contacts else None, tick.terms.sensed.hand
        if contact is not None and contact.began:
            joint = self._names[contact.joint]
            self.tell(state, "contact", f"{joint} feels {contact.value:.1f} N·m from outside", "warning", joint)
        if contact is not None and contact.ended:
            self.tell(state, "contact_ended", "the contact is over")
        if hand is not None and hand.compliance.engaged:
            self.tell(state, "admittance_on", f"the hand follows a force of {hand.measured.force_norm:.1f} N")
        if hand is not None and hand.compliance.released:
            self.tell(state, "admittance_off", "the hand stays where it was released")

    def _note_limits(self, state: RobotState, limited: tuple[str, ...]) -> None:
        for name in limited:
            told_ns = self._relaxed.get(name)
            if told_ns is None or state.time_ns - told_ns >= REPORT_AGAIN_S * 1e9:
                self._relaxed[name] = state.time_ns
                self.tell(state, "command_limited", f"{name}: torque control asks for more", "warning")


def make_command(
    state: RobotState, tick: Tick, session: str, names: tuple[str, ...], torque_limit: Vector
) -> JointCommand:
    """Answer a state by what a tick decided.

    Raises:
        ControllerError: a command that is not finite.

    """
    value = tick.torque if tick.position_command is None else tick.position_command
    vector = _vector(value)
    if not all(map(math.isfinite, vector)):
        worst = int(np.argmin(np.isfinite(value)))
        raise ControllerError(
            f"state {state.sequence}: the {tick.mode.value} command of {names[worst]} is {value[worst]}"
        )
    return JointCommand(
        session=session,
        sequence=state.sequence,
        time_ns=state.time_ns,
        mode=tick.mode,
        position=None if tick.position_command is None else vector,
        torque=vector if tick.position_command is None else None,
        torque_limit=torque_limit if tick.mode is ControlMode.SERVO else None,
    )


def make_trace(
    state: RobotState,
    time: PhaseTime,
    estimate: Estimate,
    tick: Tick,
    hand: HandTrace,
    estimated: MotionEstimate | None,
    delay_s: float,
) -> ControllerTrace:
    """Report every term of a tick; `estimated` is of `delay_s` ago."""
    zero = (0.0,) * len(tick.torque)
    terms, solution = tick.terms, tick.motion.solution
    reference, error, integral = tick.torque, zero, zero
    optional: dict[str, object] = {}
    if terms is not None:
        law, sensed = terms.law, terms.sensed
        reference, error, integral = terms.reference, _vector(law.velocity_error), _vector(law.integral)
        optional = {
            "torque_windup": _vector(law.windup),
            "torque_limited": _vector(law.limited),
            "windup_bound": _vector(law.bound),
            "null_space_share": law.null_space_share,
            "torque_friction": _vector(terms.friction),
        }
        if sensed.external_torque is not None and sensed.contact is not None:
            optional["torque_external_estimated"] = _vector(sensed.external_torque)
            optional["contact"] = sensed.contact.active
        if sensed.hand is not None:
            optional["wrench_estimated"] = _vector(sensed.hand.measured.wrench)
            optional["wrench_reference"] = _vector(sensed.hand.reference.wrench)
            optional["admittance"] = sensed.hand.compliance.active
    if estimated is not None:
        optional["estimated"] = _motion_trace(estimated, delay_s)
    if tick.interface is not None and tick.posture is not None:
        optional["offset"] = _offset_trace(tick.interface, tick.posture)
        optional["wrench_reference"] = _vector(tick.interface.wrench_reference)
        if tick.interface.wrench is not None:
            optional["wrench_estimated"] = _vector(tick.interface.wrench)
    return ControllerTrace(
        sequence=state.sequence,
        time_ns=state.time_ns,
        phase=time.phase.name,
        mode=tick.mode,
        position_estimated=state.position_measured,
        velocity_estimated=_vector(estimate.velocity),
        acceleration_reference=_vector(tick.motion.acceleration),
        velocity_reference=_vector(tick.velocity_reference),
        velocity_error=error,
        torque_reference=_vector(reference),
        torque_integral=integral,
        torque_commanded=_vector(tick.torque),
        position_reference=_vector(tick.position_reference),
        hand_desired=None if hand.desired is None else _pose(hand.desired.position, hand.desired.rotation),
        hand_estimated=None if hand.estimated is None else _pose(*hand.estimated),
        qp_iterations=solution.iterations,
        qp_primal_residual=solution.primal_residual,
        qp_dual_residual=solution.dual_residual,
        qp_status=solution.status,
        relaxed=tick.motion.relaxed,
        **optional,
    )


def _motion_trace(sensed: MotionEstimate, delay_s: float) -> MotionTrace:
    return MotionTrace(
        delay_s=delay_s,
        position=_vector(sensed.position),
        velocity=_vector(sensed.velocity),
        acceleration=_vector(sensed.acceleration),
        torque=_vector(sensed.torque.torque),
        link_torque=_vector(sensed.torque.link_torque),
        base_wrench=_vector(sensed.torque.base_wrench),
    )


def _offset_trace(tick: InterfaceTick, posture: PostureTarget) -> OffsetTrace:
    terms = tick.terms
    return OffsetTrace(
        position_desired=_vector(posture.position),
        velocity_desired=_vector(posture.velocity),
        acceleration_desired=_vector(posture.acceleration),
        torque_desired=_vector(tick.torque_desired),
        torque=_vector(terms.torque),
        friction=_vector(terms.friction),
        position=_vector(terms.position),
        velocity=_vector(terms.velocity),
        acceleration=_vector(terms.acceleration),
        force=_vector(terms.force),
        integral=_vector(terms.integral),
        limited=tick.limited,
    )


def _vector(array: Array) -> Vector:
    return tuple(array.tolist())


def _pose(position: Array, rotation: Array) -> PoseSample:
    px, py, pz, x, y, z, w = pin.SE3ToXYZQUATtuple(pin.SE3(rotation, position))
    return PoseSample(position_in_world=(px, py, pz), orientation_to_world=(w, x, y, z))
