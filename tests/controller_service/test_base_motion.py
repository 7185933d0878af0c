"""The base's motion from an IMU: against Pinocchio's floating base, finite differences, and the constant mount."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from controller_service.base_motion import BaseMotion, ImuKinematics, floating_model
from controller_service.model import Array, RobotModel
from schemas.errors import ConfigurationError
from schemas.load import Robot

GRAVITY = np.array([0.0, 0.0, -9.81])
STEP = 1e-4


def with_imus(arm: Robot) -> Robot:
    """Mount IMUs off the axes, turned, on the base and on a link in the middle of the arm."""
    mounts = "".join(
        f'<link name="{name}"/><joint name="{name}_mount" type="fixed"><parent link="{link}"/><child link="{name}"/>'
        '<origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.7 1.1"/></joint>'
        for name, link in (("fixed_imu", "base"), ("moving_imu", "link5"))
    )
    return Robot(arm.description, arm.urdf.replace("</robot>", mounts + "</robot>"))


@pytest.fixture(scope="module")
def rigid(arm: Robot) -> RobotModel:
    return RobotModel(with_imus(arm))


class Floating:
    """The arm on a free flyer at any pose and motion; the joints in the URDF's order."""

    def __init__(self, model: pin.Model, seed: int) -> None:
        free = pin.Model()
        free.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "flyer")
        base = pin.Frame("carrier", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
        self.model = pin.appendModel(free, model, free.addFrame(base), pin.SE3.Identity())
        self.data = self.model.createData()
        rng = np.random.default_rng(seed)
        self.q = np.concatenate(
            (rng.normal(size=3), pin.Quaternion(pin.exp3(rng.normal(size=3))).coeffs(), np.zeros(9))
        )
        self.q[7:] = rng.uniform(-1.5, 1.5, 9)
        self.v, self.a = rng.normal(size=15), 3.0 * rng.normal(size=15)

    def at(self, time: float) -> tuple[Array, Array]:
        """Motion along which v̇ is constant, exact to second order at time 0."""
        return pin.integrate(self.model, self.q, time * self.v + 0.5 * time**2 * self.a), self.v + time * self.a

    def imu(self, name: str) -> tuple[Array, Array, Array]:
        """Give ω, ω̇, a − g in the frame's axes, by Pinocchio in the world."""
        pin.forwardKinematics(self.model, self.data, self.q, self.v, self.a)
        index = self.model.getFrameId(name)
        turn = pin.updateFramePlacement(self.model, self.data, index).rotation
        velocity = pin.getFrameVelocity(self.model, self.data, index, pin.LOCAL)
        rate = pin.getFrameClassicalAcceleration(self.model, self.data, index, pin.LOCAL)
        return velocity.angular.copy(), rate.angular.copy(), rate.linear - turn.T @ GRAVITY

    def pose(self, name: str, time: float) -> pin.SE3:
        pin.framesForwardKinematics(self.model, self.data, self.at(time)[0])
        return self.data.oMf[self.model.getFrameId(name)].copy()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("frame", ["fixed_imu", "moving_imu", "base", "hand"])
def test_the_base_s_motion_is_recovered_from_an_imu_on_any_link(rigid: RobotModel, frame: str, seed: int) -> None:
    floating = Floating(rigid.model, seed)
    imu = ImuKinematics(rigid.model, frame, rigid.names)
    assert imu.constant == (frame in {"fixed_imu", "base"})
    q, v, a = floating.q[7:], floating.v[6:], floating.a[6:]
    motion = imu.base_motion(q, v, a, *floating.imu(frame))
    turn = pin.Quaternion(floating.q[3:7]).matrix()
    # The free flyer's spatial acceleration is not that of its origin: ω × v is missing
    spin, speed = floating.v[3:6], floating.v[:3]
    assert np.allclose(motion.angular_velocity, spin, atol=1e-12)
    assert np.allclose(motion.angular_acceleration, floating.a[3:6], atol=1e-10)
    assert np.allclose(motion.acceleration, floating.a[:3] + np.cross(spin, speed) - turn.T @ GRAVITY, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_the_base_s_motion_agrees_with_finite_differences_of_poses(rigid: RobotModel, seed: int) -> None:
    """Readings and result are both from differences of poses in the world: no formula of rigid bodies is shared."""
    floating = Floating(rigid.model, seed)
    seen: dict[str, tuple[Array, Array, Array]] = {}
    for name in ("base", "moving_imu"):
        before, now, after = (floating.pose(name, t) for t in (-STEP, 0.0, STEP))
        lead, lag = (pin.log3(now.rotation.T @ pose.rotation) for pose in (after, before))
        linear = (after.translation - 2.0 * now.translation + before.translation) / STEP**2 - GRAVITY
        seen[name] = ((lead - lag) / (2.0 * STEP), (lead + lag) / STEP**2, now.rotation.T @ linear)
    imu = ImuKinematics(rigid.model, "moving_imu", rigid.names)
    motion = imu.base_motion(floating.q[7:], floating.v[6:], floating.a[6:], *seen["moving_imu"])
    for got, expected in zip(
        (motion.angular_velocity, motion.angular_acceleration, motion.acceleration), seen["base"], strict=True
    ):
        assert np.allclose(got, expected, atol=2e-5 * max(1.0, np.abs(expected).max()))


def test_the_order_of_the_joints_is_the_caller_s(rigid: RobotModel) -> None:
    floating, order = Floating(rigid.model, 0), [4, 0, 8, 2, 6, 1, 3, 7, 5]
    q, v, a = floating.q[7:], floating.v[6:], floating.a[6:]
    one = ImuKinematics(rigid.model, "moving_imu").base_motion(q, v, a, *floating.imu("moving_imu"))
    shuffled = ImuKinematics(rigid.model, "moving_imu", [rigid.names[i] for i in order])
    other = shuffled.base_motion(q[order], v[order], a[order], *floating.imu("moving_imu"))
    assert np.array_equal(one.acceleration, other.acceleration)
    assert np.array_equal(one.angular_velocity, other.angular_velocity)


def test_a_still_imu_reads_a_base_at_rest_and_neglected_is_zero(rigid: RobotModel) -> None:
    zero, imu = np.zeros(9), ImuKinematics(rigid.model, "fixed_imu")
    turn = rigid.pose(zero, "fixed_imu")[1]
    rest = BaseMotion.at_rest((0.0, 0.0, -9.81))
    motion = imu.base_motion(zero, zero, zero, np.zeros(3), None, turn.T @ rest.acceleration)
    assert np.allclose(motion.acceleration, rest.acceleration, atol=1e-14)
    assert not motion.angular_velocity.any()
    assert not rest.angular_velocity.any()
    assert not rest.angular_acceleration.any()
    spin, force = np.array([0.3, -0.4, 0.9]), np.array([1.0, 2.0, 3.0])
    neglected = imu.base_motion(zero, zero, zero, spin, None, force)
    given = imu.base_motion(zero, zero, zero, spin, np.zeros(3), force)
    assert np.array_equal(neglected.acceleration, given.acceleration)
    moving = imu.base_motion(zero, zero, zero, spin, np.ones(3), force)
    assert np.abs(moving.acceleration - given.acceleration).max() > 0.1


def test_a_motion_is_read_only_and_outlives_the_next(rigid: RobotModel) -> None:
    for frame in ("fixed_imu", "moving_imu"):
        floating, other = Floating(rigid.model, 0), Floating(rigid.model, 1)
        imu = ImuKinematics(rigid.model, frame)
        motion = imu.base_motion(floating.q[7:], floating.v[6:], floating.a[6:], *floating.imu(frame))
        kept = motion.acceleration.copy()
        imu.base_motion(other.q[7:], other.v[6:], other.a[6:], *other.imu(frame))
        assert np.array_equal(motion.acceleration, kept)
        with pytest.raises(ValueError, match="read-only"):
            motion.acceleration[0] = 0.0


def test_what_does_not_fit_is_refused(rigid: RobotModel, arm: Robot) -> None:
    with pytest.raises(ConfigurationError, match="'nose'"):
        ImuKinematics(rigid.model, "nose")
    with pytest.raises(ConfigurationError, match="give each of these joints once"):
        ImuKinematics(rigid.model, "hand", rigid.names[:8])
    with pytest.raises(ConfigurationError, match="'nose' the URDF has not"):
        floating_model(arm, ("nose",))
    with pytest.raises(ConfigurationError, match="'base' is the root"):
        floating_model(arm, ("base",))


def test_a_cut_splits_a_link_off_and_changes_nothing_else(arm: Robot) -> None:
    """What passes the hand's fixed mount at rest is the finger's weight; the driven joint's own link needs no cut."""
    robot = with_imus(arm)
    whole, _, root = floating_model(robot)
    cut, joints, _ = floating_model(robot, ("hand", "link3"))
    assert root == "base"
    assert (whole.nv, cut.nv) == (15, 16)
    assert cut.names[joints["link3"]] == "joint3"
    data, q, v = cut.createData(), pin.neutral(cut), np.zeros(16)
    rows = pin.rnea(cut, data, q, v, v)
    assert data.f[joints["hand"]].linear == pytest.approx(-0.1 * GRAVITY)
    expected = pin.rnea(whole, whole.createData(), pin.neutral(whole), np.zeros(15), np.zeros(15))
    kept = [i for i in range(16) if i != cut.joints[joints["hand"]].idx_v]
    assert rows[kept] == pytest.approx(expected, abs=1e-12)
