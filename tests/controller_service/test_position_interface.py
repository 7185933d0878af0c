"""Torque control through positions, tick by tick: what fades, what is limited and named, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller_service.acceleration_qp import AccelerationQp
from controller_service.constraints import JointLimits
from controller_service.errors import ControllerError
from controller_service.model import Array, Configuration, RobotModel
from controller_service.position_interface import (
    SPEED_SHARE,
    Fade,
    InterfaceTick,
    PositionInterface,
    desired_wrench,
    largest_offset,
)
from controller_service.schedule import PhaseTime, Targets
from controller_service.task_set import TaskSet
from controller_service.tasks import PostureTarget
from schemas.base import ControlMode
from schemas.control_law import SineWrench
from schemas.controller import Phase
from schemas.load import Robot, Run
from schemas.messages import AppliedCommand, DriveState, HalStatus, RobotState, WrenchSample
from schemas.robot import RobotDescription

POSTURE = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
ZERO = np.zeros(9)
T = 0.002
SENSOR = {"name": "wrist", "frame": "link7", "bus": "b2", "can_id": 0x100, "command_id": 0x110}
WINDOW = 10


@pytest.mark.parametrize("duration", [0.1, 0.3])
def test_a_fade_goes_from_all_to_nothing_without_a_step(duration: float) -> None:
    fade, offset, command = Fade(duration), np.array([0.5, -2.0]), np.array([1.0, 1.0])
    assert fade.advance(command, T) is command
    fade.start(offset)
    left = np.array([fade.advance(command, T) - command for _ in range(round(duration / T) + 10)]) / offset
    assert left[:, 0] == pytest.approx(left[:, 1])
    steps = -np.diff(np.vstack((np.ones(2), left)), axis=0)
    assert (steps >= 0.0).all()
    assert steps.max() < 1.9 * T / duration
    assert left[0, 0] > 1.0 - 0.5 * T / duration
    assert not left[round(duration / T) :].any()
    assert fade.advance(command, T) is command


def test_a_fade_stopped_or_started_again_forgets_the_old_offset() -> None:
    fade, command = Fade(0.1), np.zeros(1)
    fade.start(np.ones(1))
    fade.advance(command, 0.05)
    fade.start(np.array([4.0]))
    assert fade.advance(command, 0.0) == pytest.approx([4.0])
    fade.stop()
    assert fade.advance(command, 0.0) is command


def phase_time(since_s: float, duration_s: float = 5.0, wrench: dict[str, Any] | None = None) -> PhaseTime:
    fields = {"name": "p", "mode": "position", "duration_s": duration_s, "torque_control": True, "wrench": wrench}
    return PhaseTime(0, Phase.model_validate(fields), since_s)


def test_the_desired_wrench_comes_swings_and_goes() -> None:
    sine = SineWrench(mean=(0, 0, 100, 1, 0, 0), amplitude=(0, 0, 40, 0, 2, 0), frequency_hz=0.5, ramp_s=1.0)
    mean, amplitude = np.array(sine.mean), np.array(sine.amplitude)

    def at(time: float) -> Array:
        return desired_wrench(sine, time, 5.0 - time)

    assert not at(0.0).any()
    assert at(0.5) == pytest.approx(0.5 * mean)
    for time in (1.0, 1.5, 2.3, 3.7):
        assert at(time) == pytest.approx(mean + np.sin(np.pi * (time - 1.0)) * amplitude)
    for time in (5.0, 5.5, 100.0):  # also long after the last phase
        assert not at(time).any()
    values = np.array([at(time) for time in np.arange(0.0, 5.5, T)])
    assert np.abs(np.diff(values[:, 2])).max() < 1.1 * T * (1.9 * 100.0 + np.pi * 40.0)


class Arm:
    """An interface and the states it is fed with; the robot does not move unless it is told to."""

    def __init__(self, run_of: Callable[..., Run], arm: Robot, sensor: bool = False, **fields: Any) -> None:
        changes = {"force_torque_sensors": [SENSOR]} if sensor else {}
        description = RobotDescription.model_validate(arm.description.model_dump() | changes)
        motors = {
            joint.name: {
                "torque_gain": 1.0 / joint.drive.position_gain,
                "velocity_gain": joint.drive.velocity_gain / joint.drive.position_gain,
            }
            for joint in description.joints
        }
        part = {"motors": motors, "savitzky_golay": {"window": WINDOW}, "start_s": 0.1} | fields
        if sensor:
            part["sensor"] = "wrist"
        phases = [{"name": "p", "mode": "position", "duration_s": 5, "torque_control": True}]
        run = run_of({"position_torque": part, "phases": phases}, description)
        config = run.scenario.controller
        assert config.position_torque is not None
        self.model = RobotModel(run.robot, ("hand", "link7"))
        self.limits = JointLimits(description, config.qp.damper_s)
        qp = AccelerationQp(self.limits, config.qp, None, None)
        self.interface = PositionInterface(run, config.position_torque, self.model, qp, TaskSet("hand", config))
        self.config = config.position_torque
        self.gain = np.array([model.torque_gain for model in config.position_torque.motors.values()])
        self.sequence = 0

    def sense(self, position: Array = POSTURE, cycles: int = 1, wrench: Array | None = None) -> Configuration:
        """Take a state in; the configuration there."""
        self.sequence += cycles
        reading = np.zeros(6) if wrench is None else wrench
        self.state = RobotState(
            sequence=self.sequence,
            time_ns=2_000_000 * self.sequence,
            status=HalStatus.ACTIVE,
            position_measured=tuple(position.tolist()),
            motor_torque_measured=None,
            drive_state=(DriveState.OPERATION_ENABLED,) * 9,
            mode=(ControlMode.POSITION,) * 9,
            error_code=(0,) * 9,
            applied=AppliedCommand(sequence=-1, mode=ControlMode.POSITION, position=tuple(position.tolist())),
            wrenches=(
                WrenchSample(
                    name="wrist",
                    force_in_sensor=tuple(reading[:3].tolist()),
                    torque_in_sensor=tuple(reading[3:].tolist()),
                ),
            ),
        )
        self.interface.sense(self.state, position, cycles)
        return self.model.configure(position, self.interface.velocity())

    def settle(self, **fields: Any) -> Configuration:
        """Fill the window."""
        for _ in range(3 * WINDOW):
            now = self.sense(**fields)
            self.interface.watch(None, now, self.state, 1)
        return self.sense(**fields)

    def start(
        self, target: Array = POSTURE, given: Array = POSTURE, time: PhaseTime | None = None, **fields: Any
    ) -> InterfaceTick:
        now = self.settle(**fields)
        return self.interface.start(given, now, time or phase_time(0.0), targets(target), self.state, 1)

    def step(
        self,
        target: Array = POSTURE,
        cycles: int = 1,
        speed: Array = ZERO,
        time: PhaseTime | None = None,
        **fields: Any,
    ) -> InterfaceTick:
        now = self.sense(cycles=cycles, **fields)
        return self.interface.step(now, time or phase_time(1.0), targets(target), self.state, cycles, speed)


def targets(position: Array) -> Targets:
    return Targets(PostureTarget(position, ZERO, ZERO), None)


@pytest.fixture
def arm_of(run_of: Callable[..., Run], arm: Robot) -> Callable[..., Arm]:
    return lambda **fields: Arm(run_of, arm, **fields)


@pytest.mark.parametrize("desired", ["inverse_dynamics", "qp"])
def test_at_rest_at_the_target_the_offset_carries_gravity(arm_of: Callable[..., Arm], desired: str) -> None:
    """Δq = K_τ g, reached from what position control gave; τ* is g, and no feedback acts."""
    one = arm_of(desired=desired)
    gravity = one.model.configure(POSTURE, ZERO).gravity
    given = POSTURE + 0.8 * one.gain * gravity
    first = one.start(given=given)
    assert np.array_equal(first.command, given)
    for _ in range(60):
        tick = one.step()
    assert tick.command == pytest.approx(POSTURE + one.gain * gravity, abs=1e-8)
    assert tick.torque == pytest.approx(gravity, abs=1e-3)
    assert tick.limited == ()


def test_the_first_commands_leave_what_was_given_without_a_step(arm_of: Callable[..., Arm]) -> None:
    one = arm_of()
    given = POSTURE - 0.004
    commands = [one.start(given=given).command, *(one.step().command for _ in range(60))]
    steps = np.abs(np.diff(commands, axis=0))
    assert np.array_equal(commands[0], given)
    assert steps[0].max() < 2e-6
    assert steps.max() < 1.9 * T / 0.1 * np.abs(commands[-1] - given).max()


def test_a_joint_far_from_its_target_is_led_there_no_faster_than_its_limit(arm_of: Callable[..., Arm]) -> None:
    one = arm_of()
    one.start()
    target = POSTURE.copy()
    target[3] += 0.4
    names, last = set(), one.step(target).command
    for cycles in (1, 1, 1, 3, 1, 2) * 6:
        tick = one.step(target, cycles)
        assert (np.abs(tick.command - last) <= cycles * T * one.limits.speed + 1e-12).all()
        last = tick.command
        names.update(tick.limited)
    assert names == {"joint3: velocity limit", "joint3: offset limit"}


def test_no_command_leaves_the_range(arm_of: Callable[..., Arm]) -> None:
    one = arm_of(start_s=0.002)
    edge = POSTURE.copy()
    edge[3] = 2.5 - 1e-3
    one.start(edge, edge, position=edge)
    beyond = edge.copy()
    beyond[3] = 2.6
    for _ in range(40):
        tick = one.step(beyond, position=edge)
        assert tick.command[3] <= 2.5
    assert tick.command[3] == 2.5
    assert "joint3: position range" in tick.limited


def test_the_offset_is_bounded_by_what_the_drive_can_give(arm_of: Callable[..., Arm]) -> None:
    """However wrong the error: |Δq| ≤ k_τ τ_max + k_v q̇_max, the command lies no further from the robot."""
    one = arm_of(position_gain=50.0)
    one.start()
    target = POSTURE.copy()
    target[0] += 1.0
    for _ in range(300):
        tick = one.step(target)
    drive = one.config.motors["joint0"]
    largest = drive.torque_gain * one.limits.torque[0] + drive.velocity_gain * one.limits.speed[0]
    assert tick.command[0] - POSTURE[0] == pytest.approx(largest, rel=1e-6)
    assert tick.limited == ("joint0: offset limit",)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_that_is_too_fast_ends_torque_control(arm_of: Callable[..., Arm], sign: float) -> None:
    one = arm_of()
    one.start()
    speed = ZERO.copy()
    speed[4] = sign * (SPEED_SHARE * one.limits.speed[4] - 1e-6)
    one.step(speed=speed)
    speed[4] = sign * (SPEED_SHARE * one.limits.speed[4] + 1e-6)
    with pytest.raises(ControllerError, match=r"joint4 moves at -?3.6 rad/s under torque control, its limit is 3"):
        one.step(speed=speed)


@pytest.mark.parametrize(("compensate", "lead_s"), [(True, 2.0 * T), (False, 0.0)])
@pytest.mark.parametrize("predict", [True, False])
def test_commands_lead_a_robot_that_moves_by_the_way_they_have_to_go(
    arm_of: Callable[..., Arm], compensate: bool, lead_s: float, predict: bool
) -> None:
    """Following its reference exactly, all feedback is zero: q + δ q̇ + K_v q̇ + K_τ τ^d, of the present with and
    without prediction as the speed does not change."""
    one, velocity = arm_of(compensate_delay=compensate, predict_velocity=predict), np.linspace(-0.2, 0.3, 9)

    def moving(k: int) -> tuple[Array, Targets]:
        position = POSTURE + T * k * velocity
        return position, Targets(PostureTarget(position, velocity, ZERO), None)

    for k in range(3 * WINDOW):
        position, goal = moving(k)
        now = one.sense(position)
        one.interface.watch(goal.posture, now, one.state, 1)
    position, goal = moving(3 * WINDOW)
    now = one.sense(position)
    one.interface.start(position, now, phase_time(0.0), goal, one.state, 1)
    for k in range(3 * WINDOW + 1, 3 * WINDOW + 80):
        position, goal = moving(k)
        now = one.sense(position)
        tick = one.interface.step(now, phase_time(1.0), goal, one.state, 1, velocity)
    friction = np.array([model.velocity_gain for model in one.config.motors.values()]) * velocity
    torque = one.model.configure(position, velocity).nonlinear
    expected = position + lead_s * velocity + friction + one.gain * torque
    assert tick.command == pytest.approx(expected, abs=1e-7)
    for part in (tick.terms.position, tick.terms.velocity, tick.terms.acceleration):
        assert np.abs(part).max() < 1e-7


def test_prediction_gives_the_friction_of_the_present(arm_of: Callable[..., Arm]) -> None:
    """A joint that follows a changing velocity: late by the window without, right with."""
    reached = {}
    for predict in (False, True):
        one, rate = arm_of(predict_velocity=predict), np.full(9, 2.0)
        for k in range(6 * WINDOW):
            time = T * k
            position, velocity = POSTURE + 0.5 * rate * time**2, rate * time
            goal = Targets(PostureTarget(position, velocity, rate), None)
            now = one.sense(position)
            if k < 3 * WINDOW:
                one.interface.watch(goal.posture, now, one.state, 1)
            elif k == 3 * WINDOW:
                one.interface.start(position, now, phase_time(0.0), goal, one.state, 1)
            else:
                tick = one.interface.step(now, phase_time(1.0), goal, one.state, 1, velocity)
        gain = np.array([model.velocity_gain for model in one.config.motors.values()])
        reached[predict] = tick.terms.friction / gain - velocity
    assert reached[True] == pytest.approx(ZERO, abs=1e-6)
    assert reached[False] == pytest.approx(-2.0 * one.interface.delay_s, abs=1e-6)


def test_the_wrench_is_moved_from_the_sensor_to_the_hand(arm_of: Callable[..., Arm]) -> None:
    """A pure force at the hand's origin, read by a sensor two links before it."""
    one = arm_of(sensor=True)
    one.start()
    now = one.model.configure(POSTURE, ZERO)
    unloaded = one.step().wrench  # the reading is zero: what is carried hangs by itself
    sensor, hand = now.frames["link7"], now.frames["hand"]
    force = np.array([3.0, -8.0, 5.0])
    at_sensor = np.concatenate((force, np.cross(hand.position - sensor.position, force)))
    in_sensor = np.concatenate((sensor.rotation.T @ at_sensor[:3], sensor.rotation.T @ at_sensor[3:]))
    for _ in range(3 * WINDOW):
        tick = one.step(wrench=-in_sensor)
    assert unloaded is not None
    assert tick.wrench is not None
    assert tick.wrench - unloaded == pytest.approx([*force, 0.0, 0.0, 0.0], abs=1e-9)


