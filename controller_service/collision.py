"""Distances between the robot's capsules and from known obstacles, as rows A q̈ ≥ l of the QP."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from controller_service.model import Array, Configuration, RobotModel
from schemas.control_law import CollisionAvoidance
from schemas.errors import ConfigurationError
from schemas.load import Robot

Vector = list[float]
"""Three numbers in world axes: for a few pairs plain Python is quicker than arrays."""

SMALLEST_GRADIENT = 0.01
"""[m/rad]: below this norm of a distance's gradient no joint changes it noticeably, and it has no row."""
PARALLEL = 0.05
"""Least sin² of the angle between two axes that their bending counts with: the nearest points of parallel axes run off
at any speed, which must not ask for any acceleration."""


@dataclass(frozen=True, slots=True)
class CollisionRows:
    """A q̈ ≥ lower: first the rows of `names`, in the order of `CollisionModel.pairs`; the rest bound nothing."""

    A: Array
    """∂d/∂q (max_pairs, n) [m/rad]; unit rows where unused."""
    lower: Array
    """(max_pairs,) [m/s²]; −∞ where unused."""
    names: tuple[tuple[str, str], ...]
    """Capsules of the rows in use; an obstacle is the second of its pair."""
    distances: Array
    """d (rows in use,) [m] between the surfaces, negative in penetration."""


