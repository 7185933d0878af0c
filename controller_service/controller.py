"""The controller: robot state in, joint command and trace out; pure but for its own state."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from controller_service.acceleration_qp import AccelerationQp, ReferenceMotion
from controller_service.collision import CollisionModel
from controller_service.constraints import JointLimits
from controller_service.errors import ControllerError, StateError
from controller_service.estimation import Estimate, VelocityEstimator
from controller_service.hand_control import HandControl
from controller_service.law import inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import QpSolution
from controller_service.schedule import PhaseTime, References, Schedule
from controller_service.task_set import TaskSet
from controller_service.tick import EventLog, HandTrace, Tick, make_trace
from controller_service.torque_mode import TorqueMode, TorqueTick
from schemas.base import ControlMode, Vector
from schemas.errors import ConfigurationError
from schemas.load import Run
from schemas.messages import ControllerTrace, Event, HalStatus, JointCommand, RobotState

TORQUE_SAMPLES = 8
"""Measured motor torques averaged for the transition, at rest."""
REST_SPEED = 0.02
"""[rad/s] Faster than this on any joint, the transition takes the last torque alone."""
CLIP_SHARE = 1e-3
"""Share of the torque limit beyond which a clipped torque is reported."""
STOP_S = 0.1
"""Time from the failure of torque mode to the controller's end."""
STOP_DECAY_S = 0.025
"""Time constant with which the last torque goes over into a braking one meanwhile."""
STOP_DAMPING = 10.0
"""[1/s] of that braking: with the joints' inertia it stops them in some 100 ms where the torque limits allow it."""


class Stage(Enum):
    """Where the controller stands between position and torque."""

    HOLD = auto()
    """The HAL is not active: answer with the firmware's target where it is; everything restarts from there."""
    POSITION = auto()
    """q̈ʳ is integrated twice in open loop; the integral is the QP's configuration and the command."""
    CAPTURE = auto()
    """First tick of the two-step transition: the target is held, the QP has the measured configuration."""
    TORQUE = auto()
    """u = uʳ + L s at the measured configuration."""
    STOPPING = auto()
    """Torque mode cannot go on: the last torque falls to what carries the robot, then the controller gives up."""


