"""Joint torques without torque sensors, from joints, base and force/torque sensors: algorithm 1 of [Del Prete 2016]."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

from controller_service.base_motion import BaseMotion, floating_model
from controller_service.errors import StateError
from controller_service.ft_calibration import Payload
from controller_service.model import Array, frozen
from schemas.errors import ConfigurationError
from schemas.load import Robot


@dataclass(frozen=True, slots=True)
class TorqueEstimate:
    """Torques and wrenches that explain a motion, all estimated. Wrenches are [f; n] in N and N·m; read-only."""

    torque: Array
    """τ (n,) [N·m]: motor less friction, with the rotors' inertia; τ of (6)."""
    link_torque: Array
    """(n,) [N·m] at the joint's output: τ less the reflected rotor inertia times q̈."""
    external_wrenches: tuple[Array, ...]
    """(6,) of the environment on what each sensor carries, in the sensor's frame, moment at its origin."""
    base_wrench: Array
    """(6,) in base axes, at the base's origin: what is exerted there beside all that is known or estimated. Of a fixed
    base the mount's wrench, of a floating one the remainder of the least squares, which should be near zero."""
    unknown_wrench: Array
    """(6,) f_u of the environment on the unknown link, in its frame at its origin; zero without such a link."""
    residual: float
    """Norm of a floating base's `base_wrench`, N and N·m alike as in (2); 0 of a fixed one, whose mount takes all."""


