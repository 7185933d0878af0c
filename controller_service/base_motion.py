"""The base's motion from an inertial unit on any of the robot's links, and the model of a robot whose base moves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from controller_service.model import Array, frozen, make_revolute, read_urdf
from schemas.errors import ConfigurationError
from schemas.load import Robot


@dataclass(frozen=True, slots=True)
class BaseMotion:
    """Motion of the base, the URDF's root link, as far as joint torques depend on it: pose and velocity do not count.

    All in base axes, at the base link's origin.
    """

    angular_velocity: Array
    """ω (3,) [rad/s]."""
    angular_acceleration: Array
    """ω̇ (3,) [rad/s²]."""
    acceleration: Array
    """Proper acceleration a − g (3,) [m/s²], what an accelerometer there would read."""

    @classmethod
    def at_rest(cls, gravity_in_base: Sequence[float] | Array) -> BaseMotion:
        """Give the motion of a fixed base without IMU: a − g = −g, the rest zero.

        Args:
            gravity_in_base: g (3,) [m/s²]; a fixed root link has the world's axes, so it is the description's
                `gravity_in_world`.

        """
        zero = np.zeros(3)
        zero.setflags(write=False)
        acceleration = frozen(-np.asarray(gravity_in_base, dtype=np.float64))
        return cls(zero, zero, acceleration)


class ImuKinematics:
    """IMU_TO_TORSO_KIN and TORSO_TO_BASE_KIN of algorithm 1, [Del Prete 2016].

    With R from IMU to base and p, v, a, ω_r, ω̇_r of the IMU against the base (forward kinematics, base at rest):

        ω_b = R ω − ω_r
        ω̇_b = R ω̇ − ω̇_r − ω_b × ω_r
        a_b − g = R s − a − 2 ω_b × v − ω̇_b × p − ω_b × (ω_b × p)

    where s is what the accelerometer reads. An IMU with no moving joint between it and the base needs no kinematics:
    R and p are then constant.

    Args:
        model: of the fixed base, its movable joints those that are measured (`RobotModel.model`).
        frame: URDF link whose frame is the IMU's.
        joint_names: order of q, q̇, q̈ (`RobotModel.names`); None: Pinocchio's.

    Raises:
        ConfigurationError: no such link; names that are not the model's joints.

    """

    def __init__(self, model: pin.Model, frame: str, joint_names: Sequence[str] | None = None) -> None:
        if not model.existFrame(frame, pin.FrameType.BODY):
            raise ConfigurationError(f"IMU: the URDF has no link {frame!r}; name the link that carries the IMU")
        own = list(model.names)[1:]
        names = own if joint_names is None else list(joint_names)
        if sorted(names) != sorted(own) or model.nq != model.nv:
            raise ConfigurationError(
                f"IMU on {frame!r}: the model's joints are {', '.join(own)}, the order given is {', '.join(names)};"
                " give each of these joints once, all of one coordinate (continuous ones made revolute)"
            )
        order = [model.joints[model.getJointId(name)].idx_v for name in names]
        self._order = None if order == list(range(model.nv)) else np.array(order)
        """Pinocchio's index of each joint; None when the orders are the same."""
        self._model, self._data = model, model.createData()
        self._frame: int = model.getFrameId(frame, pin.FrameType.BODY)
        self.constant: bool = model.frames[self._frame].parentJoint == 0
        """Whether no joint moves between base and IMU."""
        self._motion = np.zeros(9)
        """[ω; ω̇; s] in IMU axes."""
        placement = model.frames[self._frame].placement
        self._position: list[float] = placement.translation.tolist()
        self._to_base: Array = _to_base(placement)

    def base_motion(
        self,
        position: Array,
        velocity: Array,
        acceleration: Array,
        angular_velocity_in_imu: Array,
        angular_acceleration_in_imu: Array | None,
        specific_force_in_imu: Array,
    ) -> BaseMotion:
        """Compute the base's motion.

        Args:
            position: q (n,) [rad]; this and the next two are not looked at when `constant`.
            velocity: q̇ (n,) [rad/s].
            acceleration: q̈ (n,) [rad/s²].
            angular_velocity_in_imu: ω (3,) [rad/s].
            angular_acceleration_in_imu: ω̇ (3,) [rad/s²]; None neglects it, as the paper does where the gyroscope is too
                noisy to be differentiated.
            specific_force_in_imu: s = a − g (3,) [m/s²] at the IMU's origin.

        """
        motion = self._motion
        motion[:3] = angular_velocity_in_imu
        motion[3:6] = 0.0 if angular_acceleration_in_imu is None else angular_acceleration_in_imu
        motion[6:] = specific_force_in_imu
        if self.constant:
            base = self._to_base.dot(motion)
            x, y, z = self._position
        else:
            base, (x, y, z) = self._without_joints(position, velocity, acceleration)
        wx, wy, wz = base[:3].tolist()
        # ω × (ω × p) = ω (ω·p) − p (ω·ω)
        along, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
        base[6:] -= (wx * along - x * square, wy * along - y * square, wz * along - z * square)
        base.setflags(write=False)
        return BaseMotion(base[:3], base[3:6], base[6:])

    def _without_joints(self, position: Array, velocity: Array, acceleration: Array) -> tuple[Array, list[float]]:
        """[ω_b; ω̇_b; a_b − g] (9,) without the last term, and p."""
        model, data, frame, axes = self._model, self._data, self._frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        q, v, a = position, velocity, acceleration
        if self._order is not None:
            q, v, a = np.empty(model.nv), np.empty(model.nv), np.empty(model.nv)
            q[self._order], v[self._order], a[self._order] = position, velocity, acceleration
        pin.forwardKinematics(model, data, q, v, a)
        placement = pin.updateFramePlacement(model, data, frame)
        relative = pin.getFrameVelocity(model, data, frame, axes)
        rate = pin.getFrameClassicalAcceleration(model, data, frame, axes)
        lever, turn = pin.skew(placement.translation), self._motion.reshape(3, 3).dot(placement.rotation.T)
        spin = turn[0] - relative.angular
        across = pin.skew(spin)
        twist = turn[1] - rate.angular - across.dot(relative.angular)
        force = turn[2] - rate.linear - 2.0 * across.dot(relative.linear) + lever.dot(twist)
        return np.concatenate((spin, twist, force)), placement.translation.tolist()


