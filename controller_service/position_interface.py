"""Torque mode for drives that take positions only, one verb a stage: sense → refer → compare → sum → limit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from controller_service.acceleration_qp import AccelerationQp, ReferenceMotion
from controller_service.delay_line import DelayLine
from controller_service.errors import ControllerError, StateError
from controller_service.law import inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.motion_sensing import LONGEST_HOLD, MotionEstimate, MotionSensing
from controller_service.position_torque import Errors, Motors, OffsetTerms, PositionTorqueLaw
from controller_service.qp import QpSolution
from controller_service.reference import minimum_jerk
from controller_service.schedule import PhaseTime, Targets
from controller_service.task_set import TaskSet
from controller_service.tasks import PostureTarget
from schemas.control_law import PositionTorque, SineWrench
from schemas.errors import ConfigurationError
from schemas.load import Run
from schemas.messages import RobotState
from schemas.robot import RobotDescription

Mask = NDArray[np.bool_]

_NOTHING: Final = np.zeros(0)
SPEED_SHARE: Final = 1.2
"""A joint faster than this share of its limit ends torque control: the HAL then holds the last target."""


@dataclass(frozen=True, slots=True)
class InterfaceTick:
    """All terms of a command q + δ q̇ + Δq."""

    estimate: MotionEstimate
    terms: OffsetTerms
    torque_desired: Array
    """τ^d less its feedback (n,) [N·m]: of (12) with all errors zero, or the QP's."""
    wrench: Array | None
    """Of the environment on the hand, estimated (6,), world axes; None without a sensor."""
    wrench_reference: Array
    """f^d (6,)."""
    motion: ReferenceMotion
    torque: Array
    """τ* (n,) [N·m], before the limit of Δq."""
    command: Array
    """(n,) [rad], within range and speed limits."""
    limited: tuple[str, ...]
    """What a limit was put on, by name."""


class Fade:
    """An offset that goes to zero along a minimum-jerk curve, so that a change of law is none of the command."""

    def __init__(self, duration_s: float) -> None:
        self._duration = duration_s
        self._offset: Array | None = None
        self._elapsed = 0.0

    def start(self, offset: Array) -> None:
        """Begin with an offset (n,)."""
        self._offset, self._elapsed = offset, 0.0

    def stop(self) -> None:
        """Leave none."""
        self._offset = None

    def advance(self, command: Array, elapsed_s: float) -> Array:
        """Add what is left of the offset after a time to a command."""
        if self._offset is None:
            return command
        self._elapsed += elapsed_s
        left = 1.0 - minimum_jerk(self._elapsed, self._duration)[0]
        if left <= 0.0:
            self._offset = None
            return command
        faded: Array = command + left * self._offset
        return faded


class _LowPass:
    """First-order low-passes y ← y + (1 − e^(−2π f_c t)) (x − y) of named signals; they start at the first value.

    Args:
        cutoff_hz: f_c; None lets all pass.

    """

    def __init__(self, cutoff_hz: float | None) -> None:
        self._rate = None if cutoff_hz is None else 2.0 * math.pi * cutoff_hz
        self._values: dict[str, Array] = {}

    def restart(self) -> None:
        """Forget all."""
        self._values.clear()

    def pass_on(self, name: str, value: Array, elapsed_s: float) -> Array:
        """Smooth the value of a signal."""
        if self._rate is None:
            return value
        last = self._values.get(name)
        if last is not None:
            value = last + (1.0 - math.exp(-self._rate * elapsed_s)) * (value - last)
        self._values[name] = value
        return value


