"""Torque mode, one verb a stage: sense → refer → add → solve → sum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller_service.acceleration_qp import AccelerationQp, ReferenceMotion
from controller_service.contact import END_SHARE, ContactDetector, ContactState
from controller_service.disturbance import MomentumObserver
from controller_service.errors import ContactError, StateError
from controller_service.friction import FrictionCompensator, slope_limit
from controller_service.hand_control import HandControl, HandForces
from controller_service.law import IntegralLaw, LawTerms, inverse_dynamics
from controller_service.model import Array, Configuration
from controller_service.schedule import PhaseTime, References, Targets
from controller_service.task_set import TaskSet
from controller_service.tasks import Task
from schemas.errors import ConfigurationError
from schemas.load import Run
from schemas.messages import RobotState


@dataclass(frozen=True, slots=True)
class Sensed:
    """What the torque mode makes of a state before it decides; None is what the configuration leaves out."""

    external_torque: Array | None
    """Estimated (n,) [N·m], as Jᵀ F of the environment."""
    contact: ContactState | None
    hand: HandForces | None
    yields: bool = False
    """The robot gives way to a contact."""


@dataclass(frozen=True, slots=True)
class TorqueTick:
    """All terms of u = uʳ + (what the law adds) + (friction compensation), each (n,) [N·m]."""

    sensed: Sensed
    motion: ReferenceMotion
    reference: Array
    """uʳ = M q̈ʳ + C q̇ + g − Jᵀ Fʳ."""
    law: LawTerms
    friction: Array

    @property
    def torque(self) -> Array:
        """The sum u, before the last clip."""
        torque: Array = self.reference + self.law.integral + self.friction
        return torque


class TorqueMode:
    """From a configuration and a state to the torque of a tick.

    Args:
        run: robot and scenario.
        qp: of the controller.
        references: of the controller.
        tasks: makes them.
        hand: force control of the hand, None without.

    Raises:
        ConfigurationError: joints that the robot does not have, thresholds below what static friction hides.

    """

    def __init__(
        self, run: Run, qp: AccelerationQp, references: References, tasks: TaskSet, hand: HandControl | None
    ) -> None:
        description, config = run.robot.description, run.scenario.controller
        self._config = config
        self._frame = description.hand_frame
        self._qp, self._references, self._tasks, self._hand = qp, references, tasks, hand
        self._zero = np.zeros(len(description.joints))
        self.law = IntegralLaw(len(description.joints), config, qp.limits.torque)
        friction, observer = config.friction_compensation, config.observer
        self._friction = None if friction is None else FrictionCompensator(description, friction)
        self._observer = (
            None if observer is None else MomentumObserver(description, observer, config.velocity_cutoff_hz)
        )
        self._detector = None if observer is None else ContactDetector(description, observer)
        self._reaction = "none" if observer is None else observer.reaction
        self._names = description.joint_names
        force = config.hand_force
        self._led_directions = () if force is None else force.admittance.directions
        if self._observer is not None and self._detector is not None and self._reaction != "none":
            self._refuse_low_thresholds(self._observer.half_width, self._detector.thresholds)

    def start(self, now: Configuration, time: PhaseTime, state: RobotState, given: Array | None) -> TorqueTick:
        """Make the first torque tick: the law's state is set so that the sum is `given` (n,) [N·m] (section IV-A).

        None: s = 0, the naive start.
        """
        if self._observer is not None and self._detector is not None:
            self._observer.reset(now)
            self._detector.reset()
        friction = self._compensate(now)
        targets = self._references.advance(time, now)
        motion = self._qp.solve(now, self._tasks.make(now, targets), friction, state.sequence)
        reference = self._reference(now, motion)
        if self._hand is not None:
            self._hand.start(motion.wrench)
        self.law.reset(now, None if given is None else given - reference - friction)
        law = self.law.terms(now, None, 0.0)
        return TorqueTick(Sensed(None, None, None), motion, reference, law, friction)

    def step(
        self, now: Configuration, time: PhaseTime, state: RobotState, acceleration: Array, elapsed_s: float
    ) -> TorqueTick:
        """Make any later tick; `acceleration` (n,) is the q̈ʳ that was held for `elapsed_s`.

        Raises:
            QpError: see `AccelerationQp`.
            ContactError: a contact that is to stop the robot.
            StateError: the hand's sensor is silent.

        """
        sensed = self._sense(now, state, elapsed_s)
        targets, tasks = self._refer(now, time, sensed)
        if sensed.yields:
            self.law.rest(now, elapsed_s)
        else:
            self.law.integrate(acceleration, elapsed_s)
        law = self.law.terms(now, self._tasks.jacobian(now, targets), elapsed_s)
        friction = self._compensate(now)
        motion = self._qp.solve(now, tasks, law.integral + friction, state.sequence, law.limited)
        if self._hand is not None:
            self._hand.remember(motion.wrench, elapsed_s)
        reference = self._reference(now, motion)
        return TorqueTick(sensed, motion, reference, law, friction)

    def _refuse_low_thresholds(self, hidden: Array, thresholds: Array) -> None:
        worst = int(np.argmax(hidden / thresholds))
        if hidden[worst] >= END_SHARE * thresholds[worst]:
            raise ConfigurationError(
                f"controller.observer: the threshold of {self._names[worst]} is {thresholds[worst]:g} N·m; a contact"
                f" would end below {END_SHARE * thresholds[worst]:g}, but static friction alone may look like"
                f" {hidden[worst]:g} N·m; raise thresholds.{self._names[worst]}"
            )

    def steep_joints(self, now: Configuration) -> tuple[str, ...]:
        """Joints whose friction compensation makes slow motion of the posture stick and slip (`slope_limit`)."""
        if self._friction is None:
            return ()
        config = self._config
        limits = [slope_limit(now.mass.diagonal(), config.lambda_, gains) for gains in (config.posture, config.hand)]
        steep = self._friction.dry_slope > np.maximum(*limits)
        return tuple(name for name, is_steep in zip(self._names, steep.tolist(), strict=True) if is_steep)

    def _sense(self, now: Configuration, state: RobotState, elapsed_s: float) -> Sensed:
        """Estimate what the environment does."""
        external, contact = None, None
        if self._observer is not None and self._detector is not None:
            if state.motor_torque_measured is None:
                raise StateError(
                    f"state {state.sequence}: the drives report no motor torque, which controller.observer estimates"
                    " external torques from. Leave it out."
                )
            external = self._observer.update(now, np.array(state.motor_torque_measured), elapsed_s)
            contact = self._detector.update(external, elapsed_s)
            if contact.began and self._reaction == "stop":
                joint = self._names[contact.joint]
                raise ContactError(joint, contact.value, self._detector.thresholds[contact.joint], state.sequence)
        hand = None if self._hand is None else self._hand.update(now, state, elapsed_s)
        yields = contact is not None and contact.active and self._reaction == "compliant"
        return Sensed(external, contact, hand, yields)

    def _refer(self, now: Configuration, time: PhaseTime, sensed: Sensed) -> tuple[Targets, tuple[Task, ...]]:
        """Make targets and tasks: the schedule's, changed by what was sensed."""
        if sensed.contact is not None and sensed.contact.ended and self._reaction == "compliant":
            self._references.forget()
        if sensed.hand is not None and sensed.hand.led:
            self._references.follow_hand(now, self._led_directions)
        targets = self._references.advance(time, now)
        return targets, self._tasks.make(now, targets, yielding=sensed.yields, forces=sensed.hand)

    def _compensate(self, now: Configuration) -> Array:
        return self._zero if self._friction is None else self._friction.torque(now.velocity)

    def _reference(self, now: Configuration, motion: ReferenceMotion) -> Array:
        torque = inverse_dynamics(now, motion.acceleration)
        if motion.wrench is not None and self._frame is not None:
            torque -= motion.wrench.dot(now.frames[self._frame].jacobian)
        return torque
