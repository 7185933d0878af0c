"""The hand's wrench from the sensor: Newton and Euler against Pinocchio's own, filter, noise, readings that fail."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from controller_service.errors import StateError
from controller_service.model import Array, Configuration, RobotModel
from controller_service.wrench import LONGEST_HOLD, HandWrenchEstimator
from schemas.control_law import HandForce
from schemas.errors import ConfigurationError
from schemas.load import Robot
from schemas.messages import WrenchSample

PERIOD = 0.002
SHARP = 1e6
"""Cutoff [Hz] at which the filter passes everything."""
SENSOR = {"name": "wrist", "frame": "cell", "bus": "b2", "can_id": 0x1C0, "command_id": 0x1C8}
PUSH = np.array([11.0, -7.0, 23.0, 0.8, -0.5, 0.3])


def with_sensor(arm: Robot, frame: str = "cell", hand: str | None = "hand") -> Robot:
    """Put between the last link and the hand a sensor turned against both, and a tool behind the hand and its finger.

    The finger's continuous joint is in no description: it is locked, and the tool behind it fixed.
    """
    urdf = arm.urdf.replace(
        '<parent link="link8"/><child link="hand"/><origin xyz="0 0 -0.12"/>',
        '<parent link="cell"/><child link="hand"/><origin xyz="0.01 0.02 -0.12" rpy="0.4 -0.3 0.2"/>',
    )
    tail = (
        '<link name="cell"><inertial><origin xyz="0 0 -0.02"/><mass value="0.2"/><inertia ixx="2e-4" iyy="2e-4"'
        ' izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="cell_mount" type="fixed"><parent'
        ' link="link8"/><child link="cell"/><origin xyz="0 0 -0.05" rpy="-0.7 0.5 1.1"/></joint>'
        '<link name="tool"><inertial><origin xyz="0.05 0.03 -0.1" rpy="0.2 0.4 0.6"/><mass value="0.7"/><inertia'
        ' ixx="4e-3" iyy="3e-3" izz="1e-3" ixy="4e-4" ixz="0" iyz="0"/></inertial></link><joint name="tool_mount"'
        ' type="fixed"><parent link="finger"/><child link="tool"/><origin xyz="0 0.1 -0.05" rpy="0 0.3 0"/></joint>'
    )
    changes: dict[str, Any] = {"force_torque_sensors": [SENSOR | {"frame": frame}], "hand_frame": hand}
    description = type(arm.description).model_validate(arm.description.model_dump() | changes)
    return Robot(description, urdf.replace("</robot>", tail + "</robot>"))


@pytest.fixture(scope="module")
def robot(arm: Robot) -> Robot:
    return with_sensor(arm)


@pytest.fixture(scope="module")
def rigid(robot: Robot) -> RobotModel:
    return RobotModel(robot, ("hand",))


class TrueSensor:
    """What the sensor reads: its mount made a tenth joint, whose force RNEA then knows; its motion is zero."""

    def __init__(self, robot: Robot) -> None:
        urdf = robot.urdf.replace(
            'name="cell_mount" type="fixed">',
            'name="cell_mount" type="revolute"><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1"'
            ' velocity="1"/>',
        )
        model = pin.buildModelFromXML(urdf)
        self.model = pin.buildReducedModel(model, [model.getJointId("a_finger")], pin.neutral(model))
        self.joint = self.model.getJointId("cell_mount")
        names = (*robot.description.joint_names, "cell_mount")
        self.order = [self.model.joints[self.model.getJointId(name)].idx_v for name in names]
        # RobotModel reads the continuous joint as a revolute one, Pinocchio's own model as a point of the unit circle
        self.circle = next(i for i, joint in enumerate(self.model.joints) if joint.nq == 2)
        self.data = self.model.createData()

    def read(self, position: Array, velocity: Array, acceleration: Array, push: Array | None = None) -> WrenchSample:
        """Read at a motion of the nine joints; `push`: environment on the hand, world axes, at the hand's origin."""
        v, a, angle = np.zeros(10), np.zeros(10), np.zeros(10)
        v[self.order[:9]], a[self.order[:9]], angle[self.order[:9]] = velocity, acceleration, position
        q = np.concatenate(
            [
                [math.cos(angle[joint.idx_v]), math.sin(angle[joint.idx_v])]
                if index == self.circle
                else [angle[joint.idx_v]]
                for index, joint in enumerate(self.model.joints)
                if index > 0
            ]
        )
        external = [pin.Force.Zero() for _ in self.model.joints]
        if push is not None:
            pin.framesForwardKinematics(self.model, self.data, q)
            hand = self.data.oMf[self.model.getFrameId("hand")].translation
            at_hand = pin.SE3(np.eye(3), hand).act(pin.Force(push))
            external[self.joint] = self.data.oMi[self.joint].actInv(at_hand)
        pin.rnea(self.model, self.data, q, v, a, external)
        fx, fy, fz, nx, ny, nz = self.data.f[self.joint].vector.tolist()
        return WrenchSample(name="wrist", force_in_sensor=(fx, fy, fz), torque_in_sensor=(nx, ny, nz))


