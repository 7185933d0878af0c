"""Desired motions as functions of time: minimum-jerk posture changes and closed paths of the hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from controller_service.model import Array
from controller_service.tasks import PoseTarget, PostureTarget
from schemas.controller import HandPath

AXES = {"xy": (0, 1), "yz": (1, 2), "xz": (0, 2)}
"""World axes of a path's plane."""


def minimum_jerk(time_s: float, duration_s: float) -> tuple[float, float, float]:
    """Σ(t), Σ̇, Σ̈ of 10 r³ − 15 r⁴ + 6 r⁵, r = t / duration: from 0 to 1, at rest at both ends and beyond."""
    r = min(max(time_s / duration_s, 0.0), 1.0)
    value = r * r * r * (10.0 + r * (6.0 * r - 15.0))
    rate = 30.0 * r * r * (1.0 - r) * (1.0 - r) / duration_s
    acceleration = 60.0 * r * (1.0 - r) * (1.0 - 2.0 * r) / duration_s**2
    return value, rate, acceleration


@dataclass(frozen=True, slots=True)
class PostureMotion:
    """A minimum-jerk motion between two postures (n,) [rad]."""

    start: Array
    end: Array
    duration_s: float

    def at(self, time_s: float) -> PostureTarget:
        """q^d, q̇^d, q̈^d."""
        value, rate, acceleration = minimum_jerk(time_s, self.duration_s)
        change = self.end - self.start
        return PostureTarget(self.start + value * change, rate * change, acceleration * change)


class HandMotion(Protocol):
    """What the hand is to do over a phase."""

    def at(self, time_s: float) -> PoseTarget:
        """Pose, velocity and acceleration at a time since the phase's start."""
        ...


@dataclass(frozen=True, slots=True)
class HandHold:
    """A pose held: position (3,) [m] in the world, rotation (3, 3) to the world."""

    position: Array
    rotation: Array

    def at(self, time_s: float) -> PoseTarget:
        """Return the pose, at rest."""
        zero = np.zeros(6)
        return PoseTarget(self.position, self.rotation, zero, zero)


@dataclass(frozen=True, slots=True)
class CirclePath:
    """Laps of a circle through the start, in the path's plane, its centre at −r along the plane's first axis.

    The angle goes from 0 to 2π·laps by one minimum-jerk motion.
    """

    start: Array
    rotation: Array
    path: HandPath

    def at(self, time_s: float) -> PoseTarget:
        """Pose, velocity, acceleration; the rotation is fixed."""
        total = 2.0 * math.pi * self.path.laps
        value, rate, acceleration = minimum_jerk(time_s, self.path.lap_s * self.path.laps)
        angle, rate, acceleration = total * value, total * rate, total * acceleration
        first, second = AXES[self.path.plane]
        radius = 0.5 * self.path.diameter_m
        sine, cosine = math.sin(angle), math.cos(angle)
        position, speed, change = self.start.copy(), np.zeros(6), np.zeros(6)
        position[first] += radius * (cosine - 1.0)
        position[second] += radius * sine
        speed[first] = -radius * sine * rate
        speed[second] = radius * cosine * rate
        change[first] = -radius * (sine * acceleration + cosine * rate * rate)
        change[second] = radius * (cosine * acceleration - sine * rate * rate)
        return PoseTarget(position, self.rotation, speed, change)


@dataclass(frozen=True, slots=True)
class SquarePath:
    """Laps of a square with a corner at the start, each side, `diameter_m` long, by a minimum-jerk motion.

    The hand rests at each corner. It goes along −first axis, +second, +first, −second of the path's plane.
    """

    start: Array
    rotation: Array
    path: HandPath

    def at(self, time_s: float) -> PoseTarget:
        """Pose, velocity, acceleration; the rotation is fixed."""
        side_s = 0.25 * self.path.lap_s
        index = min(max(int(time_s / side_s), 0), 4 * self.path.laps - 1)
        value, rate, acceleration = minimum_jerk(time_s - index * side_s, side_s)
        side = index % 4
        axis = AXES[self.path.plane][side % 2]
        length = self.path.diameter_m * (-1.0, 1.0, 1.0, -1.0)[side]
        position, speed, change = self.start.copy(), np.zeros(6), np.zeros(6)
        first, second = AXES[self.path.plane]
        position[first] -= self.path.diameter_m * (side in (1, 2))
        position[second] += self.path.diameter_m * (side in (2, 3))
        position[axis] += length * value
        speed[axis] = length * rate
        change[axis] = length * acceleration
        return PoseTarget(position, self.rotation, speed, change)


def hand_motion(start: Array, rotation: Array, path: HandPath | None) -> HandMotion:
    """Make the motion of a phase from a pose: the path, or the pose held."""
    if path is None:
        return HandHold(start, rotation)
    return (CirclePath if path.shape == "circle" else SquarePath)(start, rotation, path)