class Controller:
    """Answers each robot state, in order of their sequence.

    Phases follow the sequence number (`Schedule`), also while the HAL holds the robot: afterwards the controller starts
    again from the firmware's target. A change from position to torque takes two ticks (section IV-A of [Benallegue
    2021]): CAPTURE, then the first torque, with the integral term set so that uʳ + L s₀ is the torque that the position
    loop was giving; the tasks start from the measured configuration. From torque to position the first target is the
    measured position, and the reference starts there at rest: the holding rule has the firmware brake what still moves,
    where a reference that moved on would add k_d q̇ to the torque one period later. The HAL adds what its firmware needs
    to hold (docs/architecture.md).

    When torque mode cannot go on (a QP without solution, a contact that is to stop the robot) the last torque goes over
    into one that carries and brakes the robot while an event tells why; after `STOP_S` the error is raised, and the HAL
    holds the robot.

    Args:
        run: robot and scenario.
        session: identity of this controller, put into every command.

    Raises:
        ConfigurationError: phases that do not fit the drives, no model, no solver.

    """

    def __init__(self, run: Run, session: str) -> None:
        description, config = run.robot.description, run.scenario.controller
        self._session = session
        self._period = description.period_s
        self._config = config
        self._frame = description.hand_frame
        self._model = RobotModel(run.robot, (self._frame,) if self._frame else ())
        self._n = self._model.n
        self._estimator = VelocityEstimator(self._period, config.velocity_cutoff_hz)
        self._schedule = Schedule(description, config.phases)
        self._references = References(description)
        hand = None if config.hand_force is None else HandControl(run.robot, config.hand_force)
        limits = JointLimits(description, config.qp.damper_s)
        collision = None
        if config.collision is not None:
            collision = CollisionModel(run.robot, config.collision, self._model, limits.response_s)
        self._qp = AccelerationQp(limits, config.qp, collision, None if hand is None else hand.variables)
        self._tasks = TaskSet(self._frame, config)
        if config.null_space is not None and self._tasks.hand_rows >= self._n:
            raise ConfigurationError(
                f"controller.null_space: a hand task of {self._tasks.hand_rows} directions leaves {self._n} joints no"
                " null space; leave it out, or choose another controller.hand_task"
            )
        self._torque_mode = TorqueMode(run, self._qp, self._references, self._tasks, hand)
        contacts = config.observer is not None and config.observer.reaction != "none"
        self._log = EventLog(description.joint_names, contacts=contacts)
        servo = all(joint.drive.kind == "servo" for joint in description.joints)
        self._still_mode = ControlMode.SERVO if servo else ControlMode.POSITION
        self._torque_limits: Vector = tuple(self._qp.limits.torque.tolist())
        self._reported_torque = (1.0 + CLIP_SHARE) * self._qp.limits.torque
        self._torques: deque[Vector] = deque(maxlen=TORQUE_SAMPLES)
        self._stage = Stage.HOLD
        self._sequence: int | None = None
        self._position = np.zeros(self._n)
        """Open-loop position reference [rad], at the current state's time."""
        self._velocity = np.zeros(self._n)
        self._acceleration = np.zeros(self._n)
        """q̈ʳ of the last tick, held since."""
        self._torque = np.zeros(self._n)
        """Of the last tick in torque mode."""
        self._failure: tuple[ControllerError, float] | None = None
        """Why torque mode ends, and for how long it has been ending [s]."""

    def drain_events(self) -> list[Event]:
        """Take the events since the last call."""
        return self._log.drain()

    @property
    def stage(self) -> Stage:
        """Of the last answered state."""
        return self._stage

    def step(self, state: RobotState) -> tuple[JointCommand, ControllerTrace]:
        """Answer a state.

        Raises:
            StateError: out of sequence, wrong number of joints, not finite, or without the motor torque that torque
                mode starts from.
            ControllerError: a command that is not finite; a QP without solution, a contact that is to stop the robot, a
                silent sensor: in torque mode these come after the robot was brought to rest.

        """
        measured, cycles = self._accept(state)
        estimate = self._estimator.estimate(measured, cycles)
        if state.motor_torque_measured is not None:
            self._torques.append(state.motor_torque_measured)
        time = self._schedule.at(state.sequence)
        before, self._stage = self._stage, self._next_stage(state, time.phase.mode)
        elapsed_s = cycles * self._period
        if self._stage is Stage.HOLD:
            tick = self._hold(state, estimate)
        elif self._stage is Stage.POSITION:
            tick = self._follow(state, time, estimate, elapsed_s, before)
        elif self._stage is Stage.CAPTURE:
            tick = self._capture(state, time, estimate, elapsed_s, before)
        else:
            tick = self._drive(state, time, estimate, elapsed_s, before)
        self._acceleration = tick.motion.acceleration
        self._log.note(state, tick)
        if (phase := self._references.take_dropped_path()) is not None:
            text = f"{phase}: too little time is left for its path; the hand holds"
            self._log.tell(state, "path_dropped", text, "warning")
        return self._command(state, tick), make_trace(state, time, estimate, tick, self._hand_trace(estimate, tick))

    def _accept(self, state: RobotState) -> tuple[Array, int]:
        if len(state.position_measured) != self._n:
            raise StateError(
                f"state {state.sequence} has {len(state.position_measured)} positions, the robot has {self._n} joints:"
                " is another robot running under the same namespace?"
            )
        measured = np.array(state.position_measured)
        if not all(map(math.isfinite, state.position_measured)):
            worst = int(np.argmin(np.isfinite(measured)))
            raise StateError(f"state {state.sequence}: position of {self._model.names[worst]} is {measured[worst]}")
        cycles = 1 if self._sequence is None else state.sequence - self._sequence
        if cycles < 1:
            raise StateError(
                f"state {state.sequence} came after state {self._sequence}; states must be in order, each once."
                " Is there a second HAL under the same namespace?"
            )
        self._sequence = state.sequence
        return measured, cycles

    def _next_stage(self, state: RobotState, wanted: ControlMode) -> Stage:
        if state.status is not HalStatus.ACTIVE:
            return Stage.HOLD
        if self._failure is not None:
            return Stage.STOPPING
        if wanted is not ControlMode.TORQUE:
            return Stage.POSITION
        return Stage.TORQUE if self._stage in (Stage.CAPTURE, Stage.TORQUE) else Stage.CAPTURE

    def _hold(self, state: RobotState, estimate: Estimate) -> Tick:
        if self._failure is not None:
            raise self._failure[0]  # the HAL holds the robot: nothing is left to bring to rest
        now = self._model.configure(estimate.position, estimate.velocity)
        self._position, self._velocity = _firmware_target(state), np.zeros(self._n)
        self._references.forget()
        self._torques.clear()
        return self._position_tick(self._still_mode, now, self._unsolved("holding"), self._position)

    def _follow(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> Tick:
        """Position mode: (q_ref, q̇_ref) is the QP's configuration; the command is q_ref one period on."""
        if before is Stage.POSITION:
            self._position, self._velocity = self._ahead(elapsed_s)
        else:
            self._references.forget()
            if before is Stage.HOLD:
                self._position = _firmware_target(state)
            elif before is Stage.TORQUE:
                self._position, self._velocity = estimate.position, np.zeros(self._n)
                self._torques.clear()
        now = self._model.configure(self._position, self._velocity)
        motion = self._plan(now, time, state)
        self._acceleration = motion.acceleration
        target = estimate.position if before is Stage.TORQUE else self._ahead(self._period)[0]
        return self._position_tick(time.phase.mode, now, motion, target)

    def _capture(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> Tick:
        """First step of the transition: the target stands still, QP and tasks get the measured configuration."""
        self._position = self._ahead(elapsed_s)[0] if before is Stage.POSITION else _firmware_target(state)
        self._velocity = np.zeros(self._n)
        now = self._model.configure(estimate.position, estimate.velocity)
        self._references.forget()
        return self._position_tick(self._still_mode, now, self._plan(now, time, state), self._position)

    def _plan(self, now: Configuration, time: PhaseTime, state: RobotState) -> ReferenceMotion:
        """Solve the tasks of the position modes and of the capture: the schedule's, and no integral term."""
        tasks = self._tasks.make(now, self._references.advance(time, now))
        return self._qp.solve(now, tasks, np.zeros(self._n), state.sequence)

    def _drive(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> Tick:
        """Torque mode, (3) or (21), within the torque limits; or its end."""
        now = self._model.configure(estimate.position, estimate.velocity)
        if self._failure is not None:
            return self._stop(now, estimate, elapsed_s)
        if before is not Stage.TORQUE:
            # The drives are still in position mode and hold the robot, whatever is raised here
            given = self._torque_given(state, estimate) if self._config.initialize_integral else None
            terms = self._torque_mode.start(now, time, state, given)
            self._torques.clear()
            self._warn_of_friction(state, now)
            return self._torque_tick(now, estimate, terms, state)
        try:
            terms = self._torque_mode.step(now, time, state, self._acceleration, elapsed_s)
            return self._torque_tick(now, estimate, terms, state)
        except ControllerError as error:
            self._fail(state, error)
            return self._stop(now, estimate, elapsed_s)

    def _torque_tick(self, now: Configuration, estimate: Estimate, terms: TorqueTick, state: RobotState) -> Tick:
        limits, torque, motion = self._qp.limits.torque, terms.torque, terms.motion
        if not all(map(math.isfinite, torque.tolist())):
            worst = int(np.argmin(np.isfinite(torque)))
            raise ControllerError(
                f"state {state.sequence}: the law's torque of {self._model.names[worst]} is {torque[worst]}"
            )
        self._torque = np.minimum(np.maximum(torque, -limits), limits)
        if np.count_nonzero(np.abs(torque) > self._reported_torque):
            status = f"{motion.solution.status}, torque clipped"
            motion = replace(motion, solution=replace(motion.solution, status=status))
        reference = self._torque_mode.law.velocity_reference
        return Tick(ControlMode.TORQUE, now, motion, reference, estimate.position, None, self._torque, terms)

    def _warn_of_friction(self, state: RobotState, now: Configuration) -> None:
        if steep := self._torque_mode.steep_joints(now):
            text = f"friction compensation is steep for slow motion of {', '.join(steep)}: raise smoothing_velocity"
            self._log.tell(state, "friction_compensation_steep", text, "warning")

    def _fail(self, state: RobotState, error: ControllerError) -> None:
        self._failure = (error, 0.0)
        self._stage = Stage.STOPPING
        self._log.tell(state, "torque_mode_failed", f"{error} The robot is brought to rest.", "error")

    def _stop(self, now: Configuration, estimate: Estimate, elapsed_s: float) -> Tick:
        """τ ← τ_b + (τ − τ_b) e^(−t/`STOP_DECAY_S`) with τ_b = g − `STOP_DAMPING` diag(M) q̇."""
        assert self._failure is not None
        error, since_s = self._failure
        if since_s >= STOP_S:
            raise error
        self._failure = (error, since_s + elapsed_s)
        braking = now.gravity - STOP_DAMPING * now.mass.diagonal() * now.velocity
        torque = braking + math.exp(-elapsed_s / STOP_DECAY_S) * (self._torque - braking)
        limits = self._qp.limits.torque
        self._torque = np.minimum(np.maximum(torque, -limits), limits)
        reference = self._torque_mode.law.velocity_reference
        motion = self._unsolved("stopping")
        return Tick(ControlMode.TORQUE, now, motion, reference, estimate.position, None, self._torque, None)

    def _unsolved(self, why: str) -> ReferenceMotion:
        zero = np.zeros(self._n)
        return ReferenceMotion(zero, None, QpSolution(zero, np.zeros(0), 0, f"not solved: {why}", 0.0, 0.0))

    def _torque_given(self, state: RobotState, estimate: Estimate) -> Array:
        """Return what the position loop was giving, from the motor currents (n,) [N·m]."""
        if state.motor_torque_measured is None:
            raise StateError(
                f"state {state.sequence}: the drives report no motor torque, which torque mode starts from."
                " Use position mode, or set controller.initialize_integral to false."
            )
        if np.abs(estimate.velocity).max() > REST_SPEED:
            return np.array(self._torques[-1])
        mean: Array = np.mean(self._torques, axis=0)
        return mean

    def _ahead(self, time_s: float) -> tuple[Array, Array]:
        """Open-loop reference after q̈ʳ was held for a time: exact double integration."""
        step = time_s * self._acceleration
        return self._position + time_s * (self._velocity + 0.5 * step), self._velocity + step

    def _position_tick(self, mode: ControlMode, now: Configuration, motion: ReferenceMotion, target: Array) -> Tick:
        torque = inverse_dynamics(now, motion.acceleration)
        return Tick(mode, now, motion, self._velocity, self._position, target, torque, None)

    def _command(self, state: RobotState, tick: Tick) -> JointCommand:
        value = tick.torque if tick.position_command is None else tick.position_command
        vector = tuple(value.tolist())
        if not all(map(math.isfinite, vector)):
            worst = int(np.argmin(np.isfinite(value)))
            raise ControllerError(
                f"state {state.sequence}: the {tick.mode.value} command of {self._model.names[worst]} is {value[worst]}"
            )
        return JointCommand(
            session=self._session,
            sequence=state.sequence,
            time_ns=state.time_ns,
            mode=tick.mode,
            position=None if tick.position_command is None else vector,
            torque=vector if tick.position_command is None else None,
            torque_limit=self._torque_limits if tick.mode is ControlMode.SERVO else None,
        )

    def _hand_trace(self, estimate: Estimate, tick: Tick) -> HandTrace:
        """Desired and estimated pose of the hand; in position mode the configuration is the reference's."""
        if self._frame is None:
            return HandTrace(None, None)
        frame = tick.now.frames[self._frame]
        pose = frame.position, frame.rotation
        if self._stage is Stage.POSITION:
            pose = self._model.pose(estimate.position, self._frame)
        return HandTrace(self._references.hand_target, pose)


def _firmware_target(state: RobotState) -> Array:
    return np.array(state.position_measured if state.applied.position is None else state.applied.position)