class CollisionModel:
    """Velocity dampers between capsules.

    [Faverjon and Tournassoud 1987], as in [Kanehiro et al. 2008]: with ξ, d_i, d_s of the configuration a pair may
    approach no faster than

        ḋ ≥ v(d) = min(−ξ (d − d_s)/(d_i − d_s), ξ),    d ≤ d_i

    so that d goes to d_s exponentially and never below, and a pair nearer than d_s is led apart, at ξ at most. It takes
    a deceleration of at most a = ξ²/(d_i − d_s) along the normal (4.2 m/s² with the schema's values): ξ must be chosen
    such that the motors have it beside gravity. (√(2 a (d − d_s)) is never slower there, so it is no bound of its own.)
    A pair that comes in faster than ξ must brake earlier, with the same a:

        ḋ ≥ v(d) = −√(ξ² + 2 a (d − d_i)),    d > d_i

    On accelerations, with n̂ from the second capsule to the first, J₁, J₂ the Jacobians of their nearest points, A =
    n̂ᵀ(J₁ − J₂) and response time t_v:

        A q̈ ≥ (v(d) − ḋ)/t_v − Ȧ q̇,    ḋ = A q̇

    A = wᵀ(S₁ − S₂) with the wrench w = [n̂; c × n̂] of the line through both nearest points, S the joints' screws in the
    world; Ȧ q̇ = wᵀ(Ṡ₁ − Ṡ₂) q̇ + `_Witness.bending`, which holds how the normal turns: n̂ᵀ(J̇₁ − J̇₂) q̇ is not all.

    Pairs with d < d_i, and those that all joints together at their speeds could make faster than v(d), get a row; when
    they are more than `max_pairs`, the nearest do. Rows depend on the configuration alone. Joints are revolute.

    Args:
        robot: with `capsules` and `collision_pairs`.
        config: distances, damper, obstacles; each obstacle is kept from all capsules that a joint moves.
        model: of the same robot; its constants are used, not its kinematics.
        response_s: t_v [s].

    Raises:
        ConfigurationError: a capsule of an unknown link, an obstacle named as another or as a capsule, a pair that no
            joint moves apart or that is named twice, or nothing to avoid.

    """

    def __init__(self, robot: Robot, config: CollisionAvoidance, model: RobotModel, response_s: float) -> None:
        self.braking = config.damping**2 / (config.influence_m - config.safe_m)
        """a [m/s²]: the largest deceleration that v(d) asks for."""
        self._config, self._response = config, response_s
        self._model, self._n = model.model, model.n
        self._data = self._model.createData()
        order = [self._model.joints[self._model.getJointId(name)].idx_v for name in model.names]
        self._order = None if order == list(range(self._n)) else np.array(order)
        self._place = None if self._order is None else np.argsort(self._order)
        self._shapes = tuple(_shapes(robot, config, self._model))
        self._pairs = tuple(_pairs(robot, self._shapes))
        both = [(self._shapes[first], self._shapes[second]) for first, second in self._pairs]
        self.pairs = tuple((first.name, second.name) for first, second in both)
        """All pairs that are kept apart."""
        self.max_pairs = config.max_pairs or len(self.pairs)
        """Number of rows."""
        geometry = pin.GeometryModel()
        for shape in self._shapes:
            capsule = pin.coal.Capsule(shape.radius, 2.0 * shape.half)
            geometry.addGeometryObject(pin.GeometryObject(shape.name, shape.joint, shape.placement, capsule))
        for first, second in self._pairs:
            geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._geometry, self._found = geometry, pin.GeometryData(geometry)
        # Views of these, made anew each time, would cost more than the distances
        self._results, self._placements = tuple(self._found.distanceResults), tuple(self._found.oMg)
        self._moves = np.array([first.support - second.support for first, second in both])
        self._fastest = np.array([np.maximum(first.levers, second.levers) for first, second in both])
        self._fastest *= np.abs(self._moves)
        """(pairs, n) [m]: |ḋ| ≤ this times |q̇|."""
        self._supports = np.array([shape.support for shape in self._shapes]).T
        self._unused = np.eye(self._n)[np.arange(self.max_pairs) % self._n]
        self._unbounded = np.full(self.max_pairs, -np.inf)
        self._unused.flags.writeable = self._unbounded.flags.writeable = False

    def distances(self, position: Array) -> Array:
        """Return d (pairs,) [m] of all pairs at q (n,) [rad]."""
        return self._measure(self._in_model_order(position))

    def rows(self, now: Configuration) -> CollisionRows:
        """Rows at a configuration."""
        q, v = self._in_model_order(now.position), self._in_model_order(now.velocity)
        d = self._measure(q)
        fastest = self._fastest.dot(np.abs(v))
        ahead = np.maximum(fastest * fastest - self._config.damping**2, 0.0) / (2.0 * self.braking)
        near = (d < self._config.influence_m + ahead).nonzero()[0]
        if not len(near):
            return CollisionRows(self._unused, self._unbounded, (), d[:0])
        if len(near) > self.max_pairs:
            near = np.sort(near[np.argsort(d[near], kind="stable")[: self.max_pairs]])
        return self._bounds(near, d[near], q, v)

    def _bounds(self, near: NDArray[np.intp], d: Array, q: Array, v: Array) -> CollisionRows:
        pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)
        screws, rates, moves = self._data.J, self._data.dJ, self._moves[near]
        twists = (screws * v).dot(self._supports).T.tolist()
        pairs = [(k, *self._pairs[k]) for k in near.tolist()]
        seen = [self._witness(k, first, second) for k, first, second in pairs]
        wrench = np.array([witness.wrench() for witness in seen])
        bending = [w.bending(twists[first], twists[second]) for w, (_, first, second) in zip(seen, pairs, strict=True)]
        gradient = wrench.dot(screws) * moves
        lower = (
            (self._allowed_speed(d) - gradient.dot(v)) / self._response - (wrench.dot(rates) * moves).dot(v) - bending
        )
        movable = (gradient * gradient).sum(axis=1) > SMALLEST_GRADIENT**2
        near, d, gradient, lower = near[movable], d[movable], gradient[movable], lower[movable]
        A, bounds = self._unused.copy(), self._unbounded.copy()
        A[: len(d)] = gradient if self._order is None else gradient[:, self._order]
        bounds[: len(d)] = lower
        return CollisionRows(A, bounds, tuple([self.pairs[k] for k in near.tolist()]), d)

    def _allowed_speed(self, d: Array) -> Array:
        xi, safe, influence = self._config.damping, self._config.safe_m, self._config.influence_m
        braking = np.sqrt(xi**2 + 2.0 * self.braking * np.maximum(d - influence, 0.0))
        return np.where(d > influence, -braking, np.minimum((safe - d) * (xi / (influence - safe)), xi))

    def _witness(self, pair: int, first: int, second: int) -> _Witness:
        """Nearest points of a pair's axes, from what `_measure` found."""
        result, shape1, shape2 = self._results[pair], self._shapes[first], self._shapes[second]
        axis1, axis2 = (self._placements[shape].rotation[:, 2].tolist() for shape in (first, second))
        normal: Vector = (-result.normal).tolist()
        if _dot(normal, normal) < 0.5:  # the axes cross, and any normal of both leads apart
            normal = np.linalg.svd(np.array([axis1, axis2]))[2][2].tolist()
        apart = result.min_distance + shape1.radius + shape2.radius
        point1 = [a + shape1.radius * b for a, b in zip(result.getNearestPoint1().tolist(), normal, strict=True)]
        point2 = [a - apart * b for a, b in zip(point1, normal, strict=True)]
        slide1 = axis1 if self._between_ends(first, point1, axis1) else None
        slide2 = axis2 if self._between_ends(second, point2, axis2) else None
        # In deep penetration a bending by 1/D would ask for any acceleration
        return _Witness(normal, point1, point2, slide1, slide2, max(apart, 0.5 * (shape1.radius + shape2.radius)))

    def _between_ends(self, shape: int, point: Vector, axis: Vector) -> bool:
        x, y, z = self._placements[shape].translation.tolist()
        return abs(_dot([point[0] - x, point[1] - y, point[2] - z], axis)) < self._shapes[shape].half - 1e-9

    def _measure(self, q: Array) -> Array:
        pin.computeDistances(self._model, self._data, self._geometry, self._found, q)
        return np.array([result.min_distance for result in self._results])

    def _in_model_order(self, array: Array) -> Array:
        return array if self._place is None else array[self._place]


