"""Algorithm 1 of [Del Prete 2016] in every cycle: joint motion, wrench and joint torques from encoders, IMU and F/T.

Two filters can do it. `savitzky_golay` fits polynomials to the last samples of every sensor and speaks of the middle of
that window: all of one time, which is `delay_s` ago. `kalman` follows the joints with a model of drives and robot and
speaks of now; its force/torque and inertial readings pass a first-order low-pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from controller_service.base_motion import BaseMotion, ImuKinematics
from controller_service.ft_calibration import Payload
from controller_service.joint_filter import JointKalman
from controller_service.model import Array, Configuration, RobotModel
from controller_service.position_torque import Motors
from controller_service.savitzky_golay import SavitzkyGolay
from controller_service.torque_estimation import TorqueEstimate, TorqueEstimator
from schemas.control_law import JointKalmanFilter, PositionTorque, SavitzkyGolayFilter
from schemas.load import Robot
from schemas.messages import RobotState
from schemas.robot import RobotDescription

LONGEST_HOLD: Final = 5
"""Cycles for which the last reading of a sensor stands in for one that does not come."""
LARGEST_NOISE_RATIO: Final = 100.0
"""Of the modelled acceleration's noise over a period, σ_a T², to that of an encoder."""


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """What is believed of the robot, all of the time `delay_s` ago."""

    position: Array
    """q̂ (n,) [rad]."""
    velocity: Array
    """q̇̂ (n,) [rad/s]."""
    acceleration: Array
    """q̈̂ (n,) [rad/s²]."""
    torque: TorqueEstimate


class MotionSensing:
    """The estimation of one robot.

    Args:
        robot: description and URDF.
        model: of the controller.
        config: filter, sensors, payload.
        motors: of all joints, for the model that `kalman` follows.

    Raises:
        ConfigurationError: unknown sensors, a window that is too short.

    """

    def __init__(self, robot: Robot, model: RobotModel, config: PositionTorque, motors: Motors) -> None:
        description = robot.description
        n, period = len(description.joints), description.period_s
        self._sensor, self._imu_name = config.sensor, config.imu
        sensors = () if config.sensor is None else (config.sensor,)
        self._estimator = TorqueEstimator(robot, sensors, compensations=_payloads(config))
        imu = next((imu for imu in description.imus if imu.name == config.imu), None)
        self._imu_kinematics = None if imu is None else ImuKinematics(model.model, imu.frame, description.joint_names)
        self._rest = BaseMotion.at_rest(np.array(description.gravity_in_world))
        self._motors = motors
        self._period = period
        self.models_drives = config.estimator == "kalman"
        """The drives' model is followed (`remember`)."""
        self._filters: _Filters = (
            _Following(description, config.kalman) if self.models_drives else _Windows(n, period, config.savitzky_golay)
        )
        self.delay_s = self._filters.delay_s
        """How late the estimates are [s]."""
        self._readings = np.zeros(12)
        """Angular velocity, specific force; force, moment: the last of each."""
        self._used = tuple(name for name in (config.imu, config.sensor) if name is not None)
        self._ages: dict[str, int] = {}
        """Cycles since the last reading of each sensor that has been read."""
        self.silent: tuple[str, int] | None = None
        """A sensor that gave no new reading for more than `LONGEST_HOLD` cycles, and for how many."""
        self._last_target: Array | None = None

    @property
    def ready(self) -> bool:
        """Enough has been seen of every sensor since the start for the estimates to be of use."""
        heard = not self._used or (self._filters.sensors_ready and self.silent is None)
        return self._filters.ready and heard

    def update(self, state: RobotState, position: Array, cycles: int) -> MotionEstimate:
        """Estimate at a state; `position` (n,) [rad] is its measured one, `cycles` after the last state.

        While a sensor is silent its last reading stands in; whoever relies on that asks `silent`.
        """
        q, velocity, acceleration = self._filters.joints(position, cycles)
        base, value = self._rest, self._readings
        if self._used:
            self._read(state, cycles)
        if self.silent is not None:
            self._filters.forget_sensors()
        elif self._used and len(self._ages) == len(self._used):
            value, rate = self._filters.sensors(self._readings, cycles)
            if self._imu_kinematics is not None:
                base = self._imu_kinematics.base_motion(q, velocity, acceleration, value[:3], rate[:3], value[3:6])
        wrenches = () if self._sensor is None else (value[6:],)
        torque = self._estimator.estimate(q, velocity, acceleration, base, wrenches)
        return MotionEstimate(q, velocity, acceleration, torque)

    def remember(self, now: Configuration, motion: MotionEstimate, state: RobotState, contact: Array) -> None:
        """Predict the joints to the next state by the drives' model.

            q̈ = M⁻¹ (τ(Δq, q̇) − h + Jᵀ f̂)

        Args:
            now: M and h at this state.
            motion: of this state.
            state: whose applied target the drives follow until the next.
            contact: Jᵀ f̂ (n,) [N·m].

        """
        applied, motors = state.applied, self._motors
        if applied.torque is not None:  # drives in torque mode, which no offset moves
            self._last_target = None
            torque = np.array(applied.torque) - motors.friction(motion.velocity) / motors.torque_gain
        else:
            target = np.array(state.position_measured if applied.position is None else applied.position)
            before = target if self._last_target is None else self._last_target
            self._last_target = target
            ahead = motion.position + (0.5 * self._period) * motion.velocity
            torque = motors.torque(0.5 * (target + before) - ahead, motion.velocity)
        acceleration = np.asarray(np.linalg.solve(now.mass, torque - now.nonlinear + contact), np.float64)
        self._filters.predict(acceleration)

    def _read(self, state: RobotState, cycles: int) -> None:
        """Take the new readings; the last one stands in for one that does not come."""
        ages, readings = self._ages, self._readings
        for name in ages:
            ages[name] += cycles
        for imu in state.imus:
            if imu.name == self._imu_name and imu.age_cycles < cycles:  # also what came with a missed state
                readings[:6] = imu.angular_velocity_in_imu + imu.acceleration_in_imu
                ages[imu.name] = imu.age_cycles
        for wrench in state.wrenches:
            if wrench.name == self._sensor and wrench.age_cycles < cycles:
                readings[6:] = wrench.force_in_sensor + wrench.torque_in_sensor
                ages[wrench.name] = wrench.age_cycles
        silent = [(name, age) for name, age in ages.items() if age > LONGEST_HOLD]
        self.silent = silent[0] if silent else None


