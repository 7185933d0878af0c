"""Obstacles as fixed rigid shapes of the MuJoCo model, boxes of links that touch them, and what touches what.

An obstacle's own contact parameters hold against every link (`priority`); contacts of the robot with itself keep
MuJoCo's. Dry friction is MuJoCo's pyramid: |f₁| + |f₂| ≤ μ f_n along the two tangents of a contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from plant_service.errors import PlantError
from schemas.base import Vector3
from schemas.messages import ContactSample
from schemas.robot import LinkBox
from schemas.world import Box, Pole, World

Array = NDArray[np.float64]

PREFIX: Final = "obstacle/"
"""Of the names of obstacles' geoms in the MuJoCo model."""
CONTACT_BOX_PREFIX: Final = "contact_box/"
"""Of the names of the geoms of contact boxes."""
CONTACT_TIME_S: Final = 0.004
"""Time constant of a contact: what hits an obstacle is stopped within several substeps, critically damped, so without
bouncing, and no harder with smaller substeps. MuJoCo scales a contact by the inertia that it feels, reflected rotors
included, so that this holds for a finger as for a shoulder."""
CONTACT_IMPEDANCE: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""MuJoCo's largest, at any depth, as for joint friction: at rest links sink in by less than 1 µm, and stick without
creeping."""
SPRUNG_IMPEDANCE: Final = (0.95, 0.95, 0.001, 0.5, 2.0)
"""Of a box on springs: links sink in by some 10 µm. With the largest it would be less than what moves in a substep, and
a contact that carries hundreds of newtons would open for one."""
SPRING_DAMPING: Final = 0.5
"""Damping ratio of a box on springs, by itself."""
TOUCHING_M: Final = 1e-6
"""Depth at the start that is no penetration but rounding."""


def add_contact_boxes(spec: mujoco.MjSpec, boxes: Sequence[LinkBox], robot: str) -> None:
    """Add a description's contact boxes to their links in a model that is not compiled yet.

    They touch as the URDF's primitives do and have no mass: that of the link is the URDF's.

    Raises:
        PlantError: a box lies on a link that the URDF does not have.

    """
    for index, box in enumerate(boxes):
        body = spec.body(box.link)
        if body is None or body == spec.worldbody:
            links = ", ".join(each.name for each in spec.bodies[1:])
            raise PlantError(f"contact_boxes.{index}.link: {robot} has no link {box.link!r}; it has {links}")
        body.add_geom(
            name=CONTACT_BOX_PREFIX + box.name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.position_in_link,
            quat=box.orientation_to_link,
            size=box.half_sizes,
            mass=0.0,
        )


def add_obstacles(spec: mujoco.MjSpec, world: World, robot: str) -> None:
    """Add the obstacles to the world body of a model that is not compiled yet.

    Raises:
        PlantError: an obstacle has the name of a link, or no moving link has a shape that it could touch.

    """
    if not world.obstacles:
        return
    links = {body.name for body in spec.bodies}
    if not any(geom.contype for body in spec.bodies if _moves(body) for geom in body.geoms):
        raise PlantError(
            f"plant.world.obstacles: no moving link of {robot} has a collision shape to touch them with; of the URDF"
            " the plant takes boxes, cylinders and spheres, no meshes; give the robot contact_boxes"
        )
    for index, obstacle in enumerate(world.obstacles):
        if obstacle.name in links:
            raise PlantError(
                f"plant.world.obstacles.{index}.name: {obstacle.name!r} is a link of {robot}; give it a name of its own"
            )
        geom = _owner(spec, obstacle).add_geom(
            name=PREFIX + obstacle.name,
            priority=1,
            condim=3,
            friction=[obstacle.friction, 0.0, 0.0],
            solref=[CONTACT_TIME_S, 1.0],
            solimp=SPRUNG_IMPEDANCE if isinstance(obstacle, Box) and obstacle.stiffness else CONTACT_IMPEDANCE,
        )
        match obstacle:
            case Pole():
                geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
                geom.fromto = [*obstacle.start_in_world, *obstacle.end_in_world]
                geom.size = [obstacle.radius, 0.0, 0.0]
            case Box():
                geom.type = mujoco.mjtGeom.mjGEOM_BOX
                geom.mass = obstacle.mass
                geom.pos = obstacle.position_in_world
                geom.quat = obstacle.orientation_to_world
                geom.size = obstacle.half_sizes


def _owner(spec: mujoco.MjSpec, obstacle: Pole | Box) -> mujoco.MjsBody:
    """Body that an obstacle's shape belongs to: the world, or one of its own on springs, at the world's origin."""
    if isinstance(obstacle, Pole) or obstacle.stiffness is None:
        return spec.worldbody
    body = spec.worldbody.add_body(name=PREFIX + obstacle.name, gravcomp=1.0)
    for axis in np.eye(3):
        body.add_joint(
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=axis,
            stiffness=[obstacle.stiffness, 0.0, 0.0],
            damping=[2.0 * SPRING_DAMPING * (obstacle.stiffness * obstacle.mass) ** 0.5, 0.0, 0.0],
        )
    return body


def refuse_penetration(
    model: mujoco.MjModel, qpos_address: NDArray[np.intp], position: Sequence[float] | Array, robot: str
) -> None:
    """Refuse obstacles that a moving link is in at joint angles `position` [rad], whose places in `qpos` are given.

    Raises:
        PlantError: with obstacle, link and the greatest depth.

    """
    names = _owner_names(model)
    if not any(owner < 0 for owner in names):
        return
    data = mujoco.MjData(model)
    data.qpos[qpos_address] = position
    mujoco.mj_fwdPosition(model, data)
    owners = _owners(model)
    depths = [
        (-contact.dist, *sorted((owners[contact.geom1], owners[contact.geom2])))
        for contact in data.contact
        if contact.dist < -TOUCHING_M
    ]
    deep = [(depth, obstacle, body) for depth, obstacle, body in depths if obstacle < 0]
    if deep:
        depth, obstacle, body = max(deep)
        raise PlantError(
            f"plant.world.obstacles.{-1 - obstacle}: {names[obstacle]} is {1000.0 * depth:.3g} mm deep in link"
            f" {names[body]} of {robot} at the start; move it, or change plant.initial_posture"
        )


class Contacts:
    """What touches what, read while the constraint solution of a substep stands.

    Args:
        model: compiled.

    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._owners = _owners(model)
        self._names = _owner_names(model)
        self._wrench = np.empty(6)
        self.force = 0.0
        """Sum of the norms of all contact forces [N] at the last sample."""
        self.samples: tuple[ContactSample, ...] = ()
        """One a pair with a force, at the last sample."""

    def sample(self, data: mujoco.MjData) -> None:
        """Read all contacts."""
        if data.ncon == 0:
            self.force, self.samples = 0.0, ()
            return
        pairs: dict[tuple[int, int], Array] = {}
        self.force = 0.0
        wrench = self._wrench
        for index in range(data.ncon):
            mujoco.mj_contactForce(self._model, data, index, wrench)
            norm = float(np.linalg.norm(wrench[:3]))
            self.force += norm
            if norm == 0.0:
                continue
            contact = data.contact[index]
            first, second = self._owners[contact.geom1], self._owners[contact.geom2]
            # The rows of `frame` are the axes, the first from geom1 to geom2; the force is that on geom2.
            force = wrench[:3] @ contact.frame.reshape(3, 3)
            if first > second:
                first, second, force = second, first, -force
            entry = np.concatenate([force, norm * contact.pos, [norm]])
            pairs[second, first] = pairs[second, first] + entry if (second, first) in pairs else entry
        self.samples = tuple(
            ContactSample(
                link=self._names[link],
                other=self._names[other],
                force_in_world=_vector(entry[:3]),
                position_in_world=_vector(entry[3:6] / entry[6]),
            )
            for (link, other), entry in pairs.items()
        )


def _owners(model: mujoco.MjModel) -> list[int]:
    """Owner of every geom: its body, or −1 − index of the obstacle, so that of a pair the higher number is the link."""
    owners, obstacles = [], 0
    for index in range(model.ngeom):
        if model.geom(index).name.startswith(PREFIX):
            obstacles += 1
            owners.append(-obstacles)
        else:
            owners.append(int(model.geom_bodyid[index]))
    return owners


def _owner_names(model: mujoco.MjModel) -> dict[int, str]:
    names = {}
    for index, owner in enumerate(_owners(model)):
        names[owner] = model.geom(index).name.removeprefix(PREFIX) if owner < 0 else model.body(owner).name
    return names


def _moves(body: mujoco.MjsBody) -> bool:
    """Whether a joint lies between a body and the world."""
    while body.parent is not None:
        if body.joints:
            return True
        body = body.parent
    return False


def _vector(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
