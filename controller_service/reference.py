"""Desired motions as functions of time: of the joints (minimum jerk, splines, sines) and closed paths of the hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import make_interp_spline

from controller_service.model import Array
from controller_service.tasks import PoseTarget, PostureTarget
from schemas.controller import HandPath, JointPath, JointSines

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


class JointReference(Protocol):
    """What the joints are to do over a phase; at rest before its start and after its end."""

    def at(self, time_s: float) -> PostureTarget:
        """q^d, q̇^d, q̈^d, each (n,), at a time since the phase's start."""
        ...


class JointSpline:
    """A spline of fifth degree through postures, with zero velocity and acceleration at both ends.

    Args:
        start: posture (n,) [rad] at time 0.
        path: points after it.
        names: of the joints.

    """

    def __init__(self, start: Array, path: JointPath, names: tuple[str, ...]) -> None:
        postures, times = [start], [0.0]
        for point in path.points:
            posture = postures[-1].copy()
            for name, angle in point.posture.items():
                posture[names.index(name)] = angle
            postures.append(posture)
            times.append(point.time_s)
        still = np.zeros((2, len(start)))
        ends = [(order, row) for order, row in enumerate(still, 1)]
        self._spline = make_interp_spline(times, np.array(postures), k=5, bc_type=(ends, ends))
        self._end_s = times[-1]
        self._last = postures[-1]

    def at(self, time_s: float) -> PostureTarget:
        """q^d, q̇^d, q̈^d."""
        if not 0.0 <= time_s < self._end_s:
            still = np.zeros_like(self._last)
            return PostureTarget(self._last if time_s > 0.0 else self._spline(0.0), still, still)
        return PostureTarget(*(self._spline(time_s, order) for order in range(3)))


class JointSineMotion:
    """q^d = q_0 + w(t) (a₀ + a t) sin(2π f t), section 3.4.2 of [Del Prete 2016].

    w fades in and out along minimum-jerk curves, so that the motion begins and ends at rest.

    Args:
        start: posture q_0 (n,) [rad].
        sines: of some joints.
        names: of all.
        duration_s: of the phase.

    """

    def __init__(self, start: Array, sines: JointSines, names: tuple[str, ...], duration_s: float) -> None:
        self._start, self._fade, self._duration = start, sines.fade_s, duration_s
        self._amplitude, self._growth, self._rate = (np.zeros(len(names)) for _ in range(3))
        for name, sine in sines.joints.items():
            index = names.index(name)
            self._amplitude[index], self._growth[index] = sine.amplitude, sine.growth
            self._rate[index] = 2.0 * math.pi * sine.frequency_hz

    def at(self, time_s: float) -> PostureTarget:
        """q^d, q̇^d, q̈^d by the product rule."""
        rising, falling = minimum_jerk(time_s, self._fade), minimum_jerk(self._duration - time_s, self._fade)
        w = rising[0] * falling[0]
        dw = rising[1] * falling[0] - rising[0] * falling[1]
        ddw = rising[2] * falling[0] - 2.0 * rising[1] * falling[1] + rising[0] * falling[2]
        size = self._amplitude + self._growth * time_s
        a, da, dda = w * size, dw * size + w * self._growth, ddw * size + 2.0 * dw * self._growth
        sine, cosine, rate = np.sin(self._rate * time_s), np.cos(self._rate * time_s), self._rate
        return PostureTarget(
            self._start + a * sine,
            da * sine + a * rate * cosine,
            dda * sine + 2.0 * da * rate * cosine - a * rate * rate * sine,
        )


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