def test_a_wanted_wrench_is_given_in_advance_and_its_error_fed_back(arm_of: Callable[..., Arm]) -> None:
    one = arm_of(sensor=True, position_gain=0.0)
    one.start()
    base = one.step()
    time = phase_time(2.0, wrench={"mean": [0, 0, 20, 0, 0, 0], "ramp_s": 0.2})
    for _ in range(round(1.0 / T)):  # also one entered late rises from nothing
        tick = one.step(time=time)
    jacobian = one.model.configure(POSTURE, ZERO).frames["hand"].jacobian
    wanted = np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    assert np.array_equal(tick.wrench_reference, wanted)
    assert tick.terms.torque - base.terms.torque == pytest.approx(-one.gain * (wanted @ jacobian), abs=1e-12)
    assert tick.wrench is not None
    k_p, k_f = one.config.torque_gain, one.config.force_gain
    expected = -one.gain * (k_p * (1.0 + k_f) + k_f) * ((wanted - tick.wrench) @ jacobian)
    assert tick.terms.force == pytest.approx(expected, abs=1e-12)


def test_a_wrench_entered_late_comes_along_its_ramp(arm_of: Callable[..., Arm]) -> None:
    """As after a hold in the middle of its phase: nothing at the start, no step later."""
    one = arm_of(sensor=True)
    time = phase_time(2.0, wrench={"mean": [0, 0, 50, 0, 0, 0], "amplitude": [0, 0, 20, 0, 0, 0], "ramp_s": 0.4})
    wanted = [one.start(time=time).wrench_reference[2]]
    wanted += [one.step(time=time).wrench_reference[2] for _ in range(400)]
    assert wanted[0] == 0.0
    assert wanted[200] == pytest.approx(50.0, abs=0.5)
    assert np.abs(np.diff(wanted)).max() < 1.1 * T * (1.9 * 50.0 / 0.4 + 2.0 * np.pi * 0.5 * 20.0)


