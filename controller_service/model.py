"""The controller's rigid-body model: Pinocchio, in the joint order of the robot description."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from controller_service.errors import StateError
from schemas.errors import ConfigurationError
from schemas.load import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FrameKinematics:
    """Pose and motion of a frame's origin, in world axes; rows 0-2 linear, 3-5 angular."""

    position: Array
    """(3,) [m] in the world."""
    rotation: Array
    """(3, 3), frame to world."""
    jacobian: Array
    """J (6, n), LOCAL_WORLD_ALIGNED: [v; ω] = J q̇."""
    velocity: Array
    """(6,) [v; ω] = J q̇."""
    drift: Array
    """J̇ q̇ (6,): [v̇; ω̇] at q̈ = 0, v̇ the derivative of v (classical acceleration)."""
    jacobian_rate: Array
    """J̇ (6, n)."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Dynamics and kinematics at (q, q̇): holding one means that they have been computed. All arrays are read-only.

    M q̈ + C q̇ + g = u, (1) of [Benallegue 2021], n joints in the order of the description.
    """

    position: Array
    """q (n,) [rad]."""
    velocity: Array
    """q̇ (n,) [rad/s]."""
    mass: Array
    """M (n, n) [kg·m²], symmetric positive definite, with the rotors' inertia times the gears squared."""
    coriolis: Array
    """C (n, n) [kg·m²/s], such that Ṁ − 2C is skew-symmetric."""
    nonlinear: Array
    """h = C q̇ + g (n,) [N·m]."""
    frames: Mapping[str, FrameKinematics]
    """The frames that the model was asked for."""

    @property
    def gravity(self) -> Array:
        """G (n,) [N·m]."""
        gravity: Array = self.nonlinear - self.coriolis @ self.velocity
        return gravity


class RobotModel:
    """Pinocchio model of a description's joints; the URDF's other joints are locked at zero.

    Args:
        robot: description and URDF.
        frames: URDF links whose kinematics every `Configuration` holds.

    Raises:
        ConfigurationError: the URDF cannot be read by Pinocchio, or lacks a joint or a frame.

    """

    def __init__(self, robot: Robot, frames: tuple[str, ...] = ()) -> None:
        description = robot.description
        self.model = _build(robot)
        self.n: int = self.model.nv
        self.names = description.joint_names
        order = [self.model.joints[self.model.getJointId(name)].idx_v for name in self.names]
        self._order = None if order == list(range(self.n)) else np.array(order)
        """Pinocchio's index of each joint of the description; None when they are the same."""
        self._grid = np.ix_(order, order)
        armature = np.zeros(self.n)
        armature[order] = [joint.rotor_inertia * joint.gear_ratio**2 for joint in description.joints]
        self.model.armature = armature
        self.model.gravity = pin.Motion(np.array(description.gravity_in_world), np.zeros(3))
        self.data = self.model.createData()
        self._pose_data = self.model.createData()
        self._zero = np.zeros(self.n)
        self._frames = {name: self._frame_id(name) for name in frames}

    def configure(self, position: Array, velocity: Array) -> Configuration:
        """Compute everything at (q, q̇), both (n,) in the description's order.

        Raises:
            StateError: wrong shape.

        """
        if position.shape != (self.n,) or velocity.shape != (self.n,):
            raise StateError(f"expected {self.n} positions and velocities, got {position.shape} and {velocity.shape}")
        model, data, order = self.model, self.data, self._order
        q, v = position, velocity
        if order is not None:
            q, v = np.empty(self.n), np.empty(self.n)
            q[order] = position
            v[order] = velocity
        mass = pin.crba(model, data, q)
        nonlinear = pin.nonLinearEffects(model, data, q, v)
        coriolis = pin.computeCoriolisMatrix(model, data, q, v)  # leaves the joint Jacobians in data as well
        if order is not None:
            mass, nonlinear, coriolis = mass[self._grid], nonlinear[order], coriolis[self._grid]
        frames: dict[str, FrameKinematics] = {}
        if self._frames:
            pin.forwardKinematics(model, data, q, v, self._zero)
            pin.computeJointJacobiansTimeVariation(model, data, q, v)
            for name, index in self._frames.items():
                frames[name] = self._kinematics(index, velocity)
        return Configuration(
            frozen(position.copy()),
            frozen(velocity.copy()),
            frozen(mass),
            frozen(coriolis),
            frozen(nonlinear),
            frames,
        )

    def pose(self, position: Array, frame: str) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of a frame in the world, without dynamics."""
        q = position
        if self._order is not None:
            q = np.empty(self.n)
            q[self._order] = position
        pin.forwardKinematics(self.model, self._pose_data, q)
        index = self._frames.get(frame) or self._frame_id(frame)
        placement = pin.updateFramePlacement(self.model, self._pose_data, index)
        return placement.translation.copy(), placement.rotation.copy()

    def _kinematics(self, index: int, velocity: Array) -> FrameKinematics:
        model, data, axes = self.model, self.data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        placement = pin.updateFramePlacement(model, data, index)
        jacobian = pin.getFrameJacobian(model, data, index, axes)
        if self._order is not None:
            jacobian = jacobian[:, self._order]
        drift = pin.getFrameClassicalAcceleration(model, data, index, axes).vector
        rate = pin.getFrameJacobianTimeVariation(model, data, index, axes)
        if self._order is not None:
            rate = rate[:, self._order]
        return FrameKinematics(
            frozen(placement.translation.copy()),
            frozen(placement.rotation.copy()),
            frozen(jacobian),
            frozen(jacobian.dot(velocity)),
            frozen(drift.copy()),
            frozen(rate),
        )

    def _frame_id(self, name: str) -> int:
        if not self.model.existFrame(name, pin.FrameType.BODY):
            raise ConfigurationError(f"the URDF of the controller's model has no link {name!r}")
        index: int = self.model.getFrameId(name, pin.FrameType.BODY)
        return index


def frozen(array: Array) -> Array:
    """Make an array that nobody else holds read-only: Pinocchio's matrices are new ones, its vectors need a copy."""
    array.setflags(write=False)
    return array


def make_revolute(joint: ElementTree.Element) -> None:
    """Make a URDF's joint a revolute one with limits beyond all use.

    Pinocchio gives a continuous joint two coordinates; the description limits every joint, so one is enough.
    """
    joint.set("type", "revolute")
    for limit in joint.findall("limit"):
        joint.remove(limit)
    ElementTree.SubElement(joint, "limit", lower="-1e3", upper="1e3", effort="1e9", velocity="1e9")


def read_urdf(robot: Robot, root: ElementTree.Element, *base: pin.JointModelFreeFlyer) -> pin.Model:
    """Have Pinocchio read a URDF, on a fixed base or on the joint given.

    Raises:
        ConfigurationError: it cannot.

    """
    try:
        return pin.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"), *base)
    except (ValueError, RuntimeError) as error:
        raise ConfigurationError(
            f"robot {robot.description.name}: Pinocchio cannot read the URDF: {' '.join(str(error).split())}"
        ) from error


def _build(robot: Robot) -> pin.Model:
    names = set(robot.description.joint_names)
    root = ElementTree.fromstring(robot.urdf)
    for joint in root.iter("joint"):
        if joint.get("type") == "continuous":
            make_revolute(joint)
    model = read_urdf(robot, root)
    for name in names - set(model.names):
        raise ConfigurationError(f"robot {robot.description.name}: the URDF has no movable joint {name!r}")
    locked = [model.getJointId(name) for name in model.names if name not in names and name != "universe"]
    return pin.buildReducedModel(model, locked, pin.neutral(model)) if locked else model
