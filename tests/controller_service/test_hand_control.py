"""The hand's force control over a run: Fʳ one tick late, the switch of dual compliance on a sensor's readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from controller_service.dual_compliance import Compliance
from controller_service.errors import StateError
from controller_service.hand_control import ALWAYS, HandControl
from controller_service.model import Array, Configuration, RobotModel
from controller_service.wrench import LONGEST_HOLD
from schemas.base import ControlMode
from schemas.control_law import HandForce
from schemas.errors import ConfigurationError
from schemas.load import Robot
from schemas.messages import AppliedCommand, DriveState, HalStatus, RobotState, WrenchSample
from tests.controller_service.test_wrench import TrueSensor, with_sensor

PERIOD = 0.002
POSE = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
STILL = np.zeros(9)


@pytest.fixture(scope="module")
def robot(arm: Robot) -> Robot:
    return with_sensor(arm)


@pytest.fixture(scope="module")
def sensor(robot: Robot) -> TrueSensor:
    return TrueSensor(robot)


@pytest.fixture(scope="module")
def now(robot: Robot) -> Configuration:
    return RobotModel(robot, ("hand",)).configure(POSE, STILL)


def control(robot: Robot, **config: Any) -> HandControl:
    return HandControl(robot, HandForce.model_validate({"sensor": "wrist"} | config))


def state(*wrenches: WrenchSample) -> RobotState:
    return RobotState(
        sequence=0,
        time_ns=0,
        status=HalStatus.ACTIVE,
        position_measured=tuple(POSE.tolist()),
        motor_torque_measured=None,
        drive_state=(DriveState.OPERATION_ENABLED,) * 9,
        mode=(ControlMode.TORQUE,) * 9,
        error_code=(0,) * 9,
        applied=AppliedCommand(sequence=-1, mode=ControlMode.TORQUE),
        wrenches=wrenches,
    )


def pushed(sensor: TrueSensor, newton: float) -> RobotState:
    push: Array = np.array([0.6 * newton, 0.0, -0.8 * newton, 0.1, 0.0, 0.0])
    return state(sensor.read(POSE, STILL, STILL, push))


def test_the_reference_is_the_wrench_that_the_qp_found_a_tick_before(
    robot: Robot, sensor: TrueSensor, now: Configuration
) -> None:
    """Fʳ = 0 at first; Ḟʳ by finite difference over the time that passed."""
    hand, found = control(robot, wrench_task={}), np.random.default_rng(84).normal(size=(3, 6))
    references = []
    for wrench, elapsed in zip(found, (PERIOD, PERIOD, 3 * PERIOD), strict=True):
        references.append(hand.update(now, pushed(sensor, 5.0), elapsed).reference)
        hand.remember(wrench, elapsed)
    references.append(hand.update(now, pushed(sensor, 5.0), PERIOD).reference)
    assert not references[0].wrench.any()
    assert not references[0].rate.any()
    before = np.zeros(6)
    for reference, wrench, elapsed in zip(references[1:], found, (PERIOD, PERIOD, 3 * PERIOD), strict=True):
        assert np.array_equal(reference.wrench, wrench)
        assert np.allclose(reference.rate, (wrench - before) / elapsed)
        before = wrench
    hand.start()
    assert not hand.update(now, pushed(sensor, 5.0), PERIOD).reference.wrench.any()


def test_without_a_wrench_task_the_reference_stays_zero_and_the_qp_gets_no_variables(
    robot: Robot, sensor: TrueSensor, now: Configuration
) -> None:
    hand = control(robot)
    assert hand.variables is None
    hand.remember(None, PERIOD)
    assert not hand.update(now, pushed(sensor, 5.0), PERIOD).reference.wrench.any()
    asked = control(robot, wrench_task={"force_in_world": [1.0, 2.0, 3.0]}).variables
    assert asked is not None
    assert (asked.frame, asked.n) == ("hand", 9)
    assert np.array_equal(asked.desired, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    with pytest.raises(ConfigurationError, match="force_limit"):
        control(robot, wrench_task={"force_in_world": [500.0, 0.0, 0.0]})


def test_without_dual_compliance_the_hand_always_gives_way(
    robot: Robot, sensor: TrueSensor, now: Configuration
) -> None:
    hand = control(robot)
    for newton in (0.0, 50.0, 0.0):
        assert hand.update(now, pushed(sensor, newton), PERIOD).compliance == ALWAYS


def test_a_push_switches_the_admittance_on_and_letting_go_switches_it_off(
    robot: Robot, sensor: TrueSensor, now: Configuration
) -> None:
    """The force is the filtered one: 20 N pass 15 N after ln 4 of the filter's time constant, and fall below 6 N."""
    dual = {"force_on": 15.0, "force_off": 6.0, "dwell_s": 0.05}
    hand = control(robot, cutoff_hz=20.0, dual_compliance=dual)
    told: list[tuple[float, Compliance]] = []
    for tick in range(200):
        newton = 20.0 if 10 <= tick < 100 else 0.0
        forces = hand.update(now, pushed(sensor, newton), PERIOD)
        told.append((forces.measured.force_norm, forces.compliance))
    norms = np.array([norm for norm, _ in told])
    assert norms[9] < 1e-6
    assert norms[99] == pytest.approx(20.0, rel=1e-3)
    engaged = [tick for tick, (_, compliance) in enumerate(told) if compliance.engaged]
    released = [tick for tick, (_, compliance) in enumerate(told) if compliance.released]
    constant = 1.0 / (2.0 * np.pi * 20.0)
    assert engaged == [int(np.argmax(norms > 15.0))]
    assert engaged[0] == pytest.approx(9 + np.log(4.0) * constant / PERIOD, abs=1.5)
    below = 100 + int(np.argmax(norms[100:] < 6.0))
    assert released == [below + 25]
    assert [compliance.active for _, compliance in told] == [engaged[0] <= tick < released[0] for tick in range(200)]


def test_a_new_start_switches_off_without_a_release(robot: Robot, sensor: TrueSensor, now: Configuration) -> None:
    hand = control(robot, cutoff_hz=1e4, dual_compliance={})
    assert hand.update(now, pushed(sensor, 30.0), PERIOD).compliance.engaged
    hand.start()
    first = hand.update(now, pushed(sensor, 0.0), PERIOD)
    assert first.compliance == Compliance(active=False, engaged=False, released=False)
    assert first.measured.force_norm < 1e-6


def test_a_silent_sensor_is_bridged_for_some_cycles_and_then_refused(
    robot: Robot, sensor: TrueSensor, now: Configuration
) -> None:
    """Cycles are counted by the time that passed, so lost states count as well."""
    hand = control(robot, cutoff_hz=1e4)
    hand.update(now, pushed(sensor, 10.0), PERIOD)
    for tick in range(LONGEST_HOLD):
        held = hand.update(now, state(), PERIOD).measured
        assert held.force_norm == pytest.approx(10.0)
        assert held.age_cycles == tick + 1
    with pytest.raises(StateError, match="wrist: no new reading for 6 cycles"):
        hand.update(now, state(), PERIOD)
    hand.update(now, pushed(sensor, 10.0), PERIOD)
    with pytest.raises(StateError, match="wrist"):
        hand.update(now, state(), (LONGEST_HOLD + 1) * PERIOD)
