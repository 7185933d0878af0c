"""Whether a scenario fits its robot: what no field alone can tell."""

from __future__ import annotations

import math
from pathlib import Path

from schemas.control_law import MotorModel
from schemas.controller import ControllerConfig, Phase
from schemas.errors import ConfigurationError
from schemas.robot import Joint, RobotDescription
from schemas.scenario import Scenario

MAXIMUM_BACK_CALCULATION_PERIOD = 0.5
"""κT above this is near the border of stability where J⁺ is far from orthogonal."""
MAXIMUM_LAMBDA_PERIOD = 0.3
"""λT above this leaves no phase margin for the integral loop with a cycle of delay."""

TORQUE_GAIN_SHARES = (0.2, 5.0)
"""Of k_τ k_p, which torque scale and cautious fits bring away from 1, but a wrong unit by more."""
LONGEST_VELOCITY_GAIN_S = 0.1
"""k_v, where friction of the gear has a part that the description does not tell."""


def check_run(robot: RobotDescription, scenario: Scenario, path: Path | str) -> None:
    """Refuse a scenario that does not fit its robot.

    Raises:
        ConfigurationError: unknown joint, substep that does not divide the period, λT above 0.3, …

    """
    if round(scenario.duration_s * robot.rate_hz) < 1:
        raise ConfigurationError(
            f"{path}: duration_s: {scenario.duration_s:g} s is shorter than a cycle of {robot.period_s:g} s"
        )
    _check_joints(robot, scenario, path)
    _check_rates(robot, scenario, path)
    _check_position_torque(robot, scenario.controller, path)
    _check_hand(robot, scenario.controller, path)


def _check_joints(robot: RobotDescription, scenario: Scenario, path: Path | str) -> None:
    """Refuse joints that the robot lacks, and angles out of their range."""
    controller = scenario.controller
    postures = [entry for index, phase in enumerate(controller.phases) for entry in _postures(index, phase)]
    mentions = [("plant.initial_posture", joint) for joint in scenario.plant.initial_posture]
    mentions += [(field, joint) for field, posture in postures for joint in posture]
    mentions += [
        (f"controller.phases.{index}.joint_sines.joints", joint)
        for index, phase in enumerate(controller.phases)
        if phase.joint_sines is not None
        for joint in phase.joint_sines.joints
    ]
    if controller.position_torque is not None:
        mentions += [("controller.position_torque.motors", name) for name in controller.position_torque.motors]
    names = set(robot.joint_names)
    for field, joint in mentions:
        if joint not in names:
            raise ConfigurationError(
                f"{path}: {field}: robot {robot.name} has no joint {joint!r}; it has {', '.join(robot.joint_names)}"
            )
    limits = {joint.name: (joint.position_min, joint.position_max) for joint in robot.joints}
    for field, posture in postures:
        for joint, angle in posture.items():
            low, high = limits[joint]
            if not low <= angle <= high:
                raise ConfigurationError(f"{path}: {field}.{joint}: {angle:g} rad lies outside [{low:g}, {high:g}] rad")
    speeds = {joint.name: joint.velocity_limit for joint in robot.joints}
    for index, phase in enumerate(scenario.controller.phases):
        for name, sine in ({} if phase.joint_sines is None else phase.joint_sines.joints).items():
            speed = 2.0 * math.pi * sine.frequency_hz * (sine.amplitude + sine.growth * phase.duration_s)
            if speed > speeds[name]:
                raise ConfigurationError(
                    f"{path}: controller.phases.{index}.joint_sines.joints.{name}: reaches {speed:.3g} rad/s at the"
                    f" phase's end, its velocity_limit is {speeds[name]:g}"
                )


def _check_rates(robot: RobotDescription, scenario: Scenario, path: Path | str) -> None:
    """Refuse what does not go with the robot's period."""
    ratio = robot.period_s / scenario.plant.substep_s
    if not math.isclose(ratio, round(ratio), rel_tol=1e-9) or ratio < 1.0:
        raise ConfigurationError(
            f"{path}: plant.substep_s: {scenario.plant.substep_s:g} s does not divide the period {robot.period_s:g} s"
        )
    product = scenario.controller.lambda_ * robot.period_s
    if product > MAXIMUM_LAMBDA_PERIOD:
        raise ConfigurationError(
            f"{path}: controller.lambda: λT = {product:.3g} with T = {robot.period_s:g} s; expected at most"
            f" {MAXIMUM_LAMBDA_PERIOD} (λ ≤ {MAXIMUM_LAMBDA_PERIOD * robot.rate_hz:g}), or the integral loop"
            " is unstable"
        )
    share = scenario.controller.anti_windup.back_calculation * robot.period_s
    if share > MAXIMUM_BACK_CALCULATION_PERIOD:
        raise ConfigurationError(
            f"{path}: controller.anti_windup.back_calculation: κT = {share:.3g} with T = {robot.period_s:g} s; expected"
            f" at most {MAXIMUM_BACK_CALCULATION_PERIOD}, or the state swings about its limit"
        )