def test_the_largest_offset_is_what_a_drive_at_its_limits_can_use(arm: Robot) -> None:
    """The firmware's law τ = D(k_p Δq − k_d q̇) is at its limit there."""
    for joint, largest in zip(arm.description.joints, largest_offset(arm.description).tolist(), strict=True):
        drive = joint.drive
        effort = drive.position_gain * largest - drive.velocity_gain * joint.velocity_limit
        assert effort - drive.dead_zone == pytest.approx(joint.torque_limit)


def test_started_again_nothing_of_the_last_time_is_left(arm_of: Callable[..., Arm]) -> None:
    """Integral, fade and rate limit are those of the new start."""
    one, fresh = arm_of(torque_integral=1.0), arm_of(torque_integral=1.0)
    one.start(POSTURE + 0.01)
    for _ in range(50):
        one.step(POSTURE + 0.01)
    again = one.start(given=POSTURE + 0.2)
    first = fresh.start(given=POSTURE + 0.2)
    for _ in range(5):
        assert again.command == pytest.approx(first.command, abs=1e-12)
        assert again.terms.integral == pytest.approx(first.terms.integral, abs=1e-15)
        again, first = one.step(), fresh.step()


def test_a_tick_is_a_value(arm_of: Callable[..., Arm]) -> None:
    """What was handed out is not written to by the next tick."""
    one = arm_of()
    one.start()
    tick = one.step()
    before = replace(tick, command=tick.command.copy(), torque_desired=tick.torque_desired.copy())
    one.step(POSTURE + 0.01)
    assert np.array_equal(tick.command, before.command)
    assert np.array_equal(tick.torque_desired, before.torque_desired)
