"""The controller: robot state in, joint command and trace out; pure but for its own state."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
import pinocchio as pin

from controller_service.acceleration_qp import AccelerationQp
from controller_service.errors import ControllerError, StateError
from controller_service.estimation import Estimate, VelocityEstimator
from controller_service.law import IntegralTerm, LawTerms, inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import QpSolution
from controller_service.schedule import PhaseTime, References, Schedule
from schemas.base import ControlMode, Vector
from schemas.load import Run
from schemas.messages import ControllerTrace, HalStatus, JointCommand, PoseSample, RobotState

TORQUE_SAMPLES = 8
"""Measured motor torques averaged for the transition, at rest."""
REST_SPEED = 0.02
"""[rad/s] Faster than this on any joint, the transition takes the last torque alone."""
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


@dataclass(frozen=True, slots=True)
class _Tick:
    """What a stage made of a state: all that command and trace need."""

    mode: ControlMode
    now: Configuration
    solution: QpSolution
    velocity_reference: Array
    terms: LawTerms
    position_reference: Array
    position_command: Array | None
    """None in torque mode."""
    torque: Array
    """u within its limits, or the computed torque in the position modes."""


class Controller:
    """Answers each robot state, in order of their sequence.

    Phases follow the sequence number (`Schedule`), also while the HAL holds the robot: afterwards the controller starts
    again from the firmware's target. A change from position to torque takes two ticks (section IV-A of [Benallegue
    2021]): CAPTURE, then the first torque, with the integral term set so that uʳ + L s₀ is the torque that the position
    loop was giving; the tasks start from the measured configuration. From torque to position the first target is the
    measured position, and the reference starts there at rest: the holding rule has the firmware brake what still moves,
    where a reference that moved on would add k_d q̇ to the torque one period later. The HAL adds what its firmware needs
    to hold (docs/architecture.md).

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
        self._references = References(description, config)
        self._qp = AccelerationQp(description, config.qp)
        self._integral = IntegralTerm(self._n, config.lambda_, enabled=config.integral == "passivity")
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

    @property
    def stage(self) -> Stage:
        """Of the last answered state."""
        return self._stage

    def step(self, state: RobotState) -> tuple[JointCommand, ControllerTrace]:
        """Answer a state.

        Raises:
            StateError: out of sequence, wrong number of joints, not finite, or without the motor torque that torque
                mode starts from.
            QpError: see `AccelerationQp`.
            ControllerError: a command that is not finite.

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
        self._acceleration = tick.solution.x
        return self._command(state, tick), self._trace(state, time, estimate, tick)

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
        if wanted is not ControlMode.TORQUE:
            return Stage.POSITION
        return Stage.TORQUE if self._stage in (Stage.CAPTURE, Stage.TORQUE) else Stage.CAPTURE

    def _hold(self, state: RobotState, estimate: Estimate) -> _Tick:
        now = self._model.configure(estimate.position, estimate.velocity)
        self._position, self._velocity = _firmware_target(state), np.zeros(self._n)
        self._references.forget()
        self._torques.clear()
        solution = QpSolution(np.zeros(self._n), np.zeros(0), 0, "not solved: holding", 0.0, 0.0)
        return self._position_tick(self._still_mode, now, solution, self._position)

    def _follow(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> _Tick:
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
        tasks = self._references.tasks(time, now)
        solution = self._qp.solve(now, tasks, np.zeros(self._n), state.sequence)
        self._acceleration = solution.x
        target = estimate.position if before is Stage.TORQUE else self._ahead(self._period)[0]
        return self._position_tick(time.phase.mode, now, solution, target)

    def _capture(
        self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage
    ) -> _Tick:
        """First step of the transition: the target stands still, QP and tasks get the measured configuration."""
        self._position = self._ahead(elapsed_s)[0] if before is Stage.POSITION else _firmware_target(state)
        self._velocity = np.zeros(self._n)
        now = self._model.configure(estimate.position, estimate.velocity)
        self._references.forget()
        tasks = self._references.tasks(time, now)
        solution = self._qp.solve(now, tasks, np.zeros(self._n), state.sequence)
        return self._position_tick(self._still_mode, now, solution, self._position)

    def _drive(self, state: RobotState, time: PhaseTime, estimate: Estimate, elapsed_s: float, before: Stage) -> _Tick:
        """Torque mode, (3): u = uʳ + L s within the torque limits."""
        now = self._model.configure(estimate.position, estimate.velocity)
        tasks = self._references.tasks(time, now)
        if before is Stage.TORQUE:
            self._integral.advance(self._acceleration, elapsed_s)
            error, integral = self._integral.terms(now)
            solution = self._qp.solve(now, tasks, integral, state.sequence)
            reference = inverse_dynamics(now, solution.x)
        else:
            solution = self._qp.solve(now, tasks, np.zeros(self._n), state.sequence)
            reference = inverse_dynamics(now, solution.x)
            start = self._torque_given(state, estimate) - reference if self._config.initialize_integral else None
            self._integral.reset(now, start)
            error, integral = self._integral.terms(now)
            self._torques.clear()
        limits = self._qp.limits.torque
        torque = reference + integral
        clipped = np.minimum(np.maximum(torque, -limits), limits)
        if np.count_nonzero(np.abs(torque) > self._reported_torque):
            solution = replace(solution, status=f"{solution.status}, torque clipped")
        terms = LawTerms(error, reference, integral)
        return _Tick(
            ControlMode.TORQUE,
            now,
            solution,
            self._integral.velocity_reference,
            terms,
            estimate.position,
            None,
            clipped,
        )

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

    def _position_tick(self, mode: ControlMode, now: Configuration, solution: QpSolution, target: Array) -> _Tick:
        zero = np.zeros(self._n)
        terms = LawTerms(zero, inverse_dynamics(now, solution.x), zero)
        return _Tick(mode, now, solution, self._velocity, terms, self._position, target, terms.reference)

    def _command(self, state: RobotState, tick: _Tick) -> JointCommand:
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

    def _trace(self, state: RobotState, time: PhaseTime, estimate: Estimate, tick: _Tick) -> ControllerTrace:
        desired, measured = self._references.hand_target, None
        if self._frame is not None:
            frame = tick.now.frames[self._frame]
            open_loop = self._stage is Stage.POSITION
            measured = _pose(
                *(self._model.pose(estimate.position, self._frame) if open_loop else (frame.position, frame.rotation))
            )
        return ControllerTrace(
            sequence=state.sequence,
            time_ns=state.time_ns,
            phase=time.phase.name,
            mode=tick.mode,
            position_estimated=state.position_measured,
            velocity_estimated=tuple(estimate.velocity.tolist()),
            acceleration_reference=tuple(tick.solution.x.tolist()),
            velocity_reference=tuple(tick.velocity_reference.tolist()),
            velocity_error=tuple(tick.terms.velocity_error.tolist()),
            torque_reference=tuple(tick.terms.reference.tolist()),
            torque_integral=tuple(tick.terms.integral.tolist()),
            torque_commanded=tuple(tick.torque.tolist()),
            position_reference=tuple(tick.position_reference.tolist()),
            hand_desired=None if desired is None else _pose(desired.position, desired.rotation),
            hand_estimated=measured,
            qp_iterations=tick.solution.iterations,
            qp_primal_residual=tick.solution.primal_residual,
            qp_dual_residual=tick.solution.dual_residual,
            qp_status=tick.solution.status,
        )


def _firmware_target(state: RobotState) -> Array:
    return np.array(state.position_measured if state.applied.position is None else state.applied.position)


def _pose(position: Array, rotation: Array) -> PoseSample:
    px, py, pz, x, y, z, w = pin.SE3ToXYZQUATtuple(pin.SE3(rotation, position))
    return PoseSample(position_in_world=(px, py, pz), orientation_to_world=(w, x, y, z))
