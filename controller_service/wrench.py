"""The wrench that the environment exerts on the hand, from the force/torque sensor's readings."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin

from controller_service.errors import StateError
from controller_service.model import Array, Configuration, FrameKinematics
from schemas.control_law import HandForce
from schemas.errors import ConfigurationError
from schemas.load import Robot
from schemas.messages import RobotState, WrenchSample

LONGEST_HOLD: Final = 5
"""Cycles for which the last wrench stands in for readings that do not come."""


@dataclass(frozen=True, slots=True)
class HandWrench:
    """Force and moment of the environment on what lies beyond the sensor, estimated; world axes, moment at the hand."""

    wrench: Array
    """F (6,) [N, N·m], filtered."""
    rate: Array
    """Ḟ (6,) [N/s, N·m/s], finite difference of the filtered F; 0 while F is held."""
    age_cycles: int
    """0: of this cycle; else F is held since as many cycles."""

    @property
    def force_norm(self) -> float:
        """Norm of the force [N]."""
        return math.hypot(*self.wrench[:3].tolist())


class HandWrenchEstimator:
    """Takes weight and inertia of what the sensor carries out of its readings, and filters what is left.

    The sensor measures f_s, n_s, what the robot exerts on the rigid body beyond it. Newton and Euler for this body, of
    mass m, centre of mass c and inertia I about the hand frame's origin, which moves with a and ω:

        f = m (a − g + ω̇ × c + ω × (ω × c)) − f_s
        n = m c × (a − g) + I ω̇ + ω × I ω − n_s

    with the sensor's wrench moved to that origin and [a; ω̇] = J q̈ + J̇ q̇. The first-order low-pass
    F_k = α F_{k−1} + (1 − α) [f; n] has the exact discrete pole α = exp(−2π f_c T); it starts at the first reading.

    Where the caller gives no q̈ it is the backward difference of the configuration's q̇, late by T/2 and by what q̇ is
    late (3.8 ms at 500 Hz with q̇ filtered at 60 Hz). It has no filter but F's own, which is linear, so that weight and
    inertia pass the same pole: white noise σ of q̇ comes out as (1 − α)/T · √(2/(1 + α)) σ ≈ 2π f_c σ of q̈. Encoders of
    4096 counts before a gear of 250 make 0.07 rad/s² a joint at 20 Hz, 0.1 N for a kilogram on an arm of nine joints.
    Without the term a motion of 2 m/s² would show as 2 N for each kilogram.

    A constant bias of the sensor remains in F.

    Args:
        robot: description and URDF; joints of the URDF that the description lacks are locked at zero.
        config: sensor and f_c.

    Raises:
        ConfigurationError: no such sensor, no hand frame, hand not beyond the sensor, a driven joint beyond it.

    """

    def __init__(self, robot: Robot, config: HandForce) -> None:
        description = robot.description
        self.sensor = config.sensor
        """Name of the sensor."""
        frame, hand = _sensor_frame(robot, config.sensor), description.hand_frame
        if hand is None:
            raise ConfigurationError(
                f"controller.hand_force: robot {description.name} has no hand_frame; name the URDF link of its hand"
            )
        self.hand_frame: str = hand
        beyond = _body_beyond(robot, config.sensor, frame)
        if not beyond.existFrame(hand, pin.FrameType.BODY):
            raise ConfigurationError(
                f"controller.hand_force.sensor: the hand frame {hand!r} does not lie beyond sensor {config.sensor!r}"
                f" (link {frame!r}), so what it reads is not the hand's wrench; choose a sensor between arm and hand"
            )
        sensor_in_hand = beyond.frames[beyond.getFrameId(hand, pin.FrameType.BODY)].placement.inverse()
        self.inertia: pin.Inertia = sensor_in_hand.act(beyond.inertias[0])
        """Of all links from the sensor's on, in the hand frame."""
        self._inertia_matrix: Array = self.inertia.matrix()
        self._sensor_to_hand: Array = sensor_in_hand.toDualActionMatrix()
        self._gravity = np.array(description.gravity_in_world)
        self._zero = np.zeros(6)
        self._zero.setflags(write=False)
        self._period = description.period_s
        self._cutoff = 2.0 * math.pi * config.cutoff_hz
        self._velocity: Array | None = None
        """q̇ of the last update."""
        self._wrench: Array | None = None
        """Filtered F; None before the first reading."""
        self._age = 0
        """Cycles since the last reading that was used, or since the start."""

    def sample(self, state: RobotState) -> WrenchSample | None:
        """Find this sensor's sample in a state."""
        return next((sample for sample in state.wrenches if sample.name == self.sensor), None)

    def restart(self) -> None:
        """Start anew, as at a change of mode: what comes does not follow from the readings and velocities before."""
        self._velocity = self._wrench = None
        self._age = 0

    def update(
        self,
        sample: WrenchSample | None,
        now: Configuration,
        cycles: int = 1,
        acceleration: Array | None = None,
    ) -> HandWrench:
        """Estimate the wrench at a state.

        A sample that is absent, or not of this cycle, is not used: F is held (0 before the first reading) and `rate` is
        0. The next one is filtered over the whole time since the last.

        Args:
            sample: the sensor's, of this state.
            now: configuration at this state, with the hand frame.
            cycles: periods since the last call.
            acceleration: q̈ (n,) [rad/s²] of this state; None: from differences of `now.velocity`, 0 at the first call.

        Raises:
            StateError: no new reading for more than `LONGEST_HOLD` cycles.

        """
        if acceleration is None and self._velocity is not None:
            acceleration = (now.velocity - self._velocity) / (cycles * self._period)
        self._velocity = now.velocity
        self._age += cycles
        if sample is None or sample.age_cycles > 0:
            return self._held()
        raw = self._environment(sample, now.frames[self.hand_frame], acceleration)
        if self._wrench is None:
            self._wrench, rate = raw, self._zero
        else:
            elapsed = self._age * self._period
            step = (1.0 - math.exp(-self._cutoff * elapsed)) * (raw - self._wrench)
            self._wrench, rate = self._wrench + step, step / elapsed
        self._wrench.setflags(write=False)
        self._age = 0
        return HandWrench(self._wrench, rate, 0)

    def _held(self) -> HandWrench:
        age = self._age
        if age > LONGEST_HOLD:
            raise StateError(
                f"force/torque sensor {self.sensor}: no new reading for {age} cycles, at most {LONGEST_HOLD} are"
                " bridged. Check its cable, bus and power, or run without controller.hand_force."
            )
        return HandWrench(self._zero if self._wrench is None else self._wrench, self._zero, age)

    def _environment(self, sample: WrenchSample, frame: FrameKinematics, acceleration: Array | None) -> Array:
        """[f; n] (6,), not filtered: inertia less gravity less sensor, in hand axes, turned to world axes."""
        motion = frame.drift.copy() if acceleration is None else frame.jacobian.dot(acceleration) + frame.drift
        motion[:3] -= self._gravity
        rotation = frame.rotation
        local: Array = self._inertia_matrix.dot(motion.reshape(2, 3).dot(rotation).ravel())
        # ν ×* I ν at ν = (0, ω) is [m ω × (ω × c); ω × I ω]
        local += self.inertia.vxiv(pin.Motion(self._zero[:3], frame.velocity[3:].dot(rotation))).vector
        local -= self._sensor_to_hand.dot(sample.force_in_sensor + sample.torque_in_sensor)
        world: Array = local.reshape(2, 3).dot(rotation.T).ravel()
        return world