class TorqueEstimator:
    """Estimates joint torques: wrenches of the environment first, then recursive Newton-Euler with them.

    M v̇ + h − Jᵀ f = [J_uᵀ Sᵀ] [f_u; τ], v of base and joints, f of the environment at the sensors, f_u unknown.

    The torques depend on neither pose nor velocity of the base, and on gravity only as part of its proper acceleration
    a − g. So a free flyer at the identity without gravity that accelerates with a − g stands for any robot.

    1. Newton-Euler without the environment gives the wrench that passes each sensor if nothing touches the robot. This
       less the reading is the environment's, f: weight and inertia are compensated.
    2. Newton-Euler with f gives the joint rows and six rows b of the base.
    3. The columns Sᵀ hold the joint rows exactly, whatever f_u: so the least squares for [f_u; τ] is that of
       J_ubᵀ f_u = b, the base rows alone, and then τ = joint rows − J_ujᵀ f_u. A wrench leaves no remainder; a pure
       force at the link's origin has three unknowns for six rows. Without an unknown link τ is (2): b remains.

    The body that a sensor carries enters f, but neither b nor τ of the joints before the sensor: for those only the
    reading counts. A calibrated `Payload` therefore replaces the URDF's body in both passes; its rotational inertia
    about the centre of mass stays the URDF's.

    Where driven joints lie beyond a sensor (as on iCub), they must be a chain without branches, and the environment is
    taken to touch its last link.

    Args:
        robot: description and URDF; joints that the description lacks are locked at zero.
        sensors: names of the force/torque sensors used, in the order of all wrenches. Others are ignored: whatever the
            environment exerts on them must be zero or be the unknown wrench.
        unknown_link: URDF link on which one more wrench may act. It has to be known where: this decides which joints
            feel it.
        unknown: all six components, or a force at the link's origin.
        base: `fixed` has a mount that exerts any wrench.
        compensations: calibrated bodies by the sensor's name; the URDF's and no offset for others.

    Raises:
        ConfigurationError: no such sensor, link or joint; sensors behind one another, at the root link, or with
            branches beyond; a payload on moving joints; an unknown link beyond a sensor, or with a fixed base.

    """

    def __init__(
        self,
        robot: Robot,
        sensors: tuple[str, ...],
        *,
        unknown_link: str | None = None,
        unknown: Literal["wrench", "force"] = "wrench",
        base: Literal["fixed", "floating"] = "fixed",
        compensations: Mapping[str, Payload] | None = None,
    ) -> None:
        description = robot.description
        self.sensors = sensors
        """Names, in the order of all wrenches."""
        frames = {name: _sensor_frame(robot, name) for name in sensors}
        if len(set(frames.values())) < len(sensors):
            raise ConfigurationError(f"torque estimation: two of {', '.join(sensors)} are on one link; use one of them")
        self.model, joint_of, root = floating_model(robot, tuple(frames.values()))
        model, cuts = self.model, {name: joint_of[frame] for name, frame in frames.items()}
        ends = {name: _end(model, name, joint, cuts) for name, joint in cuts.items()}
        self._pairs = tuple((cuts[name], ends[name]) for name in sensors)
        """Joint at each sensor, whose frame is the sensor's, and the one that the environment touches."""
        self._carried = {name: model.inertias[joint].copy() for name, joint in cuts.items()}
        self._offsets = [np.zeros(6) for _ in sensors]
        for name, payload in (compensations or {}).items():
            self._compensate(name, payload)
        joints = [model.joints[model.getJointId(name)].idx_v for name in description.joint_names]
        self.n = len(joints)
        straight = joints == list(range(joints[0], joints[0] + self.n))
        self._index = slice(joints[0], joints[0] + self.n) if straight else np.array(joints)
        """Of the description's joints in v; one less than in q, as the free flyer's quaternion has one more."""
        self._q_index = slice(joints[0] + 1, joints[0] + 1 + self.n) if straight else np.array(joints) + 1
        self._armature = np.array([joint.rotor_inertia * joint.gear_ratio**2 for joint in description.joints])
        armature = np.zeros(model.nv)
        armature[joints] = self._armature
        model.armature = armature
        model.gravity = pin.Motion.Zero()
        self.data = model.createData()
        self._q, self._v, self._a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        self._external = pin.StdVec_Force()
        self._external.extend([pin.Force.Zero() for _ in range(model.njoints)])
        self._touched = tuple(self._external[end] for _, end in self._pairs)
        self._zero = frozen(np.zeros(6))
        self._floating = base == "floating"
        self._rows = 6 if unknown == "wrench" else 3
        self._unknown = self._unknown_frame(unknown_link, root)

    def carried(self, sensor: str) -> pin.Inertia:
        """Give the URDF's body that a sensor carries, in its frame; up to the next joint where joints lie beyond.

        Raises:
            ConfigurationError: a sensor that is not used.

        """
        if sensor not in self._carried:
            raise ConfigurationError(
                f"torque estimation: no force/torque sensor {sensor!r} is used; there are"
                f" {', '.join(self.sensors) or 'none'}"
            )
        return self._carried[sensor]

    def estimate(
        self, position: Array, velocity: Array, acceleration: Array, base: BaseMotion, wrenches: Sequence[Array]
    ) -> TorqueEstimate:
        """Estimate at one instant; all inputs with the same delay.

        Args:
            position: q (n,) [rad], in the description's order.
            velocity: q̇ (n,) [rad/s].
            acceleration: q̈ (n,) [rad/s²].
            base: the base's motion.
            wrenches: reading of each sensor of `sensors`, [f; n] (6,) in its frame: what the parent side exerts on all
                from the sensor's link on.

        Raises:
            StateError: wrong shapes, or values that are not finite.

        """
        n = (self.n,)
        if not (position.shape == velocity.shape == acceleration.shape == n) or len(wrenches) != len(self.sensors):
            raise StateError(
                f"torque estimation: expected q, q̇, q̈ of {self.n} joints and {len(self.sensors)} wrenches, got"
                f" {position.shape}, {velocity.shape}, {acceleration.shape} and {len(wrenches)}"
            )
        model, data, q, v, a, index = self.model, self.data, self._q, self._v, self._a, self._index
        q[self._q_index] = position
        v[3:6] = base.angular_velocity
        v[index] = velocity
        a[:3] = base.acceleration  # of the free flyer's spatial acceleration too, its velocity being zero
        a[3:6] = base.angular_acceleration
        a[index] = acceleration
        external: tuple[Array, ...] = ()
        if self._pairs:
            pin.rnea(model, data, q, v, a)
            external = self._environment(wrenches)
        rows = pin.rnea(model, data, q, v, a, self._external)
        if not math.isfinite(sum(rows.tolist())):
            raise StateError(
                "torque estimation: a joint, base or wrench measurement is not finite, so the torques are not either;"
                " check the encoders, the IMU and the force/torque sensors"
            )
        remainder, torque, unknown = rows[:6].copy(), rows[index].copy(), self._zero
        if self._unknown is not None:
            # J_u in the link's axes; of a force the linear rows alone, as there is no moment about the origin
            jacobian = pin.computeFrameJacobian(model, data, q, self._unknown, pin.ReferenceFrame.LOCAL)[: self._rows]
            lever = jacobian[:, :6]
            solution = np.linalg.solve(lever.dot(lever.T), lever.dot(remainder))
            remainder -= solution.dot(lever)
            torque -= solution.dot(jacobian[:, index])
            unknown = np.zeros(6)
            unknown[: self._rows] = solution
        return TorqueEstimate(
            frozen(torque),
            frozen(torque - self._armature * acceleration),
            external,
            frozen(remainder),
            frozen(unknown),
            math.sqrt(remainder.dot(remainder)) if self._floating else 0.0,
        )

    def _environment(self, wrenches: Sequence[Array]) -> tuple[Array, ...]:
        """Wrench of the environment at each sensor, from the first pass, and its place in the second."""
        data, results, placed = self.data, [], False
        for (joint, end), wrench, offset, touched in zip(
            self._pairs, wrenches, self._offsets, self._touched, strict=True
        ):
            if wrench.shape != (6,):
                raise StateError(f"torque estimation: expected wrenches of shape (6,), got {wrench.shape}")
            result = data.f[joint].vector - wrench + offset
            if end == joint:
                touched.vector = result
            else:
                if not placed:
                    pin.forwardKinematics(self.model, data, self._q)
                    placed = True
                touched.vector = data.oMi[end].actInv(data.oMi[joint].act(pin.Force(result))).vector
            results.append(frozen(result))
        return tuple(results)

    def _compensate(self, name: str, payload: Payload) -> None:
        body = self.carried(name)
        joint, end = self._pairs[self.sensors.index(name)]
        if joint != end:
            raise ConfigurationError(
                f"torque estimation: joint {self.model.names[end]!r} moves beyond sensor {name!r}, but a compensation"
                " is of one rigid body; leave it out, or use a sensor beyond this joint"
            )
        self.model.inertias[joint] = pin.Inertia(payload.mass, payload.centre_of_mass, body.inertia)
        self._offsets[self.sensors.index(name)] = payload.wrench_offset.copy()

    def _unknown_frame(self, link: str | None, root: str) -> int | None:
        if link is None or (not self._floating and link == root and self._rows == 6):
            return None
        model = self.model
        if not model.existFrame(link, pin.FrameType.BODY):
            raise ConfigurationError(f"torque estimation: the URDF has no link {link!r} for the unknown wrench")
        if not self._floating:
            raise ConfigurationError(
                f"torque estimation: the unknown {'wrench' if self._rows == 6 else 'force'} on {link!r} cannot be told"
                " from the mount's: the base is fixed, and its mount's wrench takes up all six equations that would"
                " show it. Leave unknown_link out, or put a force/torque sensor between base and link."
            )
        index: int = model.getFrameId(link, pin.FrameType.BODY)
        for name, (joint, _) in zip(self.sensors, self._pairs, strict=True):
            if model.frames[index].parentJoint in list(model.subtrees[joint]):
                raise ConfigurationError(
                    f"torque estimation: the unknown link {link!r} lies beyond sensor {name!r}, which measures what"
                    " acts there; choose a link between the sensors, e.g. the trunk"
                )
        return index


def _sensor_frame(robot: Robot, name: str) -> str:
    sensors = {sensor.name: sensor.frame for sensor in robot.description.force_torque_sensors}
    if name not in sensors:
        raise ConfigurationError(
            f"torque estimation: robot {robot.description.name} has no force/torque sensor {name!r}; it has"
            f" {', '.join(sensors) or 'none'}"
        )
    return sensors[name]


def _end(model: pin.Model, name: str, joint: int, cuts: Mapping[str, int]) -> int:
    """Last joint of the chain from a sensor's joint on: the one whose link the environment touches."""
    beyond = list(model.subtrees[joint])
    for other, cut in cuts.items():
        if other != name and cut in beyond:
            raise ConfigurationError(
                f"torque estimation: sensor {other!r} lies beyond sensor {name!r}, and between them a wrench could act"
                " that is not known; use one of them"
            )
    for before, after in itertools.pairwise(beyond):
        if model.parents[after] != before:
            raise ConfigurationError(
                f"torque estimation: the robot branches beyond sensor {name!r} (joint {model.names[after]!r} does not"
                f" follow {model.names[before]!r}), so it is not known which link the environment touches; use sensors"
                " beyond the branch"
            )
    return int(beyond[-1])