class _Filters(Protocol):
    """Positions and sensor readings in, motion and smoothed readings out."""

    delay_s: float

    @property
    def ready(self) -> bool:
        """Enough positions have been seen."""
        ...

    @property
    def sensors_ready(self) -> bool:
        """Enough readings have been seen."""
        ...

    def joints(self, position: Array, cycles: int) -> tuple[Array, Array, Array]:
        """q̂, q̇̂, q̈̂."""
        ...

    def sensors(self, readings: Array, cycles: int) -> tuple[Array, Array]:
        """Smoothed readings (12,), of inertial unit and force/torque sensor, and their rate (12,)."""
        ...

    def forget_sensors(self) -> None:
        """Start anew with the next readings."""
        ...

    def predict(self, acceleration: Array) -> None:
        """Take the modelled q̈ (n,) of the coming period."""
        ...


class _Windows:
    """Savitzky-Golay filters of equal length for all sensors."""

    def __init__(self, n: int, period_s: float, config: SavitzkyGolayFilter) -> None:
        window, at = config.window, config.evaluate_at
        self._joints = SavitzkyGolay(n, window, config.encoder_order, period_s, derivatives=2, at=at)
        self._sensors = SavitzkyGolay(12, window, config.sensor_order, period_s, derivatives=1, at=at)
        self.delay_s = self._joints.delay_s

    @property
    def ready(self) -> bool:
        """A whole window of positions has been seen."""
        return self._joints.ready

    @property
    def sensors_ready(self) -> bool:
        """A whole window of readings has been seen."""
        return self._sensors.ready

    def joints(self, position: Array, cycles: int) -> tuple[Array, Array, Array]:
        """q̂, q̇̂, q̈̂."""
        value, rate, second = self._joints.update(position, cycles)
        return value, rate, second

    def sensors(self, readings: Array, cycles: int) -> tuple[Array, Array]:
        """Smoothed readings and their rate."""
        value, rate = self._sensors.update(readings, cycles)
        return value, rate

    def forget_sensors(self) -> None:
        """Fill the window anew."""
        self._sensors.restart()

    def predict(self, acceleration: Array) -> None:
        """Polynomials know no model."""


class _Following:
    """A Kalman filter of the joints, low-passes for the other sensors."""

    delay_s = 0.0

    def __init__(self, description: RobotDescription, config: JointKalmanFilter) -> None:
        steps = [2.0 * math.pi / (joint.encoder_counts * joint.gear_ratio) for joint in description.joints]
        # The gain of an encoder that is finer than the model's noise is 1 anyway, and its Riccati equation ill-posed
        least = config.acceleration_noise * description.period_s**2 / LARGEST_NOISE_RATIO
        noise = np.maximum(np.array(steps) / math.sqrt(12.0), least)
        self._filter = JointKalman(description.period_s, noise, config.acceleration_noise, config.disturbance_noise)
        self._rate = 2.0 * math.pi * config.sensor_cutoff_hz * description.period_s
        self._smooth: Array | None = None
        self._acceleration = np.zeros(len(steps))
        self._no_rate = np.zeros(12)
        self.ready = self.sensors_ready = False

    def joints(self, position: Array, cycles: int) -> tuple[Array, Array, Array]:
        """q̂, q̇̂, q̈̂."""
        if self.ready:
            self._filter.predict(self._acceleration, cycles)
        motion = self._filter.correct(position)
        self.ready = True
        return motion.position, motion.velocity, motion.acceleration

    def sensors(self, readings: Array, cycles: int) -> tuple[Array, Array]:
        """Smoothed readings; their rate is left out, a gyroscope's difference being noise (section 2.3)."""
        if self._smooth is None:
            self._smooth = readings.copy()
            self.sensors_ready = True
        else:
            self._smooth = self._smooth + (1.0 - math.exp(-self._rate * cycles)) * (readings - self._smooth)
        return self._smooth, self._no_rate

    def forget_sensors(self) -> None:
        """Start the low-passes at the next readings."""
        self._smooth, self.sensors_ready = None, False

    def predict(self, acceleration: Array) -> None:
        """Keep the model's q̈ until the next position comes."""
        self._acceleration = acceleration


def _payloads(config: PositionTorque) -> dict[str, Payload]:
    payload = config.payload
    if payload is None or config.sensor is None:
        return {}
    moment = payload.mass * np.array(payload.centre_in_sensor)
    return {config.sensor: Payload(payload.mass, moment, np.array(payload.force_offset + payload.torque_offset))}