@pytest.fixture(scope="module")
def truth(robot: Robot) -> TrueSensor:
    return TrueSensor(robot)


def motion(seed: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, 9), rng.normal(size=9), 5.0 * rng.normal(size=9)


def at_rest(rigid: RobotModel) -> Configuration:
    return rigid.configure(motion(0)[0], np.zeros(9))


@pytest.mark.parametrize("seed", range(6))
def test_the_environments_wrench_is_recovered_in_any_motion(
    robot: Robot, rigid: RobotModel, truth: TrueSensor, seed: int
) -> None:
    q, v, a = motion(seed)
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist"))
    now = rigid.configure(q, v)
    felt = estimator.update(truth.read(q, v, a, PUSH), now, acceleration=a)
    assert felt.wrench == pytest.approx(PUSH, abs=1e-9)
    assert felt.force_norm == pytest.approx(np.linalg.norm(PUSH[:3]))
    # Each term is needed: without q̈ the inertia of the tool shows as a force
    blind = HandWrenchEstimator(robot, HandForce(sensor="wrist")).update(truth.read(q, v, a, PUSH), now)
    assert np.abs(blind.wrench - PUSH)[:3].max() > 0.5


@pytest.mark.parametrize("seed", range(6))
def test_weight_alone_is_no_force_of_the_environment(
    robot: Robot, rigid: RobotModel, truth: TrueSensor, seed: int
) -> None:
    q, zero = motion(seed)[0], np.zeros(9)
    sample = truth.read(q, zero, zero)
    assert np.linalg.norm(sample.force_in_sensor) == pytest.approx((0.2 + 0.1 + 0.7) * 9.81)
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist"))
    assert estimator.update(sample, rigid.configure(q, zero)).wrench == pytest.approx(np.zeros(6), abs=1e-9)


def test_the_difference_of_the_velocity_stands_for_an_acceleration_that_is_not_given(
    robot: Robot, rigid: RobotModel, truth: TrueSensor
) -> None:
    q, v, a = motion(3)
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=SHARP))
    estimator.update(None, rigid.configure(q, v - PERIOD * a))
    sample, now = truth.read(q, v, a, PUSH), rigid.configure(q, v)
    assert estimator.update(sample, now).wrench == pytest.approx(PUSH, abs=1e-9)
    # Three cycles between two states: the difference is over their time
    estimator.update(None, rigid.configure(q, v - 3 * PERIOD * a))
    assert estimator.update(sample, now, 3).wrench == pytest.approx(PUSH, abs=1e-9)
    # A start takes no difference to what was before
    drift_only = HandWrenchEstimator(robot, HandForce(sensor="wrist")).update(sample, now)
    estimator.update(None, rigid.configure(q, v + 1.0))
    estimator.restart()
    assert np.array_equal(estimator.update(sample, now).wrench, drift_only.wrench)


def test_noise_of_the_velocity_is_amplified_as_stated(robot: Robot, rigid: RobotModel, truth: TrueSensor) -> None:
    """σ of q̈ is (1 − α)/T √(2/(1 + α)) σ of q̇; the tool's inertia and the Jacobian make a wrench of it."""
    q, zero, sigma, cutoff = motion(1)[0], np.zeros(9), 1e-3, 20.0
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=cutoff))
    sample, rng = truth.read(q, zero, zero), np.random.default_rng(11)
    states = (rigid.configure(q, sigma * rng.normal(size=9)) for _ in range(4000))
    rows = [estimator.update(sample, now).wrench for now in states]
    pole = math.exp(-2 * math.pi * cutoff * PERIOD)
    gain = (1 - pole) / PERIOD * math.sqrt(2 / (1 + pole))
    frame = rigid.configure(q, zero).frames["hand"]
    turn = np.kron(np.eye(2), frame.rotation)
    expected = gain * sigma * np.linalg.norm(turn @ estimator.inertia.matrix() @ turn.T @ frame.jacobian, axis=1)
    assert np.std(rows[100:], axis=0) == pytest.approx(expected, rel=0.08)


def test_a_step_passes_the_exact_pole_and_the_rate_is_its_finite_difference(
    robot: Robot, rigid: RobotModel, truth: TrueSensor
) -> None:
    now, zero, cutoff = at_rest(rigid), np.zeros(9), 20.0
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=cutoff))
    quiet, pushed = (truth.read(now.position, zero, zero, push) for push in (None, PUSH))
    first = estimator.update(quiet, now)
    assert np.array_equal(first.rate, np.zeros(6))
    last = first.wrench
    for k in range(1, 40):
        felt = estimator.update(pushed, now)
        assert felt.wrench == pytest.approx(PUSH * (1 - math.exp(-2 * math.pi * cutoff * k * PERIOD)), abs=1e-9)
        assert felt.rate == pytest.approx((felt.wrench - last) / PERIOD, rel=1e-9, abs=1e-6)
        assert felt.age_cycles == 0
        last = felt.wrench


