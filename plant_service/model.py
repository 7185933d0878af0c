"""The simulated robot's MuJoCo model, built from the text of the same URDF that the controller reads.

Controller model and plant differ on purpose: masses, friction and torque scale come from the scenario's `PlantConfig`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from plant_service.errors import PlantError
from plant_service.friction import friction_factors
from plant_service.obstacles import add_contact_boxes, add_obstacles, refuse_penetration
from schemas.load import Robot
from schemas.scenario import PlantConfig

MASS_STREAM = 1
"""Each use of the seed has a generator of its own, so that one more draw in one place changes nothing elsewhere."""

FRICTION_IMPEDANCE = 0.9999
"""MuJoCo's largest impedance: a stuck joint under load creeps at (1 − d) h τ / (d M), about 1e-7 rad/s."""


@dataclass(frozen=True, slots=True)
class PlantModel:
    """A compiled model and where the described joints and frames lie in it. Treat the arrays as read-only."""

    model: mujoco.MjModel
    qpos_address: NDArray[np.intp]
    """Index in `qpos` of each joint, in the order of the description."""
    dof_address: NDArray[np.intp]
    """Index in `qvel` of each joint, in the order of the description."""
    frame_bodies: dict[str, int]
    """Body of every URDF link by name; body frames are the links' frames."""
    initial_position: NDArray[np.float64]
    """Joint angles at the start [rad], in the order of the description."""
    mass_factors: dict[str, float]
    """True over described mass of each link."""
    friction_factors: NDArray[np.float64]
    """True over given friction of each joint, in the order of the description."""