def _to_base(placement: pin.SE3) -> Array:
    """[ω; ω̇; s] of the IMU to [ω; ω̇; R s − (R ω̇) × p], (9, 9), all terms that are linear."""
    matrix = np.kron(np.eye(3), placement.rotation)
    matrix[6:, 3:6] = pin.skew(placement.translation) @ placement.rotation
    return matrix


def floating_model(robot: Robot, cuts: Sequence[str] = ()) -> tuple[pin.Model, dict[str, int], str]:
    """Build the robot on a free flyer, its driven joints alone moving, with a joint at each link of `cuts`.

    A link that no driven joint carries gets a joint that is to stay at zero: its force in Newton-Euler is then the
    wrench that passes between the link and its parent, in the link's frame.

    Returns:
        The model, with Pinocchio's own gravity and no armature; the joint of each link of `cuts`; the root link.

    Raises:
        ConfigurationError: no such link, the root link, no such movable joint, or a URDF that Pinocchio cannot read.

    """
    urdf, driven = ElementTree.fromstring(robot.urdf), robot.description.joint_names
    links = [str(link.get("name")) for link in urdf.findall("link")]
    carriers = {_child(joint): joint for joint in urdf.findall("joint")}
    for link in cuts:
        if link not in links or link not in carriers:
            what = "is the root of the URDF and carries everything" if link in links else "the URDF has not"
            raise ConfigurationError(
                f"robot {robot.description.name}: link {link!r} {what}; choose one beyond the base"
            )
    joint_of = {link: str(carriers[link].get("name")) for link in cuts}
    kept = {*driven, *joint_of.values()}
    for joint in urdf.findall("joint"):
        name = joint.get("name")
        if name in kept and (name not in driven or joint.get("type") == "continuous"):
            make_revolute(joint)
            for axis in [] if name in driven else joint.findall("axis"):
                joint.remove(axis)  # that of a joint that never moves is any
    model = read_urdf(robot, urdf, pin.JointModelFreeFlyer())
    for name in driven:
        if name not in model.names:
            raise ConfigurationError(f"robot {robot.description.name}: the URDF has no movable joint {name!r}")
    locked = [joint for joint in range(2, model.njoints) if model.names[joint] not in kept]  # 0 universe, 1 free flyer
    if locked:
        model = pin.buildReducedModel(model, locked, pin.neutral(model))
    joints = {link: int(model.getJointId(name)) for link, name in joint_of.items()}
    return model, joints, next(link for link in links if link not in carriers)


def _child(joint: ElementTree.Element) -> str | None:
    element = joint.find("child")
    return None if element is None else element.get("link")
