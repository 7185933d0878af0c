"""The controller: robot state in, joint command and trace out; pure but for its own state."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from controller_service.acceleration_qp import AccelerationQp, ReferenceMotion
from controller_service.acceptance import GivenTorque, StateOrder
from controller_service.braking import Braking
from controller_service.collision import CollisionModel
from controller_service.constraints import JointLimits
from controller_service.errors import ControllerError
from controller_service.estimation import Estimate, VelocityEstimator
from controller_service.hand_control import HandControl
from controller_service.law import inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.position_interface import Fade, PositionInterface
from controller_service.qp import QpSolution
from controller_service.schedule import PhaseTime, References, Schedule
from controller_service.task_set import TaskSet
from controller_service.tick import EventLog, HandTrace, Tick, make_command, make_trace
from controller_service.torque_mode import TorqueMode, TorqueTick
from schemas.base import ControlMode, Vector
from schemas.controller import Phase
from schemas.errors import ConfigurationError
from schemas.load import Run
from schemas.messages import ControllerTrace, Event, HalStatus, JointCommand, RobotState

CLIP_SHARE = 1e-3
"""Share of the torque limit beyond which a clipped torque is reported."""


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
    INTERFACE = auto()
    """Torque control through the position interface: the command is q + Δq."""
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
        self._interface = None
        self._fade = Fade(0.0)
        """What the command of the position interface was away from the posture, after it."""
        if config.position_torque is not None:
            self._interface = PositionInterface(run, config.position_torque, self._model, self._qp, self._tasks)
            self._fade = Fade(config.position_torque.start_s)
        contacts = config.observer is not None and config.observer.reaction != "none"
        self._log = EventLog(description.joint_names, contacts=contacts)
        servo = all(joint.drive.kind == "servo" for joint in description.joints)
        self._still_mode = ControlMode.SERVO if servo else ControlMode.POSITION
        self._torque_limits: Vector = tuple(self._qp.limits.torque.tolist())
        self._reported_torque = (1.0 + CLIP_SHARE) * self._qp.limits.torque
        self._torques = GivenTorque()
        self._stage = Stage.HOLD
        self._order = StateOrder(description.joint_names)
        self._position = np.zeros(self._n)
        """Open-loop position reference [rad], at the current state's time."""
        self._velocity = np.zeros(self._n)
        self._acceleration = np.zeros(self._n)
        """q̈ʳ of the last tick, held since."""
        self._torque = np.zeros(self._n)
        """Of the last tick in torque mode."""
        self._given = np.zeros(self._n)
        """Last command of the position interface [rad]."""
        self._waiting = False
        """Torque control through it is asked for, but its sensors are not ready."""
        self._braking = Braking(self._qp.limits.torque)

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
                silent sensor: in torque mode these come after the robot was brought to rest. Through the position
                interface, where a joint may be too fast as well, they come at once: the HAL holds the last target.

        """
        measured, cycles = self._order.accept(state)
        estimate = self._estimator.estimate(measured, cycles)
        self._torques.note(state)
        sensed = None if self._interface is None else self._interface.sense(state, measured, cycles)
        time = self._schedule.at(state.sequence)
        before, self._stage = self._stage, self._next_stage(state, time.phase)
        elapsed_s = cycles * self._period
        if self._stage is Stage.HOLD:
            tick = self._hold(state, estimate)
        elif self._stage is Stage.POSITION:
            tick = self._follow(state, time, estimate, elapsed_s, before)
        elif self._stage is Stage.CAPTURE:
            tick = self._capture(state, time, estimate, elapsed_s, before)
        elif self._stage is Stage.INTERFACE:
            tick = self._give_offset(state, time, estimate, cycles, before)
        else:
            tick = self._drive(state, time, estimate, elapsed_s, before)
        self._acceleration = tick.motion.acceleration
        self._log.note(state, tick)
        if time.phase.torque_control and self._stage is Stage.POSITION and not self._waiting:
            text = f"{time.phase.name}: not every sensor has been read for a whole window; position control goes on"
            self._log.tell(state, "torque_control_waits", text, "warning")
        self._waiting = time.phase.torque_control and self._stage is Stage.POSITION
        if (phase := self._references.take_dropped_path()) is not None:
            text = f"{phase}: too little time is left for its path; the robot holds its place"
            self._log.tell(state, "path_dropped", text, "warning")
        if self._interface is not None and self._stage is not Stage.INTERFACE:
            self._interface.watch(self._references.posture_target, tick.now, state, cycles)
        hand = self._hand_trace(estimate, tick)
        delay_s = 0.0 if self._interface is None else self._interface.delay_s
        told = sensed if self._interface is not None and self._interface.ready else None
        return make_command(state, tick, self._session, self._model.names, self._torque_limits), make_trace(
            state, time, estimate, tick, hand, told, delay_s
        )

    def _next_stage(self, state: RobotState, phase: Phase) -> Stage:
        if state.status is not HalStatus.ACTIVE:
            return Stage.HOLD
        if self._braking.error is not None:
            return Stage.STOPPING
        if phase.torque_control and self._interface is not None:
            running = self._stage is Stage.INTERFACE or self._interface.ready
            return Stage.INTERFACE if running else Stage.POSITION
        if phase.mode is not ControlMode.TORQUE:
            return Stage.POSITION
        return Stage.TORQUE if self._stage in (Stage.CAPTURE, Stage.TORQUE) else Stage.CAPTURE

    def _hold(self, state: RobotState, estimate: Estimate) -> Tick:
        if self._braking.error is not None:
            raise self._braking.error  # the HAL holds the robot: nothing is left to bring to rest
        now = self._model.configure(estimate.position, estimate.velocity)
        self._position, self._velocity = _firmware_target(state), np.zeros(self._n)
        self._fade.stop()
        self._references.forget()
        self._torques.forget()
        return self._position_tick(self._still_mode, now, self._unsolved("holding"), self._position)

    def _follow(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> Tick:
        """Position mode: (q_ref, q̇_ref) is the QP's configuration; the command is q_ref one period on."""
        if before is Stage.POSITION:
            self._position, self._velocity = self._ahead(elapsed_s)
        elif before is Stage.INTERFACE:
            self._leave_interface(elapsed_s)
        else:
            self._references.forget()
            self._fade.stop()
            if before is Stage.HOLD:
                self._position = _firmware_target(state)
            elif before is Stage.TORQUE:
                self._position, self._velocity = estimate.position, np.zeros(self._n)
                self._torques.forget()
        now = self._model.configure(self._position, self._velocity)
        motion = self._plan(now, time, state)
        self._acceleration = motion.acceleration
        target = estimate.position if before is Stage.TORQUE else self._ahead(self._period)[0]
        return self._position_tick(time.phase.mode, now, motion, self._fade.advance(target, elapsed_s))

    def _give_offset(
        self,
        state: RobotState,
        time: PhaseTime,
        estimate: Estimate,
        cycles: int,
        before: Stage,
    ) -> Tick:
        """Torque control through the position interface: the first command is what position control would send."""
        assert self._interface is not None
        if before not in (Stage.POSITION, Stage.INTERFACE):
            self._references.forget()
            if before is Stage.HOLD:
                self._position = _firmware_target(state)
            elif before is Stage.TORQUE:
                self._position = estimate.position
                self._torques.forget()
        now = self._model.configure(estimate.position, self._interface.velocity())
        targets = self._references.advance(time, now)
        if before is Stage.INTERFACE:
            given = self._interface.step(now, time, targets, state, cycles, estimate.velocity)
        else:
            position = self._position
            if before is Stage.POSITION:
                position = self._fade.advance(self._ahead((cycles + 1) * self._period)[0], cycles * self._period)
            given = self._interface.start(position, now, time, targets, state, cycles)
            self._fade.stop()
        self._position, self._velocity = targets.posture.position, targets.posture.velocity
        self._given = given.command
        motion, posture = given.motion, targets.posture
        return Tick(
            ControlMode.POSITION,
            now,
            motion,
            posture.velocity,
            posture.position,
            given.command,
            given.torque,
            None,
            given,
            posture,
        )

    def _leave_interface(self, elapsed_s: float) -> None:
        """Go on with the posture that was desired; what the command was away from it fades."""
        self._position, self._velocity = self._ahead(elapsed_s)
        self._fade.start(self._given - self._position)

    def _capture(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> Tick:
        """First step of the transition: the target stands still, QP and tasks get the measured configuration."""
        if before is Stage.POSITION:
            self._position = self._fade.advance(self._ahead(elapsed_s)[0], elapsed_s)
        else:
            self._position = _firmware_target(state)
        self._velocity = np.zeros(self._n)
        self._fade.stop()
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
        if self._braking.error is not None:
            return self._stop(now, estimate, elapsed_s)
        if before is not Stage.TORQUE:
            # The drives are still in position mode and hold the robot, whatever is raised here
            given = self._torques.torque(state, estimate) if self._config.initialize_integral else None
            terms = self._torque_mode.start(now, time, state, given)
            self._torques.forget()
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
        self._braking.begin(error)
        self._stage = Stage.STOPPING
        self._log.tell(state, "torque_mode_failed", f"{error} The robot is brought to rest.", "error")

    def _stop(self, now: Configuration, estimate: Estimate, elapsed_s: float) -> Tick:
        self._torque = self._braking.torque(self._torque, now, elapsed_s)
        reference = self._torque_mode.law.velocity_reference
        motion = self._unsolved("stopping")
        return Tick(ControlMode.TORQUE, now, motion, reference, estimate.position, None, self._torque, None)

    def _unsolved(self, why: str) -> ReferenceMotion:
        zero = np.zeros(self._n)
        return ReferenceMotion(zero, None, QpSolution(zero, np.zeros(0), 0, f"not solved: {why}", 0.0, 0.0))

    def _ahead(self, time_s: float) -> tuple[Array, Array]:
        """Open-loop reference after q̈ʳ was held for a time: exact double integration."""
        step = time_s * self._acceleration
        return self._position + time_s * (self._velocity + 0.5 * step), self._velocity + step

    def _position_tick(self, mode: ControlMode, now: Configuration, motion: ReferenceMotion, target: Array) -> Tick:
        torque = inverse_dynamics(now, motion.acceleration)
        return Tick(mode, now, motion, self._velocity, self._position, target, torque, None)

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