@dataclass(frozen=True, slots=True)
class _Witness:
    """Nearest points of two capsules' axes, in the world."""

    normal: Vector
    """n̂, from the second to the first."""
    point1: Vector
    point2: Vector
    slide1: Vector | None
    """Direction of the axis that the nearest point may slide along; None at an end."""
    slide2: Vector | None
    apart: float
    """D [m] between the axes."""

    def wrench(self) -> Vector:
        """Return w = [n̂; c × n̂]."""
        return self.normal + _cross(self.point1, self.normal)

    def bending(self, twist1: Vector, twist2: Vector) -> float:
        """d̈ − wᵀ(v̇₁ − v̇₂) [m/s²] of bodies with twists v = [velocity at the world's origin; ω].

        n̂·(ω₁ × v₁ − ω₂ × v₂), v now of the nearest points, since these move, and (|Δ|² − |σ|²)/D, Δ the part of v₁ − v₂
        across n̂, since the normal turns. σ is how the nearest points slide apart along their axes e, so that n̂ stays
        normal to these: e·(Δ + σ) = ∓D n̂·(ω × e), − for the first.
        """
        normal, turn1, turn2 = self.normal, twist1[3:], twist2[3:]
        velocity1 = [a + b for a, b in zip(twist1, _cross(turn1, self.point1), strict=False)]
        velocity2 = [a + b for a, b in zip(twist2, _cross(turn2, self.point2), strict=False)]
        delta = [a - b for a, b in zip(velocity1, velocity2, strict=True)]
        square = _dot(delta, delta) - _dot(normal, delta) ** 2
        one = other = aligned = 0.0
        if self.slide1 is not None:
            one = -self.apart * _dot(normal, _cross(turn1, self.slide1)) - _dot(self.slide1, delta)
        if self.slide2 is not None:
            other = self.apart * _dot(normal, _cross(turn2, self.slide2)) + _dot(self.slide2, delta)
            aligned = 0.0 if self.slide1 is None else _dot(self.slide1, self.slide2)
        square -= (one**2 + other**2 + 2.0 * aligned * one * other) / max(1.0 - aligned**2, PARALLEL)
        moving = _dot(normal, _cross(turn1, velocity1)) - _dot(normal, _cross(turn2, velocity2))
        return moving + square / self.apart