def build(robot: Robot, config: PlantConfig, seed: int) -> PlantModel:
    """Build the plant's model.

    Armature J N² and viscous friction N² v come from the description and the scenario; joints of the URDF that the
    description does not name are locked at zero; meshes are left out, primitives kept and the description's
    `contact_boxes` added, without mass; links joined by one joint do not collide. Every link's mass and inertia is
    multiplied by 1 ± `config.mass_error`, signs drawn from `seed`, every joint's friction by a factor within
    1 ± `config.friction_error`. The world's obstacles touch all moving links.

    Raises:
        PlantError: MuJoCo cannot build the URDF, a frame, joint or link is missing in it, or the robot starts in an
            obstacle.

    """
    description = robot.description
    try:
        spec = mujoco.MjSpec.from_string(reduced(robot.urdf))
    except ValueError as error:
        raise PlantError(f"{description.name}: MuJoCo refuses the URDF {description.urdf}: {error}") from error
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = False
    _set_options(spec, config, description.gravity_in_world)
    friction = friction_factors(len(description.joints), config.friction_error, seed)
    _set_joints(spec, robot, config, friction)
    factors = _perturb_masses(spec, config.mass_error, seed)
    _add_sensors(spec, robot)
    add_contact_boxes(spec, description.contact_boxes, description.name)
    _exclude_neighbours(spec, description.name)  # those with shapes, so after all shapes of links
    add_obstacles(spec, config.world, description.name)
    model = _compile(spec, description.name)

    joints = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in description.joint_names]
    bodies = {model.body(index).name: index for index in range(1, model.nbody)}
    for frame in config.truth_frames:
        if frame not in bodies:
            raise PlantError(
                f"plant.truth_frames: {description.name} has no link {frame!r}; it has {', '.join(bodies)}"
            )
    qpos_address = np.array([model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
    position = initial_position(robot, config)
    refuse_penetration(model, qpos_address, position, description.name)
    return PlantModel(
        model=model,
        qpos_address=qpos_address,
        dof_address=np.array([model.jnt_dofadr[joint] for joint in joints], dtype=np.intp),
        frame_bodies=bodies,
        initial_position=position,
        mass_factors=factors,
        friction_factors=friction,
    )


def initial_position(robot: Robot, config: PlantConfig) -> NDArray[np.float64]:
    """Joint angles at the start [rad]: as the scenario says, else zero or the limit nearest to it.

    Raises:
        PlantError: an angle of the scenario lies outside the joint's range.

    """
    angles = []
    for joint in robot.description.joints:
        angle = config.initial_posture.get(joint.name)
        if angle is None:
            angle = min(max(0.0, joint.position_min), joint.position_max)
        elif not joint.position_min <= angle <= joint.position_max:
            raise PlantError(
                f"plant.initial_posture.{joint.name}: {angle:g} rad lies outside"
                f" [{joint.position_min:g}, {joint.position_max:g}] rad"
            )
        angles.append(angle)
    return np.array(angles)


def reduced(urdf: str) -> str:
    """Leave out visual and collision meshes, and mimic rules: every described joint has a drive of its own."""
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            if element.find("geometry/mesh") is not None:
                link.remove(element)
    for joint in root.iter("joint"):
        for rule in joint.findall("mimic"):
            joint.remove(rule)
    return ElementTree.tostring(root, encoding="unicode")


def _set_options(spec: mujoco.MjSpec, config: PlantConfig, gravity: Iterable[float]) -> None:
    option = spec.option
    option.timestep = config.substep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.gravity = list(gravity)
    option.tolerance = 1e-12
    option.iterations = 50
    # A diverged simulation must be reported, not silently restarted from the reference posture.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _set_joints(spec: mujoco.MjSpec, robot: Robot, config: PlantConfig, friction: NDArray[np.float64]) -> None:
    described = {joint.name: joint for joint in robot.description.joints}
    factors = dict(zip(robot.description.joint_names, friction.tolist(), strict=True))
    for element in list(spec.joints):
        joint = described.get(element.name)
        if joint is None:
            spec.delete(element)
            continue
        element.armature = joint.rotor_inertia * joint.gear_ratio**2
        factor = factors[joint.name]
        element.damping = [config.friction.viscous * joint.gear_ratio**2 * factor, 0.0, 0.0]
        # The time constant 2h stops a joint within one step, the stiffest that does not overshoot. A row of friction
        # exists from the start for a joint whose bound is not zero; the bound itself is set at every step.
        element.frictionloss = max(config.friction.breakaway * joint.gear_ratio * factor, 1e-9)
        element.solref_friction = [2.0 * config.substep_s, 1.0]
        element.solimp_friction = [FRICTION_IMPEDANCE, FRICTION_IMPEDANCE, 0.001, 0.5, 2.0]


def _perturb_masses(spec: mujoco.MjSpec, mass_error: float, seed: int) -> dict[str, float]:
    generator = np.random.default_rng([seed, MASS_STREAM])
    factors = {}
    for body in spec.bodies[1:]:
        sign = 1.0 if generator.random() < 0.5 else -1.0
        factor = factors[body.name] = 1.0 + sign * mass_error
        body.mass *= factor
        body.inertia = np.asarray(body.inertia) * factor
        if np.isfinite(body.fullinertia).all():
            body.fullinertia = np.asarray(body.fullinertia) * factor
    return factors


def _add_sensors(spec: mujoco.MjSpec, robot: Robot) -> None:
    kinds = mujoco.mjtSensor
    wrench = [kinds.mjSENS_FORCE, kinds.mjSENS_TORQUE]
    motion = [kinds.mjSENS_GYRO, kinds.mjSENS_ACCELEROMETER, kinds.mjSENS_FRAMEQUAT]
    wanted = [(sensor.name, sensor.frame, wrench) for sensor in robot.description.force_torque_sensors]
    wanted += [(imu.name, imu.frame, motion) for imu in robot.description.imus]
    for name, frame, types in wanted:
        body = spec.body(frame)
        if body is None:
            raise PlantError(f"{robot.description.name}: sensor {name}: the URDF has no link {frame!r}")
        body.add_site(name=name)
        for kind in types:
            spec.add_sensor(name=sensor_name(name, kind), type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)


def sensor_name(name: str, kind: mujoco.mjtSensor) -> str:
    """Name in the MuJoCo model of one channel of a described sensor."""
    return f"{name}/{kind.name}"


def _exclude_neighbours(spec: mujoco.MjSpec, name: str) -> None:
    model = _compile(spec, name)
    weld = model.body_weldid
    parent = weld[model.body_parentid[weld]]
    solid = [body for body in range(1, model.nbody) if model.body_geomnum[body] > 0]
    for first in solid:
        for second in solid:
            if weld[first] != weld[second] and parent[second] == weld[first]:
                spec.add_exclude(bodyname1=model.body(first).name, bodyname2=model.body(second).name)


def _compile(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise PlantError(f"{name}: MuJoCo cannot compile the model: {' '.join(str(error).split())}") from error
