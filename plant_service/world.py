"""Forces of the world on the robot's links: pushes and hands of the scenario, and loads set by hand.

All are computed at the start of the substep in which they act, from the state there, and added to the link's wrench at
its centre of mass (`xfrc_applied`), so that force/torque sensors feel them. A spring k with a damper d on the effective
mass m of its point, integrated semi-implicitly with the step h, is stable for h² k + 2 h d < 4 m: for the spring alone
that is ω h < 2.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from plant_service.errors import PlantError
from schemas.base import Vector3
from schemas.world import HandHeld, Push, WayPoint, World

Force = Callable[[float, Vector3], Vector3]
"""Force [N] in the world at a time [s] since sequence 0 on a point that is at a position [m] in the world."""

ROUNDING: Final = 1e-6
"""Of a substep: an event that begins this little after a substep begins with it."""
STABLE_SHARE: Final = 0.5
"""Of the bound of stability that a spring may use at the start: the effective mass changes with the posture."""


def minimum_jerk(share: float) -> float:
    """Give 10 x³ − 15 x⁴ + 6 x⁵ [Flash 1985], 0 below x = 0 and 1 above 1."""
    if share <= 0.0:
        return 0.0
    return 1.0 if share >= 1.0 else share**3 * (10.0 + share * (6.0 * share - 15.0))


def minimum_jerk_rate(share: float) -> float:
    """Give its derivative 30 x² (1 − x)², 0 outside [0, 1]."""
    return 30.0 * (share * (1.0 - share)) ** 2 if 0.0 < share < 1.0 else 0.0


def push_share(push: Push, elapsed_s: float) -> float:
    """Share of its greatest force that a push has at a time [s] since its start.

    Its integral over the duration T is T − ramp_s for a trapezoid, 2 T/π for a half sine.
    """
    left_s = push.duration_s - elapsed_s
    if elapsed_s < 0.0 or left_s < 0.0:
        return 0.0
    if push.shape == "half_sine":
        return math.sin(math.pi * elapsed_s / push.duration_s)
    nearest_s = min(elapsed_s, left_s)
    return 1.0 if nearest_s >= push.ramp_s else minimum_jerk(nearest_s / push.ramp_s)


def path_point(path: Sequence[WayPoint], elapsed_s: float) -> tuple[Vector3, Vector3]:
    """Displacement [m] and velocity [m/s] of a hand at a time [s] since its start, see `HandHeld.path`."""
    after = bisect_right(path, elapsed_s, key=_time)
    start_s, *start = path[after - 1] if after else (0.0, 0.0, 0.0, 0.0)
    if after == len(path):
        return (start[0], start[1], start[2]), (0.0, 0.0, 0.0)
    end_s, *end = path[after]
    share = (elapsed_s - start_s) / (end_s - start_s)
    position, rate = minimum_jerk(share), minimum_jerk_rate(share) / (end_s - start_s)
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    return (
        (start[0] + position * dx, start[1] + position * dy, start[2] + position * dz),
        (rate * dx, rate * dy, rate * dz),
    )


class LinkPoint:
    """A point of a link, seen through MuJoCo's arrays as they are now.

    Args:
        model: compiled.
        data: its state, which must outlive this.
        body: of the link.
        point_in_link: [m] in the frame of the URDF's link.

    """

    __slots__ = ("_centre", "_origin", "_point", "_root", "_rotation", "_spatial", "body")

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, body: int, point_in_link: Sequence[float]) -> None:
        self.body = body
        self._point = tuple(float(value) for value in point_in_link)
        self._origin, self._rotation, self._centre = data.xpos[body], data.xmat[body], data.xipos[body]
        self._spatial, self._root = data.cvel[body], data.subtree_com[model.body_rootid[body]]

    def position(self) -> Vector3:
        """Position in the world [m]."""
        x, y, z = self._point
        ox, oy, oz = self._origin.tolist()
        xx, xy, xz, yx, yy, yz, zx, zy, zz = self._rotation.tolist()
        return ox + xx * x + xy * y + xz * z, oy + yx * x + yy * y + yz * z, oz + zx * x + zy * y + zz * z

    def velocity(self, position: Vector3) -> Vector3:
        """Velocity in the world [m/s]; `position` as given by `position`."""
        wx, wy, wz, vx, vy, vz = self._spatial.tolist()  # MuJoCo's, at the centre of mass of the whole tree
        rx, ry, rz = self._arm(position, self._root.tolist())
        return vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx

    def add(self, wrench: list[float], position: Vector3, force: Vector3) -> None:
        """Add a force [N] at the point to force and moment at the link's centre of mass, both in the world."""
        fx, fy, fz = force
        rx, ry, rz = self._arm(position, self._centre.tolist())
        wrench[0] += fx
        wrench[1] += fy
        wrench[2] += fz
        wrench[3] += ry * fz - rz * fy
        wrench[4] += rz * fx - rx * fz
        wrench[5] += rx * fy - ry * fx

    @staticmethod
    def _arm(position: Vector3, origin: list[float]) -> Vector3:
        return position[0] - origin[0], position[1] - origin[1], position[2] - origin[2]


