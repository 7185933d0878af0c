"""Force control of the hand in the QP, section III-E of [Benallegue 2021]: admittance (27) and the wrench task."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from controller_service.model import Array, Configuration
from controller_service.tasks import PoseTarget, PoseTask, pose_error
from controller_service.wrench import HandWrench
from schemas.control_law import Admittance, WrenchTask
from schemas.controller import TaskGains
from schemas.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class WrenchReference:
    """F^r and Ḟ^r (6,) of the environment on the hand, world axes [N, N·m, and per second]."""

    wrench: Array
    rate: Array

    @classmethod
    def zero(cls) -> Self:
        """F^r = 0: the hand gives way to every force. Also where a wrench task starts."""
        return cls(np.zeros(6), np.zeros(6))

    def after(self, wrench: Array, elapsed_s: float) -> WrenchReference:
        """Make the reference of the next tick from the F^r (6,) that the QP found now, Ḟ^r by finite difference."""
        return WrenchReference(wrench, (wrench - self.wrench) / elapsed_s)


@dataclass(frozen=True, slots=True)
class HybridGains:
    """Gains of a `HybridPoseTask`: a number for each world direction, three linear and three angular, all (6,)."""

    stiffness: Array
    """K_p of the pose [1/s²], 0 where force is controlled."""
    damping: float
    """K_v of the pose [1/s], in all directions: without it (27) is a double integrator on a stiff environment."""
    force: Array
    """K_p of (27) [m/s²/N, rad/s²/(N·m)], 0 where the pose is controlled."""
    force_rate: Array
    """K_v of (27) [m/s/N, rad/s/(N·m)]."""
    root_weight: Array
    """√w: w of the admittance where force is controlled, of the pose elsewhere."""

    @classmethod
    def of(cls, pose: TaskGains, admittance: Admittance) -> Self:
        """Divide the directions by `admittance.directions`; once for a run, not each tick."""
        by_force = np.array(admittance.directions)
        gain = np.repeat([admittance.force_gain, admittance.torque_gain], 3)
        rate_gain = np.repeat([admittance.force_rate_gain, admittance.torque_rate_gain], 3)
        return cls(
            stiffness=np.where(by_force, 0.0, pose.stiffness),
            damping=pose.damping,
            force=np.where(by_force, gain, 0.0),
            force_rate=np.where(by_force, rate_gain, 0.0),
            root_weight=np.sqrt(np.where(by_force, admittance.weight, pose.weight)),
        )


@dataclass(frozen=True, slots=True)
class HybridPoseTask:
    """Pose (7), (8) and admittance (27) of one frame in one task; A = √w J, b = √w (ẍ^ob − J̇ q̇).

        ẍ^ob = K_p e + K_v (ẋ^d − ẋ) + ẍ^d − K_p^f (F^r − F) − K_v^f (Ḟ^r − Ḟ)

    e is the pose error, ẋ, F and Ḟ are in world axes. In directions controlled by force K_p is 0, elsewhere K_p^f and
    K_v^f are (hybrid control).

    The paper lets a pose and an admittance task combine in the QP. As two tasks on the same J they do not add up:
    w₁‖J q̈ − b₁‖² + w₂‖J q̈ − b₂‖² is (w₁ + w₂)‖J q̈ − b‖² and a constant, with the mean
    b = (w₁ b₁ + w₂ b₂)/(w₁ + w₂). With equal weights, as in Table I, damping, stiffness and admittance would all be
    half of what they say, and in a direction without force control the admittance task's zero would still halve the
    pose's gains. So their objectives are summed here before they become a row, with J̇ q̇ once.
    """

    configuration: Configuration
    frame: str
    target: PoseTarget
    gains: HybridGains
    reference: WrenchReference
    measured: HandWrench
    """Its moment must be at the frame's origin."""
    rows: slice = field(default_factory=lambda: PoseTask.rows)
    """Of the frame's motion that the task asks for; `rows` of a class of `tasks.FRAME_TASKS`."""

    @property
    def weight(self) -> float:
        """1: the rows hold their weights."""
        return 1.0

    def linear(self) -> tuple[Array, Array]:
        """Return A (k, n), b (k,), k the number of `rows`."""
        now, target, gains = self.configuration.frames[self.frame], self.target, self.gains
        objective: Array = gains.stiffness * pose_error(target, now)
        objective += gains.damping * (target.velocity - now.velocity)
        objective += target.acceleration
        objective += gains.force * (self.measured.wrench - self.reference.wrench)
        objective += gains.force_rate * (self.measured.rate - self.reference.rate)
        objective -= now.drift
        objective *= gains.root_weight
        rows = self.rows
        return gains.root_weight[rows, None] * now.jacobian[rows], objective[rows]

    def add_to(self, P: Array, q: Array) -> None:
        """Add AᵀA to P and −Aᵀb to q, in place."""
        A, b = self.linear()
        P += A.T.dot(A)
        q -= b.dot(A)


@dataclass(frozen=True, slots=True)
class WrenchVariables:
    """The wrench F^r as six more variables of the QP, and step (a)'s task on them.

    x = [q̈; F^r] (n + 6,). With ρ^r = F^r itself in place of the coefficients of friction cones, W_l is the identity:
    ½ w ‖F^r − F^d‖², each component between 0 and F^d: a wrench that nobody asked for would let the QP count on help
    from outside where a torque limit binds. The torque that F^r saves or costs couples it to q̈: (2) gives
    u = M q̈ + h − Jᵀ F^r, so that F^r is what is left of F^d where a torque limit does not allow more.

    Motion tasks are added to the blocks P[:n, :n] and q[:n] of the program.
    """

    frame: str
    """The hand's."""
    n: int
    """Joints."""
    weight: float
    """w of ‖F^r − F^d‖²."""
    desired: Array
    """F^d (6,) [N, N·m], environment on the hand, world axes, moment at the hand frame's origin."""
    lower: Array
    """(6,)"""
    upper: Array
    """(6,)"""

    @classmethod
    def of(cls, frame: str, n: int, config: WrenchTask) -> Self:
        """Take F^d, w and bounds from the configuration, for the hand frame of a robot of n joints.

        Raises:
            ConfigurationError: F^d beyond the bounds.

        """
        desired = np.array(config.force_in_world + config.torque_in_world)
        for what, limit, values in (
            ("force", config.force_limit, config.force_in_world),
            ("torque", config.torque_limit, config.torque_in_world),
        ):
            largest = max(map(abs, values))
            if largest > limit:
                raise ConfigurationError(
                    f"controller.hand_force.wrench_task: a component of {what}_in_world is {largest:g}, beyond"
                    f" {what}_limit {limit:g}; ask for less or raise the limit"
                )
        return cls(frame, n, config.weight, desired, np.minimum(desired, 0.0), np.maximum(desired, 0.0))

    def add_to(self, P: Array, q: Array) -> None:
        """Add w I to the lower right block of P (n + 6, n + 6) and −w F^d to the end of q (n + 6,), in place."""
        size = self.n + 6
        P.flat[self.n * (size + 1) :: size + 1] += self.weight
        q[self.n :] -= self.weight * self.desired

    def coupling(self, now: Configuration) -> Array:
        """−Jᵀ (n, 6) of the hand: what stands beside M in the torque rows, u − h = [M, −Jᵀ] x."""
        columns: Array = -now.frames[self.frame].jacobian.T
        return columns