@dataclass(frozen=True, slots=True)
class _Shape:
    """A capsule in its joint's frame, the axis along z of `placement`; n joints in Pinocchio's order."""

    name: str
    joint: int
    placement: pin.SE3
    half: float
    """Of the axis's length [m]."""
    radius: float
    support: Array
    """(n,) 1 for joints that move it."""
    levers: Array
    """(n,) [m]: how far its axis can be from that of a joint that moves it."""


def _shapes(robot: Robot, config: CollisionAvoidance, model: pin.Model) -> Iterator[_Shape]:
    """Capsules of the robot, then obstacles."""
    name, names = robot.description.name, set()
    for capsule in robot.description.capsules:
        if not model.existFrame(capsule.link, pin.FrameType.BODY):
            raise ConfigurationError(f"robot {name}: capsule {capsule.name!r}: the URDF has no link {capsule.link!r}")
        frame = model.frames[model.getFrameId(capsule.link, pin.FrameType.BODY)]
        start, end = (frame.placement.act(np.array(point)) for point in (capsule.start_in_link, capsule.end_in_link))
        yield _shape(model, capsule.name, frame.parentJoint, start, end, capsule.radius)
        names.add(capsule.name)
    for obstacle in config.obstacles:
        if obstacle.name in names:
            what = f"{obstacle.name!r} is also the name of a capsule of robot {name} or of another obstacle"
            raise ConfigurationError(f"controller.collision.obstacles: {what}; give it another name")
        start, end = np.array(obstacle.start_in_world), np.array(obstacle.end_in_world)
        yield _shape(model, obstacle.name, 0, start, end, obstacle.radius)
        names.add(obstacle.name)


def _shape(model: pin.Model, name: str, joint: int, start: Array, end: Array, radius: float) -> _Shape:
    length, up = float(np.linalg.norm(end - start)), np.array([0.0, 0.0, 1.0])
    along = (end - start) / length if length > 0.0 else up
    rotation = pin.Quaternion.FromTwoVectors(up, along).matrix()
    support, levers = np.zeros(model.nv), np.zeros(model.nv)
    lever = max(np.linalg.norm(start), np.linalg.norm(end))
    for index in reversed(list(model.supports[joint])[1:]):
        column = model.joints[index].idx_v
        support[column], levers[column] = 1.0, lever
        lever += np.linalg.norm(model.jointPlacements[index].translation)
    return _Shape(name, joint, pin.SE3(rotation, 0.5 * (start + end)), 0.5 * length, radius, support, levers)


def _pairs(robot: Robot, shapes: tuple[_Shape, ...]) -> Iterator[tuple[int, int]]:
    """Give the described pairs, then every moving capsule with every obstacle, by index among the shapes."""
    name, capsules = robot.description.name, robot.description.capsules
    index = {shape.name: i for i, shape in enumerate(shapes)}
    seen: set[frozenset[str]] = set()
    for pair in robot.description.collision_pairs:
        first, second = index[pair[0]], index[pair[1]]
        if frozenset(pair) in seen:
            raise ConfigurationError(f"robot {name}: collision_pairs: {pair} is named twice; leave one out")
        seen.add(frozenset(pair))
        if shapes[first].joint == shapes[second].joint:
            what = f"no joint moves {pair} apart, on {capsules[first].link!r} and {capsules[second].link!r}"
            raise ConfigurationError(f"robot {name}: collision_pairs: {what}; leave the pair out")
        yield first, second
    moving = [i for i in range(len(capsules)) if shapes[i].joint != 0]
    with_obstacles = [(i, k) for k in range(len(capsules), len(shapes)) for i in moving]
    if not with_obstacles and not seen:
        what = f"robot {name} has nothing to avoid; describe capsules and collision_pairs in its file"
        raise ConfigurationError(f"controller.collision: {what}, name obstacles, or leave controller.collision out")
    yield from with_obstacles


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