def _check_hand(robot: RobotDescription, controller: ControllerConfig, path: Path | str) -> None:
    """Refuse what needs a hand where there is none."""
    if robot.hand_frame is not None:
        return
    parts = [f"controller.{part}" for part in ("null_space", "hand_force") if getattr(controller, part) is not None]
    parts += [
        f"controller.phases.{index}.hand_path"
        for index, phase in enumerate(controller.phases)
        if phase.hand_path is not None
    ]
    if parts:
        raise ConfigurationError(f"{path}: {parts[0]}: robot {robot.name} has no hand_frame")


def _postures(index: int, phase: Phase) -> list[tuple[str, dict[str, float]]]:
    """Every posture of a phase with its field."""
    field = f"controller.phases.{index}"
    points = () if phase.joint_path is None else phase.joint_path.points
    own = [(f"{field}.posture", phase.posture)]
    return own + [(f"{field}.joint_path.points.{number}.posture", point.posture) for number, point in enumerate(points)]


def _check_motor(joint: Joint, motor: MotorModel, path: Path | str) -> None:
    """Refuse a motor model that is not of this drive: its law gives k_τ = 1/k_p and k_v = k_d/k_p but for friction."""
    drive = joint.drive
    field = f"{path}: controller.position_torque.motors.{joint.name}"
    share, (low, high) = motor.torque_gain * drive.position_gain, TORQUE_GAIN_SHARES
    if not low <= share <= high:
        raise ConfigurationError(
            f"{field}.torque_gain: {motor.torque_gain:g} rad/(N·m) is {share:.3g} times what the drive's position_gain"
            f" says, 1/k_p = {1.0 / drive.position_gain:.3g}; expected {low:g} to {high:g} times. Unit: rad/(N·m)"
        )
    longest = max(LONGEST_VELOCITY_GAIN_S, high * drive.velocity_gain / drive.position_gain)
    if motor.velocity_gain > longest:
        raise ConfigurationError(
            f"{field}.velocity_gain: {motor.velocity_gain:g} s; expected at most {longest:.3g} s, the drive's own"
            f" k_d/k_p is {drive.velocity_gain / drive.position_gain:.3g} s. Unit: s"
        )


def _check_position_torque(robot: RobotDescription, controller: ControllerConfig, path: Path | str) -> None:
    """Refuse torque control through the position interface that lacks what it needs."""
    config = controller.position_torque
    for index, phase in enumerate(controller.phases):
        if not phase.torque_control:
            continue
        field = f"{path}: controller.phases.{index}"
        if config is None:
            raise ConfigurationError(
                f"{field}.torque_control: needs controller.position_torque with the motors' models"
            )
        if phase.wrench is not None and (robot.hand_frame is None or config.sensor is None):
            raise ConfigurationError(
                f"{field}.wrench: needs the robot's hand_frame and controller.position_torque.sensor"
            )
        if config.desired != "qp" and (phase.hand_path is not None or controller.collision is not None):
            what = "hand_path" if phase.hand_path is not None else "torque_control: controller.collision"
            raise ConfigurationError(
                f"{field}.{what}: acts through the QP only; set controller.position_torque.desired to qp"
            )
    if config is None:
        return
    if config.sensor is not None and robot.hand_frame is None:
        raise ConfigurationError(
            f"{path}: controller.position_torque.sensor: robot {robot.name} has no hand_frame, at which its wrench acts"
        )
    if config.payload is not None and config.sensor is None:
        raise ConfigurationError(
            f"{path}: controller.position_torque.payload: is what a force/torque sensor carries; name the sensor"
        )
    for joint in robot.joints:
        if joint.name not in config.motors:
            raise ConfigurationError(
                f"{path}: controller.position_torque.motors: no model of {joint.name}; identify it"
                " (`cosim identify motors`) and name the result in motors_from"
            )
        _check_motor(joint, config.motors[joint.name], path)
    names = {"sensor": [s.name for s in robot.force_torque_sensors], "imu": [imu.name for imu in robot.imus]}
    for field, known in names.items():
        name = getattr(config, field)
        if name is not None and name not in known:
            raise ConfigurationError(
                f"{path}: controller.position_torque.{field}: robot {robot.name} has no {name!r}; it has"
                f" {', '.join(known) or 'none'}"
            )