def test_the_filter_starts_at_the_first_reading_of_each_start(
    robot: Robot, rigid: RobotModel, truth: TrueSensor
) -> None:
    now, zero = at_rest(rigid), np.zeros(9)
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=0.1))
    for push in (PUSH, -PUSH):
        estimator.restart()
        felt = estimator.update(truth.read(now.position, zero, zero, push), now)
        assert felt.wrench == pytest.approx(push, abs=1e-9)
        assert np.array_equal(felt.rate, np.zeros(6))


@pytest.mark.parametrize("kind", ["absent", "stale"])
def test_a_missing_reading_is_bridged_for_a_few_cycles_and_then_an_error(
    robot: Robot, rigid: RobotModel, truth: TrueSensor, kind: str
) -> None:
    now, zero, cutoff = at_rest(rigid), np.zeros(9), 20.0
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=cutoff))
    quiet, pushed = (truth.read(now.position, zero, zero, push) for push in (None, PUSH))
    # A stale sample's content must not matter
    late = None if kind == "absent" else pushed.model_copy(update={"age_cycles": 1})
    estimator.update(quiet, now)
    held = estimator.update(pushed, now)
    for age in range(1, LONGEST_HOLD + 1):
        felt = estimator.update(late, now)
        assert felt.age_cycles == age
        assert np.array_equal(felt.wrench, held.wrench)
        assert np.array_equal(felt.rate, np.zeros(6))
    # The next reading counts for the whole time since the last
    elapsed = (LONGEST_HOLD + 1) * PERIOD
    felt = estimator.update(pushed, now)
    assert felt.age_cycles == 0
    assert felt.wrench == pytest.approx(PUSH * (1 - math.exp(-2 * math.pi * cutoff * (PERIOD + elapsed))), abs=1e-9)
    assert felt.rate == pytest.approx((felt.wrench - held.wrench) / elapsed, rel=1e-9)
    for _ in range(LONGEST_HOLD):
        estimator.update(late, now)
    with pytest.raises(StateError, match=f"sensor wrist: no new reading for {LONGEST_HOLD + 1} cycles"):
        estimator.update(late, now)


def test_states_that_were_left_out_count(robot: Robot, rigid: RobotModel, truth: TrueSensor) -> None:
    now, zero, cutoff = at_rest(rigid), np.zeros(9), 20.0
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist", cutoff_hz=cutoff))
    estimator.update(truth.read(now.position, zero, zero), now)
    felt = estimator.update(truth.read(now.position, zero, zero, PUSH), now, 3)
    assert felt.wrench == pytest.approx(PUSH * (1 - math.exp(-2 * math.pi * cutoff * 3 * PERIOD)), abs=1e-9)
    assert felt.rate == pytest.approx(felt.wrench / (3 * PERIOD), abs=1e-6)
    assert estimator.update(None, now, 4).age_cycles == 4
    with pytest.raises(StateError, match="no new reading for 7 cycles"):
        estimator.update(None, now, 3)


def test_a_sensor_that_never_speaks_is_an_error_after_as_many_cycles(robot: Robot, rigid: RobotModel) -> None:
    now = at_rest(rigid)
    estimator = HandWrenchEstimator(robot, HandForce(sensor="wrist"))
    for age in range(1, LONGEST_HOLD + 1):
        felt = estimator.update(None, now)
        assert felt.age_cycles == age
        assert felt.force_norm == 0.0
    with pytest.raises(StateError, match="wrist"):
        estimator.update(None, now)


def test_a_bad_configuration_is_refused(arm: Robot) -> None:
    config = HandForce(sensor="wrist")
    with pytest.raises(ConfigurationError, match="no force/torque sensor 'ankle'; it has wrist"):
        HandWrenchEstimator(with_sensor(arm), HandForce(sensor="ankle"))
    with pytest.raises(ConfigurationError, match="no force/torque sensor 'wrist'; it has none"):
        HandWrenchEstimator(arm, config)
    with pytest.raises(ConfigurationError, match="no hand_frame"):
        HandWrenchEstimator(with_sensor(arm, hand=None), config)
    with pytest.raises(ConfigurationError, match="'hand' does not lie beyond sensor 'wrist'"):
        HandWrenchEstimator(with_sensor(arm, frame="finger"), config)
    with pytest.raises(ConfigurationError, match="no link 'nowhere'"):
        HandWrenchEstimator(with_sensor(arm, frame="nowhere"), config)
    with pytest.raises(ConfigurationError, match="'joint7' moves beyond sensor 'wrist'"):
        HandWrenchEstimator(with_sensor(arm, frame="link6"), config)


def test_the_sensor_may_sit_at_the_hand_or_on_a_driven_link(arm: Robot) -> None:
    masses = {"hand": 0.1 + 0.7, "cell": 1.0, "link8": 1.2 + 1.0}
    for frame, mass in masses.items():
        inertia = HandWrenchEstimator(with_sensor(arm, frame=frame), HandForce(sensor="wrist")).inertia
        assert inertia.mass == pytest.approx(mass)