@dataclass(frozen=True, slots=True)
class _Load:
    """A force and when it acts: in substeps `first` ≤ tick < `last`."""

    name: str | None
    """Of the event; None: set by hand."""
    point: LinkPoint
    force: Force
    first: float = -math.inf
    last: float = math.inf


class WorldLoads:
    """The forces that act on one simulated robot.

    Args:
        model: compiled.
        data: its state, at the start posture.
        world: of the scenario.
        bodies: body of every link by name.
        substep_s: h.

    Raises:
        PlantError: an event names no link, or a hand is too stiff for the substep.

    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, world: World, bodies: dict[str, int], substep_s: float
    ) -> None:
        self._model, self._data, self._bodies = model, data, bodies
        self._applied = data.xfrc_applied
        self._substep_s = substep_s
        self.origin_ns: int | None = 0
        """Simulated time [ns] of sequence 0, from which event times count; None: not yet known, no event acts."""
        self.forces: dict[str, Vector3] = {}
        """Force [N] in the world of every event that acted in the last substep."""
        self._events = [self._event(index, event) for index, event in enumerate(world.events)]
        self._set: dict[str, _Load] = {}
        self._acting: list[_Load] = []
        self._loaded: set[int] = set()
        """Bodies whose wrench is not zero."""
        self._tick = 0

    def set_load(self, link: str, point_in_link: Sequence[float], force_in_world: Sequence[float]) -> None:
        """Load a point of a link [m, in its frame] with a force [N, in the world] until told otherwise.

        Raises:
            PlantError: the robot has no such link.

        """
        fx, fy, fz = (float(value) for value in force_in_world)
        self._set[link] = _Load(None, self._point("apply_wrench", link, point_in_link), lambda *_: (fx, fy, fz))

    def release(self, link: str) -> None:
        """Take away what `set_load` put on a link."""
        self._set.pop(link, None)

    def begin_period(self, time_ns: int, substeps: int) -> bool:
        """Tell whether anything acts in the period that begins; then `apply` is to be called at each substep."""
        if not self._events and not self._set and not self._loaded:
            return False
        acting = list(self._set.values())
        if self.origin_ns is not None:
            self._tick = first = round((time_ns - self.origin_ns) * 1e-9 / self._substep_s)
            acting += [load for load in self._events if load.first < first + substeps and load.last > first]
        bodies = {load.point.body for load in acting}
        for body in self._loaded - bodies:
            self._applied[body] = 0.0
        self._acting, self._loaded = acting, bodies
        self.forces.clear()
        return bool(acting)

    def apply(self, index: int) -> None:
        """Set the wrenches for a substep of the period, from the state at its start."""
        tick = self._tick + index
        time_s = tick * self._substep_s
        wrenches = {body: [0.0] * 6 for body in self._loaded}
        self.forces.clear()
        for load in self._acting:
            if load.first <= tick < load.last:
                position = load.point.position()
                force = load.force(time_s, position)
                load.point.add(wrenches[load.point.body], position, force)
                if load.name is not None:
                    self.forces[load.name] = force
        for body, wrench in wrenches.items():
            self._applied[body] = wrench

    def _event(self, index: int, event: Push | HandHeld) -> _Load:
        field = f"plant.world.events.{index}"
        point = self._point(f"{field}.link: {event.name}", event.link, event.point_in_link)
        end_s = event.start_s + event.duration_s
        if isinstance(event, HandHeld):
            self._check_stiffness(field, event, point)
            force: Force = _Hand(event, point)
            end_s += event.ramp_s
        else:
            force = _pushing(event)
        first, last = (math.ceil(time_s / self._substep_s - ROUNDING) for time_s in (event.start_s, end_s))
        return _Load(event.name, point, force, first, last)

    def _point(self, what: str, link: str, point_in_link: Sequence[float]) -> LinkPoint:
        body = self._bodies.get(link)
        if body is None:
            raise PlantError(f"{what}: the robot has no link {link!r}; it has {', '.join(self._bodies)}")
        return LinkPoint(self._model, self._data, body, point_in_link)

    def _check_stiffness(self, field: str, hand: HandHeld, point: LinkPoint) -> None:
        """Refuse a spring and damper that the substep cannot carry on the lightest direction of a point."""
        jacobian = np.zeros((3, self._model.nv))
        compliance = np.empty_like(jacobian)
        mujoco.mj_jac(self._model, self._data, jacobian, None, np.array(point.position()), point.body)
        mujoco.mj_solveM(self._model, self._data, compliance, jacobian)
        mobility = float(np.linalg.eigvalsh(jacobian @ compliance.T)[-1])
        step_s = self._substep_s
        asked = (step_s**2 * hand.stiffness + 2.0 * step_s * hand.damping) * mobility / 4.0
        if asked > STABLE_SHARE:
            raise PlantError(
                f"{field}.stiffness: {hand.name} with {hand.stiffness:g} N/m and {hand.damping:g} N·s/m on"
                f" {1.0 / mobility:.3g} kg, the least inertia of link {hand.link} there, is at {asked:.2g} of what"
                f" a substep of {step_s:g} s can carry; expected at most {STABLE_SHARE:g}: lower it, or plant.substep_s"
            )


class _Hand:
    """Force of a hand; it takes hold at its first call."""

    __slots__ = ("_hand", "_hold", "_point")

    def __init__(self, hand: HandHeld, point: LinkPoint) -> None:
        self._hand, self._point = hand, point
        self._hold: Vector3 | None = None

    def __call__(self, time_s: float, position: Vector3) -> Vector3:
        hand = self._hand
        if self._hold is None:
            self._hold = position
        elapsed_s = max(0.0, time_s - hand.start_s)
        moved, speed = path_point(hand.path, elapsed_s)
        velocity = self._point.velocity(position)
        k, d = hand.stiffness, hand.damping
        fx, fy, fz = (
            k * (hold + move - now) + d * (rate - true)
            for hold, move, now, rate, true in zip(self._hold, moved, position, speed, velocity, strict=True)
        )
        norm = math.sqrt(fx * fx + fy * fy + fz * fz)
        share = hand.force_limit / norm if norm > hand.force_limit else 1.0
        if elapsed_s > hand.duration_s:
            share *= 1.0 - minimum_jerk((elapsed_s - hand.duration_s) / hand.ramp_s)
        return share * fx, share * fy, share * fz


def _pushing(push: Push) -> Force:
    fx, fy, fz = push.force_in_world

    def force(time_s: float, _: Vector3) -> Vector3:
        share = push_share(push, max(0.0, time_s - push.start_s))  # the substep that it begins with may be rounded down
        return share * fx, share * fy, share * fz

    return force


def _time(way_point: WayPoint) -> float:
    return way_point[0]