class PositionInterface:
    """From a state to the position that makes the drives give the wanted torques.

    Args:
        run: robot and scenario, with `controller.position_torque`.
        config: its.
        model: of the controller.
        qp: of the controller.
        tasks: makes the QP's.

    Raises:
        ConfigurationError: unknown sensors, a hand that the sensor does not carry.

    """

    def __init__(self, run: Run, config: PositionTorque, model: RobotModel, qp: AccelerationQp, tasks: TaskSet) -> None:
        description = run.robot.description
        n, period = len(description.joints), description.period_s
        self._config, self._qp, self._tasks, self._period = config, qp, tasks, period
        self._model, self._names, self._frame = model, description.joint_names, description.hand_frame
        self._motors = Motors.of(config, description.joint_names)
        self._law = PositionTorqueLaw(config, self._motors, qp.limits.torque)
        self._sensing = MotionSensing(run.robot, model, config, self._motors)
        self._sensor_frame = _sensor_frame(description, config.sensor)
        self._refuse_hand_before_sensor(model)
        self._past = DelayLine(3 * n + 6, self._sensing.delay_s, period)
        self._lead_s = period * (description.command_delay_cycles + 1) if config.compensate_delay else 0.0
        """A command reaches the drive after the delay and its firmware goes there within one more cycle."""
        self._slow = _LowPass(config.kalman.feedback_cutoff_hz if self._sensing.models_drives else None)
        self._fade = Fade(config.start_s)
        """From the position control's command to the law's."""
        self._low = np.array([joint.position_min for joint in description.joints])
        self._high = np.array([joint.position_max for joint in description.joints])
        self._speed = np.array([joint.velocity_limit for joint in description.joints])
        self._step = period * self._speed
        self._largest = largest_offset(description)
        self._zero, self._no_wrench = np.zeros(n), np.zeros(6)
        self._last_command = self._zero
        self._running_s = 0.0
        """Since the start."""
        self._since = self._zero
        """q̇^d less that of `delay_s` ago (n,) [rad/s], of the last state."""
        self._estimate: MotionEstimate | None = None

    def _refuse_hand_before_sensor(self, model: RobotModel) -> None:
        """Refuse a hand that the sensor does not carry: the wrench that it reads does not act there."""
        if self._sensor_frame is None or self._frame is None:
            return
        whole = model.model
        hand, sensor = (whole.frames[whole.getFrameId(name)].parentJoint for name in (self._frame, self._sensor_frame))
        if hand not in list(whole.subtrees[sensor]):
            raise ConfigurationError(
                f"controller.position_torque.sensor: the robot's hand_frame {self._frame!r} does not lie beyond the"
                f" sensor {self._config.sensor!r} (link {self._sensor_frame!r}): what it reads is not the hand's wrench"
            )

    @property
    def delay_s(self) -> float:
        """How late the estimates are [s]."""
        return self._sensing.delay_s

    @property
    def ready(self) -> bool:
        """The estimates can be relied upon."""
        return self._sensing.ready

    def sense(self, state: RobotState, position: Array, cycles: int) -> MotionEstimate:
        """Estimate; to be called at every state."""
        self._estimate = self._sensing.update(state, position, cycles)
        return self._estimate

    def velocity(self) -> Array:
        """Estimate q̇ (n,) [rad/s] of now: the late one, carried forward by what was desired since."""
        assert self._estimate is not None
        late = self._estimate.velocity
        return late + self._since if self._config.predict_velocity else late

    def watch(self, target: PostureTarget | None, now: Configuration, state: RobotState, cycles: int) -> None:
        """Remember what position control asks for, while that runs; `now` is near where the robot is."""
        velocity = self._zero if target is None else target.velocity
        acceleration = self._zero if target is None else target.acceleration
        desired = inverse_dynamics(now, acceleration)
        then = self._past.push(np.concatenate((velocity, acceleration, desired, self._no_wrench)), cycles)
        self._since = velocity - then[: len(velocity)]
        if self._sensing.models_drives:
            self._model_drives(now, state, self._wrench())

    def start(
        self, position: Array, now: Configuration, time: PhaseTime, targets: Targets, state: RobotState, cycles: int
    ) -> InterfaceTick:
        """Make the first command, which is `position` (n,) [rad], what position control would have sent.

        Raises:
            QpError: see `AccelerationQp`.

        """
        self._law.reset()
        self._slow.restart()
        self._running_s = 0.0
        self._last_command = position
        tick = self._compute(now, time, targets, state, cycles)
        self._fade.start(position - tick.command)
        return replace(tick, command=position, limited=())

    def step(
        self, now: Configuration, time: PhaseTime, targets: Targets, state: RobotState, cycles: int, speed: Array
    ) -> InterfaceTick:
        """Make any later command; `speed` is q̇ (n,) [rad/s] from the newest positions.

        Raises:
            StateError: a sensor is silent.
            ControllerError: a joint is too fast.
            QpError: see `AccelerationQp`.

        """
        if self._sensing.silent is not None:
            name, age = self._sensing.silent
            raise StateError(
                f"state {state.sequence}: sensor {name} has had no new reading for {age} cycles, at most"
                f" {LONGEST_HOLD} are bridged under torque control. Check its cable, bus and power, or leave it out of"
                " controller.position_torque."
            )
        if np.count_nonzero(np.abs(speed) > SPEED_SHARE * self._speed):
            worst = int(np.argmax(np.abs(speed) / self._speed))
            raise ControllerError(
                f"state {state.sequence}: {self._names[worst]} moves at {speed[worst]:.3g} rad/s under torque control,"
                f" its limit is {self._speed[worst]:g}. Identify its motor anew, or lower the gains of"
                " controller.position_torque."
            )
        self._running_s += cycles * self._period
        tick = self._compute(now, time, targets, state, cycles)
        wanted = self._fade.advance(tick.command, cycles * self._period)
        in_range = np.minimum(np.maximum(wanted, self._low), self._high)
        step = cycles * self._step
        command = np.minimum(np.maximum(in_range, self._last_command - step), self._last_command + step)
        self._last_command = command
        limited = self._named("position range", in_range != wanted) + self._named("velocity limit", command != in_range)
        return replace(tick, command=command, limited=tick.limited + limited)

    def _compute(
        self, now: Configuration, time: PhaseTime, targets: Targets, state: RobotState, cycles: int
    ) -> InterfaceTick:
        """All terms, and the command before its limits."""
        assert self._estimate is not None
        estimate, posture, elapsed_s = self._estimate, targets.posture, cycles * self._period
        wanted = self._no_wrench
        if time.phase.wrench is not None:
            # Entered late, as after a hold, it must not be there at once
            wanted = desired_wrench(time.phase.wrench, min(time.since_start_s, self._running_s), time.left_s)
        jacobian = None if self._frame is None else now.frames[self._frame].jacobian
        motion = self._reference_motion(now, targets, state)
        desired = inverse_dynamics(now, motion.acceleration)
        if time.phase.wrench is not None and jacobian is not None:
            desired -= wanted.dot(jacobian)
        then = self._past.push(np.concatenate((posture.velocity, posture.acceleration, desired, wanted)), cycles)
        n = len(self._names)
        wrench, velocity = self._wrench(), now.velocity
        self._since = posture.velocity - then[:n]
        if self._config.desired == "qp":
            error = self._slow.pass_on("torque", then[2 * n : 3 * n] - estimate.torque.torque, elapsed_s)
            terms = self._law.torque_terms(desired, velocity, error, elapsed_s)
        else:
            errors = Errors(
                posture.position - now.position,
                then[:n] - estimate.velocity,
                self._slow.pass_on("acceleration", then[n : 2 * n] - estimate.acceleration, elapsed_s),
                None if wrench is None else self._slow.pass_on("wrench", then[3 * n :] - wrench, elapsed_s),
            )
            force_gain = 0.0 if time.phase.wrench is None else self._config.force_gain
            terms = self._law.terms(desired, velocity, errors, now.mass, jacobian, force_gain, elapsed_s)
        of_torque = terms.of_torque
        asked = of_torque + terms.friction
        offset = np.minimum(np.maximum(asked, -self._largest), self._largest)
        command = now.position + self._lead_s * velocity + offset
        if self._sensing.models_drives:
            self._model_drives(now, state, wrench)
        limited = self._named("offset limit", offset != asked)
        return InterfaceTick(
            estimate, terms, desired, wrench, wanted, motion, of_torque / self._motors.torque_gain, command, limited
        )

    def _reference_motion(self, now: Configuration, targets: Targets, state: RobotState) -> ReferenceMotion:
        if self._config.desired == "qp":
            return self._qp.solve(now, self._tasks.make(now, targets), self._zero, state.sequence)
        acceleration = targets.posture.acceleration
        return ReferenceMotion(acceleration, None, QpSolution(acceleration, _NOTHING, 0, "inverse dynamics", 0.0, 0.0))

    def _wrench(self) -> Array | None:
        """Move the estimated wrench (6,) from the sensor to the hand's origin, world axes, where both were then."""
        assert self._estimate is not None
        if self._sensor_frame is None or self._frame is None:
            return None
        at = self._estimate.position
        position, rotation = self._model.pose(at, self._sensor_frame)
        wrench: Array = self._estimate.torque.external_wrenches[0].reshape(2, 3).dot(rotation.T).ravel()
        if self._sensor_frame != self._frame:
            x, y, z = position - self._model.pose(at, self._frame)[0]
            fx, fy, fz = wrench[:3].tolist()
            wrench[3:] += (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)
        return wrench

    def _model_drives(self, now: Configuration, state: RobotState, wrench: Array | None) -> None:
        assert self._estimate is not None
        contact = self._zero
        if wrench is not None and self._frame is not None:
            contact = wrench.dot(now.frames[self._frame].jacobian)
        self._sensing.remember(now, self._estimate, state, contact)

    def _named(self, limit: str, acts: Mask) -> tuple[str, ...]:
        """Name the joints on which a limit acts."""
        if not np.count_nonzero(acts):
            return ()
        return tuple(f"{self._names[joint]}: {limit}" for joint in np.flatnonzero(acts).tolist())


def desired_wrench(wrench: SineWrench, since_s: float, left_s: float) -> Array:
    """f^d (6,) at a time since its start and before the phase's end; both are ramps along minimum-jerk curves."""
    share = minimum_jerk(since_s, wrench.ramp_s)[0] * minimum_jerk(left_s, wrench.ramp_s)[0]
    sine = math.sin(2.0 * math.pi * wrench.frequency_hz * max(0.0, since_s - wrench.ramp_s))
    desired: Array = share * (np.array(wrench.mean) + sine * np.array(wrench.amplitude))
    return desired


def largest_offset(description: RobotDescription) -> Array:
    """(τ_max + d + k_d q̇_max) / k_p (n,) [rad]: what drives at their limits of torque and speed can make use of."""
    return np.array(
        [
            (joint.torque_limit + joint.drive.dead_zone + joint.drive.velocity_gain * joint.velocity_limit)
            / joint.drive.position_gain
            for joint in description.joints
        ]
    )


def _sensor_frame(description: RobotDescription, name: str | None) -> str | None:
    return next((sensor.frame for sensor in description.force_torque_sensors if sensor.name == name), None)
