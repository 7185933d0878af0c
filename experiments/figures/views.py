"""Views of arm and obstacles in a plane of the world, to scale."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from controller_service.model import RobotModel
from deploy.series import Array
from experiments.figures.drawing import AXES, BINS
from schemas.load import Robot
from schemas.robot import Capsule
from schemas.world import Box, Pole

POLE_STYLE: Final[dict[str, Any]] = {"facecolor": "#8a8a8a", "edgecolor": "#444444", "linewidth": 0.8}
ROUND: Final = np.linspace(0.0, 2.0 * np.pi, 49)
Plane = tuple[int, int]
"""Indices of two world axes: to the right and up."""


def plane_axes(axis: Axes, plane: Plane) -> None:
    """Name the axes of a view, both to one scale."""
    axis.set(xlabel=f"{AXES[plane[0]]} [m]", ylabel=f"{AXES[plane[1]]} [m]")
    axis.set_aspect("equal", adjustable="datalim")


def path_line(axis: Axes, path: Array, plane: Plane, **style: Any) -> None:
    """Draw a path (K, 3) [m], with no more points than the eye sees."""
    step = max(1, len(path) // (2 * BINS))
    axis.plot(path[::step, plane[0]], path[::step, plane[1]], **style)


def draw_obstacle(axis: Axes, obstacle: Pole | Box, plane: Plane, **style: Any) -> None:
    """Draw what an obstacle covers in a view."""
    if isinstance(obstacle, Pole):
        outline = capsule_outline((obstacle.start_in_world, obstacle.end_in_world), obstacle.radius, plane)
    else:
        outline = _box_outline(obstacle, plane)
    axis.add_patch(Polygon(outline, closed=True, **{**POLE_STYLE, **style}))


def capsule_outline(ends: Sequence[Sequence[float]], radius: float, plane: Plane) -> Array:
    """Outline (N, 2) [m] of a capsule between two points in the world: two discs and all between."""
    circle = radius * np.column_stack((np.cos(ROUND), np.sin(ROUND)))
    return _hull(np.concatenate([np.array(end)[list(plane)] + circle for end in ends]))


class ArmView:
    """The robot's links on the way to the hand, and its capsules, at any joint position.

    Args:
        robot: with a hand frame.

    """

    def __init__(self, robot: Robot) -> None:
        self._model = RobotModel(robot)
        self._links = _chain(robot)
        self._capsules = robot.description.capsules

    def points(self, position: Array) -> Array:
        """Origins (L, 3) [m] in the world of the links from the base to the hand, at joint positions (n,) [rad]."""
        return np.array([self._model.pose(position, link)[0] for link in self._links]).reshape(-1, 3)

    def draw(self, axis: Axes, position: Array, plane: Plane, colour: str, label: str) -> None:
        """Draw the moving capsules as shadows, and a line through the links' origins."""
        for capsule in self._capsules:
            if capsule.link not in self._links[:1]:
                axis.add_patch(self._shadow(capsule, position, plane, facecolor=colour, alpha=0.10, zorder=0.9))
        points = self.points(position)
        x, y = points[:, plane[0]], points[:, plane[1]]
        axis.plot(x, y, color=colour, linewidth=1.8, marker="o", markersize=3.0, label=label, zorder=3)

    def draw_body(self, axis: Axes, plane: Plane) -> None:
        """Draw the capsules of the base, which fill the view but do not widen it."""
        for capsule in self._capsules:
            if capsule.link in self._links[:1]:
                axis.add_artist(self._shadow(capsule, np.zeros(self._model.n), plane, facecolor="#eeeeee", zorder=0.5))

    def _shadow(self, capsule: Capsule, position: Array, plane: Plane, **style: Any) -> Polygon:
        origin, rotation = self._model.pose(position, capsule.link)
        ends = [(rotation @ np.array(end) + origin).tolist() for end in (capsule.start_in_link, capsule.end_in_link)]
        return Polygon(capsule_outline(ends, capsule.radius, plane), closed=True, linewidth=0, **style)


def _chain(robot: Robot) -> tuple[str, ...]:
    """Links of the URDF from its root to the hand; none without a hand frame."""
    parents: dict[str, str] = {}
    for joint in ElementTree.fromstring(robot.urdf).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    links = [robot.description.hand_frame] if robot.description.hand_frame else []
    while links and links[-1] in parents:
        links.append(parents[links[-1]])
    return tuple(reversed(links))


def _box_outline(box: Box, plane: Plane) -> Array:
    w, *v = box.orientation_to_world
    axis = np.array(v)
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * np.array(box.half_sizes)
    turned = corners + 2.0 * np.cross(axis, np.cross(axis, corners) + w * corners)  # q v q* of a unit quaternion
    return _hull((turned + np.array(box.position_in_world))[:, list(plane)])


def _hull(points: Array) -> Array:
    return np.asarray(points[ConvexHull(points).vertices], np.float64)