def _sensor_frame(robot: Robot, name: str) -> str:
    sensors = {sensor.name: sensor.frame for sensor in robot.description.force_torque_sensors}
    if name not in sensors:
        raise ConfigurationError(
            f"controller.hand_force.sensor: robot {robot.description.name} has no force/torque sensor {name!r}; it has"
            f" {', '.join(sensors) or 'none'}"
        )
    return sensors[name]


def _body_beyond(robot: Robot, sensor: str, frame: str) -> pin.Model:
    """Everything from the link `frame` on as one rigid body: a model without movable joints, its root at `frame`.

    It is cut out of the URDF, since in a reduced model of Pinocchio the frame of a locked joint has lost its parent.
    """
    urdf = ElementTree.fromstring(robot.urdf)
    links = {link.get("name"): link for link in urdf.findall("link")}
    joints: dict[str | None, list[ElementTree.Element]] = {}
    for joint in urdf.findall("joint"):
        joints.setdefault(_link(joint, "parent"), []).append(joint)
    if frame not in links:
        raise ConfigurationError(f"force/torque sensor {sensor!r}: the URDF has no link {frame!r}")
    body = ElementTree.Element("robot", name=frame)
    waiting: list[str | None] = [frame]
    while waiting:
        name = waiting.pop()
        part = ElementTree.SubElement(body, "link", name=str(name))
        part.extend(links[name].findall("inertial"))
        for joint in joints.get(name, []):
            if joint.get("name") in robot.description.joint_names:
                raise ConfigurationError(
                    f"controller.hand_force.sensor: joint {joint.get('name')!r} moves beyond sensor {sensor!r}, whose"
                    " reading can be freed from the weight of a rigid body only; choose a sensor beyond this joint"
                )
            fixed = ElementTree.SubElement(body, "joint", name=str(joint.get("name")), type="fixed")
            fixed.extend([child for tag in ("parent", "child", "origin") for child in joint.findall(tag)])
            waiting.append(_link(joint, "child"))
    try:
        return pin.buildModelFromXML(ElementTree.tostring(body, encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        raise ConfigurationError(
            f"robot {robot.description.name}: Pinocchio cannot read the links beyond sensor {sensor!r}:"
            f" {' '.join(str(error).split())}"
        ) from error


def _link(joint: ElementTree.Element, side: str) -> str | None:
    element = joint.find(side)
    return None if element is None else element.get("link")
