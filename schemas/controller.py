"""The controller's configuration: gains, solver and the phases of a run."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from schemas.base import ControlMode, Model
from schemas.control_law import (
    AntiWindup,
    CollisionAvoidance,
    DisturbanceObserver,
    FrictionCompensation,
    HandForce,
    Leak,
    NullSpace,
    PositionTorque,
    SineWrench,
)

NonNegative = Annotated[float, Field(ge=0.0)]


OPTIONAL_PARTS = ("null_space", "friction_compensation", "observer", "hand_force", "collision", "position_torque")
"""Of `ControllerConfig`; an empty mapping takes a part with its defaults."""


class TaskGains(Model):
    """Gains of a motion task, (6)-(8) of [Benallegue 2021]: ẍ = K_p (x^d − x) + K_v (ẋ^d − ẋ) + ẍ^d."""

    stiffness: NonNegative
    """K_p [1/s²]."""
    damping: NonNegative
    """K_v [1/s]."""
    weight: NonNegative


class HandPath(Model):
    """A closed path of the hand at fixed orientation, started and left at rest (minimum-jerk along the path)."""

    shape: Literal["circle", "square"] = "circle"
    plane: Literal["xy", "yz", "xz"] = "yz"
    diameter_m: PositiveFloat
    lap_s: PositiveFloat
    laps: PositiveInt = 1


class JointPoint(Model):
    """A posture and when it is passed."""

    time_s: Annotated[float, Field(gt=0.0)]
    """Since the phase's start."""
    posture: dict[str, float]
    """Joint angles [rad]; joints not named stay where they were before."""


class JointPath(Model):
    """A motion through postures: a spline of fifth degree, at rest at its ends, C⁴ between (`controller_service`)."""

    points: Annotated[tuple[JointPoint, ...], Field(min_length=1)]
    """After the start, which is where the joints were."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for before, after in pairwise(self.points):
            if not before.time_s < after.time_s:
                raise ValueError(f"the point at {after.time_s:g} s does not come after the one at {before.time_s:g} s")
        return self


class GrowingSine(Model):
    """(a₀ + a t) sin(2π f t) about where the joint was, section 3.4.2 of [Del Prete 2016]."""

    amplitude: NonNegative = 0.0
    """a₀ [rad]."""
    growth: NonNegative = 0.0
    """a [rad/s]."""
    frequency_hz: PositiveFloat


class JointSines(Model):
    """Growing sinusoids of some joints, faded in and out so that they begin and end at rest."""

    joints: Annotated[dict[str, GrowingSine], Field(min_length=1)]
    fade_s: PositiveFloat = 0.5
    """Length of both ramps, along minimum-jerk curves."""


class Phase(Model):
    """A stretch of a run: the mode of the drives and what the tasks follow. What is absent is held."""

    name: str
    mode: ControlMode
    duration_s: PositiveFloat
    posture: dict[str, float] = Field(default_factory=dict)
    """Joint angles [rad] to reach by a minimum-jerk motion within the phase; joints not named stay."""
    hand_path: HandPath | None = None
    joint_path: JointPath | None = None
    joint_sines: JointSines | None = None
    torque_control: bool = False
    """Torque control through the position interface (`controller.position_torque`), in mode `position`."""
    wrench: SineWrench | None = None
    """To be exerted by the environment on the hand frame, with `torque_control`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        motions = {"posture": self.posture, "joint_path": self.joint_path, "joint_sines": self.joint_sines}
        named = [name for name, motion in motions.items() if motion]
        if len(named) > 1:
            raise ValueError(f"{' and '.join(named)} are both given; a phase has one motion of the joints")
        if self.torque_control and self.mode is not ControlMode.POSITION:
            raise ValueError(f"torque_control goes through drives in mode position, mode is {self.mode.value}")
        if self.wrench is not None and not self.torque_control:
            raise ValueError("wrench: a wrench is controlled with torque_control: true only")
        return self


class QpConfig(Model):
    """The quadratic program (5)."""

    solver: Literal["osqp", "daqp"] = "osqp"
    iterations: PositiveInt = 500
    """Upper bound on the solver's iterations a tick."""
    tolerance: PositiveFloat = 1e-6
    regularization: PositiveFloat = 1e-6
    """γ of (5)."""
    damper_s: PositiveFloat = 0.05
    """Time constant of the range limit's velocity damper: q̇ ≤ (q_max − q) / damper_s near the limit."""


class ControllerConfig(Model):
    """Gains of the law and the tasks, and the phases. λ times the period must not exceed 0.3 (see `lambda_`)."""

    gains: str | None = None
    """Where the rest came from: a packaged set (`paper`, `tuned`) or a YAML file of values for these fields, which the
    scenario's own override. Parts that are absent unless named (`OPTIONAL_PARTS`) take a set's values only where the
    scenario names them."""
    lambda_: Annotated[float, Field(alias="lambda", gt=0.0)] = 2.0
    """λ of K = λ diag(M) [1/s]. The integral loop's discrete pole sits near 1 − λT and a cycle of delay costs phase:
    λT ≤ 0.3 is required, well below is advised."""
    integral: Literal["passivity", "none"] = "passivity"
    """`passivity`: L s = (C + K) s of (3), (4); `none`: u = uʳ alone, the baseline without integral term."""
    leak: Leak | None = None
    """None: a pure integrator, s̃ = s."""
    anti_windup: AntiWindup = AntiWindup()
    null_space: NullSpace | None = None
    """None: the law (3) in all joints."""
    friction_compensation: FrictionCompensation | None = None
    observer: DisturbanceObserver | None = None
    hand_force: HandForce | None = None
    collision: CollisionAvoidance | None = None
    position_torque: PositionTorque | None = None
    initialize_integral: bool = True
    """Position→torque transition: start the integral term at the torque difference (section IV-A); False is naive."""
    velocity_cutoff_hz: PositiveFloat = 60.0
    """First-order low-pass on the differentiated positions."""
    posture: TaskGains = TaskGains(stiffness=25.0, damping=10.0, weight=1.0)
    hand_task: Literal["pose", "position", "orientation"] = "pose"
    """What of the hand a path or a hold controls; the rest follows the posture."""
    hand: TaskGains = TaskGains(stiffness=900.0, damping=60.0, weight=1000.0)
    qp: QpConfig = QpConfig()
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)]
