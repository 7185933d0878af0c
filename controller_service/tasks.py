"""Motion tasks as values: each gives A and b of (9) of [Benallegue 2021], to be met as A q̈ = b."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

import numpy as np
import pinocchio as pin

from controller_service.model import Array, Configuration, FrameKinematics
from schemas.controller import TaskGains


@dataclass(frozen=True, slots=True)
class PostureTarget:
    """Desired joint motion: q^d [rad], q̇^d [rad/s], q̈^d [rad/s²], all (n,)."""

    position: Array
    velocity: Array
    acceleration: Array


@dataclass(frozen=True, slots=True)
class PoseTarget:
    """Desired motion of a frame in world axes, in the layout of `FrameKinematics`."""

    position: Array
    """p^d (3,) [m]."""
    rotation: Array
    """R^d (3, 3), frame to world."""
    velocity: Array
    """[v^d; ω^d] (6,)."""
    acceleration: Array
    """[v̇^d; ω̇^d] (6,)."""


class Task(Protocol):
    """A weighted linear objective on q̈."""

    @property
    def weight(self) -> float:
        """Factor of ‖A q̈ − b‖²."""
        ...

    def linear(self) -> tuple[Array, Array]:
        """Return A (k, n) and b (k,)."""
        ...

    def add_to(self, P: Array, q: Array) -> None:
        """Add w AᵀA to P and −w Aᵀb to q, in place."""
        ...


@dataclass(frozen=True, slots=True)
class PostureTask:
    """(6): q̈^ob = K_p (q^d − q) + K_v (q̇^d − q̇) + q̈^d, A = I."""

    configuration: Configuration
    target: PostureTarget
    gains: TaskGains

    @property
    def weight(self) -> float:
        """Factor of ‖A q̈ − b‖²."""
        return self.gains.weight

    def linear(self) -> tuple[Array, Array]:
        """Return A (n, n), b (n,)."""
        return np.eye(len(self.target.position)), self._objective()

    def add_to(self, P: Array, q: Array) -> None:
        """Add w I to P and −w b to q, in place."""
        P.flat[:: len(q) + 1] += self.gains.weight
        q -= self.gains.weight * self._objective()

    def _objective(self) -> Array:
        now, target, gains = self.configuration, self.target, self.gains
        objective: Array = gains.stiffness * (target.position - now.position)
        objective += gains.damping * (target.velocity - now.velocity)
        objective += target.acceleration
        return objective


class InertialPostureTask(PostureTask):
    """(6) in the metric of M: w (q̈ − q̈^ob)ᵀ M (q̈ − q̈^ob).

    Beside a task J q̈ = b of much larger weight, q̈ = q̈^ob + M⁻¹Jᵀ(J M⁻¹Jᵀ)⁻¹(b − J q̈^ob): the dynamically consistent
    inverse, so the torque M q̈ that the task costs is Jᵀ f, and zᵀJᵀ f = 0 for every z of its null space.
    """

    __slots__ = ()

    def linear(self) -> tuple[Array, Array]:
        """Return A = Lᵀ, b = Lᵀ q̈^ob with M = L Lᵀ."""
        root = np.asarray(np.linalg.cholesky(self.configuration.mass).T, np.float64)
        return root, root.dot(self._objective())

    def add_to(self, P: Array, q: Array) -> None:
        """Add w M to P and −w M q̈^ob to q, in place."""
        weighted = self.gains.weight * self.configuration.mass
        P += weighted
        q -= weighted.dot(self._objective())


@dataclass(frozen=True, slots=True)
class PoseTask:
    """Position (7) and orientation (8) of a frame; A = J, b = [v̇^ob; ω̇^ob] − J̇ q̇ (9), (6, n) and (6,)."""

    rows: ClassVar[slice] = slice(0, 6)
    """Of the frame's motion that the task asks for: linear, then angular."""
    configuration: Configuration
    frame: str
    target: PoseTarget
    gains: TaskGains

    @property
    def weight(self) -> float:
        """Factor of ‖A q̈ − b‖²."""
        return self.gains.weight

    def linear(self) -> tuple[Array, Array]:
        """Return A (k, n), b (k,), k the number of `rows`."""
        now, target, gains = self.configuration.frames[self.frame], self.target, self.gains
        objective: Array = gains.stiffness * pose_error(target, now)
        objective += gains.damping * (target.velocity - now.velocity)
        objective += target.acceleration
        objective -= now.drift
        return now.jacobian[self.rows], objective[self.rows]

    def add_to(self, P: Array, q: Array) -> None:
        """Add w JᵀJ to P and −w Jᵀb to q, in place."""
        A, b = self.linear()
        weighted = self.gains.weight * A.T
        P += weighted.dot(A)
        q -= weighted.dot(b)


class PositionTask(PoseTask):
    """Position (7) of a frame alone: its orientation is free."""

    __slots__ = ()
    rows = slice(0, 3)


class OrientationTask(PoseTask):
    """Orientation (8) of a frame alone: its position is free."""

    __slots__ = ()
    rows = slice(3, 6)


FRAME_TASKS: Final = {"pose": PoseTask, "position": PositionTask, "orientation": OrientationTask}
"""By the names of `ControllerConfig.hand_task`."""


def pose_error(target: PoseTarget, now: FrameKinematics) -> Array:
    """[p^d − p; Ω̃] (6,) of (7) and (8), world axes."""
    error = np.empty(6)
    error[:3] = target.position - now.position
    error[3:] = orientation_error(target.rotation, now.rotation)
    return error


def orientation_error(desired: Array, current: Array) -> Array:
    """Ω̃ = S⁻¹(log(R^d Rᵀ)) of (8): the rotation vector (3,) [rad] in world axes from `current` to `desired`."""
    error: Array = pin.log3(desired.dot(current.T))
    return error
