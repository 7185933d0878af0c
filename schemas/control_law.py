"""Parts of the controller that the papers add to its law, each a model of its own with the paper's values."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from schemas.base import Model, Vector3

NonNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Leak(Model):
    """Leaky integration, (12)-(14): s̃ = μ s^θf + (1 − μ) s^θs."""

    slow_rate: NonNegative = 0.1
    """θ_s [1/s]."""
    fast_rate: NonNegative = 100.0
    """θ_f [1/s]."""
    fast_share: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5
    """μ; below 1, since the torque at the change of mode goes into the slow state."""


class AntiWindup(Model):
    """Limit of the integral torque u_K, section III-B."""

    method: Literal["qp", "scaling", "none"] = "qp"
    """`qp`: (11); `scaling`: λ_w u_K with (10), the baseline; `none`: unlimited."""
    solver: Literal["dual", "osqp"] = "dual"
    """Of (11): its one-dimensional dual, or OSQP."""
    torque_share: PositiveFloat = 0.1
    """τ_m over the joint's torque limit."""
    decay_s: PositiveFloat = 0.5
    """Time constant with which the bound falls to τ_m after a change of mode that asked for more."""
    back_calculation: NonNegative = 0.0
    """κ [1/s]: rate at which the slow state follows the limited torque while the limit acts, so that it leaves the
    limit at once when the error turns round. 0, as in the paper, lets the state wind up behind the limited torque."""


class NullSpace(Model):
    """Null-space compliance, section III-D, while the hand task runs."""

    inverse: Literal["pseudo", "dynamic"] = "dynamic"
    """J⁺: Moore-Penrose, or dynamically consistent M⁻¹Jᵀ(J M⁻¹ Jᵀ)⁻¹."""
    posture_metric: Literal["inertia", "joint"] = "inertia"
    """Metric in which the QP's posture task is met beside the hand task. With `inertia` (M) what the hand task adds,
    M (q̈ʳ − q̈^ob), is a pure task torque; with `joint` (I) it loads the null space while the hand is off its place."""
    fade_s: PositiveFloat = 1.0
    """The law goes over from (3) to (21) in this time; back it goes at once, from the torque that acts."""
    smallest_singular_value: PositiveFloat = 0.08
    """Of J (metres and radians): below, J⁺ is not trusted and the law goes back to (3); it returns above 1.2 times
    this. The derivative terms of (21) grow as its inverse."""


class JointFriction(Model):
    """Friction of a joint, at the joint: τ_f = c sign(q̇) + v q̇."""

    coulomb: NonNegative
    """c [N·m]."""
    viscous: NonNegative
    """v [N·m·s/rad]."""


class FrictionCompensation(Model):
    """Share of a friction model that is given to the motors in advance, smooth at zero velocity."""

    coulomb: NonNegative = 0.04
    """c at the motor [N·m], of every joint without an entry in `joints`; the joint feels it times its gear."""
    viscous: NonNegative = 0.0005
    """v at the motor [N·m·s/rad]; the joint feels it times the square of its gear."""
    joints: dict[str, JointFriction] = Field(default_factory=dict)
    """Identified friction, at the joint, instead of the above."""
    share: Share = 0.6
    """Of the model: what the true friction is surely not below, so that it is never over-compensated."""
    smoothing_velocity: PositiveFloat = 0.2
    """[rad/s]: the Coulomb part is c tanh(q̇/v_0). Its slope share · c/v_0 is negative damping at low speed, and slow
    motion needs it below about half of M_jj (λ + K_v) or it sticks and slips (`controller_service.friction`)."""


class DisturbanceObserver(Model):
    """Momentum-based observer of external joint torques, and what a contact does."""

    bandwidth: PositiveFloat = 15.0
    """K_O [1/s]."""
    coulomb: NonNegative = 0.04
    """Friction known at the motor [N·m], taken from the estimate; the rest of the friction appears in it."""
    viscous: NonNegative = 0.0005
    """[N·m·s/rad] at the motor."""
    threshold_share: PositiveFloat = 0.4
    """Threshold over the torque limit, of joints without an entry in `thresholds`."""
    thresholds: dict[str, PositiveFloat] = Field(default_factory=dict)
    """[N·m] a joint."""
    reaction: Literal["none", "event", "compliant", "stop"] = "event"
    """`event`: tell; `compliant`: tell, and while the contact lasts keep nothing but the damping of all tasks, at rest
    and with the integral as before the contact, then go on from where the robot is; `stop`: tell, and stop safely."""
    dwell_s: NonNegative = 0.3
    """A contact is over when all joints have been below half their threshold for this time."""


class WrenchTask(Model):
    """Step (a) of section III-E: the wrench that the QP is asked to exert, weight of ‖F − F^d‖²."""

    weight: PositiveFloat = 10.0
    force_in_world: Vector3 = (0.0, 0.0, 0.0)
    """F^d [N] of the environment on the hand, world axes."""
    torque_in_world: Vector3 = (0.0, 0.0, 0.0)
    """[N·m] at the hand frame's origin."""
    force_limit: PositiveFloat = 200.0
    """Largest component [N] that F^d may have; Fʳ lies between 0 and F^d."""
    torque_limit: PositiveFloat = 30.0
    """[N·m]."""


class Admittance(Model):
    """Step (b), (27): ẍ = −K_p (F^r − F) − K_v (Ḟ^r − Ḟ), F of the environment on the hand. Table I's values."""

    force_gain: NonNegative = 5e-3
    """K_p [m/s² / N]."""
    force_rate_gain: NonNegative = 1e-7
    """K_v [m/s / N]."""
    torque_gain: NonNegative = 5e-3
    """[rad/s² / N·m]."""
    torque_rate_gain: NonNegative = 1e-7
    weight: NonNegative = 10000.0
    directions: tuple[bool, bool, bool, bool, bool, bool] = (True, True, True, True, True, True)
    """World directions (three of force, three of moment) that are controlled by force: there the pose task keeps its
    damping and loses its stiffness (hybrid control)."""


class DualCompliance(Model):
    """Switches the admittance on while the hand is pushed, and keeps the place where it is released (section IV-C)."""

    force_on: PositiveFloat = 15.0
    """[N]: a larger force at the hand switches it on."""
    force_off: PositiveFloat = 6.0
    """[N]: below for `dwell_s` switches it off."""
    dwell_s: NonNegative = 0.15

    @model_validator(mode="after")
    def _check(self) -> DualCompliance:
        if not self.force_off < self.force_on:
            raise ValueError(f"force_off {self.force_off:g} N must lie below force_on {self.force_on:g} N")
        return self


class HandForce(Model):
    """Force control of the hand by its force/torque sensor, section III-E."""

    sensor: str
    """Name of a sensor of the robot; what lies beyond it is taken from its reading by the URDF's inertias."""
    cutoff_hz: PositiveFloat = 20.0
    """First-order low-pass of the wrench."""
    wrench_task: WrenchTask | None = None
    """None: F^r = 0."""
    admittance: Admittance = Admittance()
    dual_compliance: DualCompliance | None = None
    """None: the admittance is always on."""

    @model_validator(mode="after")
    def _check(self) -> HandForce:
        turning = self.admittance.directions[3:]
        if self.dual_compliance is not None and any(turning) and not all(turning):
            raise ValueError(
                "admittance.directions: with dual_compliance the hand is led in all three moments or in none, since an"
                f" orientation is kept or given up as a whole; got {list(turning)}"
            )
        return self


class WorldCapsule(Model):
    """An obstacle that the controller knows."""

    name: str
    start_in_world: Vector3
    end_in_world: Vector3
    radius: PositiveFloat


class CollisionAvoidance(Model):
    """Velocity damper between the robot's capsules (`RobotDescription.capsules`) and with known obstacles.

    ḋ ≥ −ξ (d − d_s)/(d_i − d_s) for pairs with d < d_i.
    """

    obstacles: tuple[WorldCapsule, ...] = ()
    influence_m: PositiveFloat = 0.08
    """d_i."""
    safe_m: NonNegative = 0.02
    """d_s."""
    damping: PositiveFloat = 0.5
    """ξ [m/s]: the speed of approach that is allowed at d_i."""
    max_pairs: PositiveInt | None = None
    """Rows of the QP; the nearest pairs have them. None: one for each pair, so that none is left out."""

    @model_validator(mode="after")
    def _check(self) -> CollisionAvoidance:
        if not self.safe_m < self.influence_m:
            raise ValueError(f"safe_m {self.safe_m:g} must lie below influence_m {self.influence_m:g}")
        return self


class SavitzkyGolayFilter(Model):
    """Polynomials fitted to a moving window, section 2.1 of [Del Prete 2016]; the paper's values."""

    window: Annotated[int, Field(ge=3)] = 80
    """Samples."""
    encoder_order: Annotated[int, Field(ge=2)] = 2
    """Of the joints' positions, whose first and second derivatives are used."""
    sensor_order: Annotated[int, Field(ge=1)] = 1
    """Of force/torque sensor and inertial unit."""
    evaluate_at: Literal["centre", "end"] = "centre"
    """Of the window: late by half of it, or not late and noisier."""


class JointKalmanFilter(Model):
    """Joint motion from the encoders and a model of drives and robot, without the window's delay."""

    acceleration_noise: PositiveFloat = 5.0
    """[rad/s²] white, of the modelled acceleration."""
    disturbance_noise: PositiveFloat = 20.0
    """[rad/s² per √s]: how fast what the model lacks changes."""
    sensor_cutoff_hz: PositiveFloat = 50.0
    """First-order low-pass of force/torque sensor and inertial unit."""
    feedback_cutoff_hz: PositiveFloat = 5.0
    """First-order low-pass of ë_q and e_f. q̈̂ holds what the drives' model makes of the last command, so that its loop
    has the gain K_p, and that of e_f K_p + (1 + K_p) K_f: 2 and 5 with the paper's values, which must have fallen
    below 1 before the command's delay has turned the phase. The window does the same by its length."""


class MotorModel(Model):
    """Identified model of a position-controlled motor, (6) of [Del Prete 2016]: Δq = k_τ τ + k_v q̇ + k_c sign(q̇)."""

    torque_gain: PositiveFloat
    """k_τ [rad/(N·m)]."""
    velocity_gain: NonNegative
    """k_v [s]."""
    coulomb: NonNegative = 0.0
    """k_c [rad]; the controller gives it smoothly, k_c tanh(q̇/`coulomb_velocity`)."""


class SensorPayload(Model):
    """Identified body beyond a force/torque sensor, and the sensor's offsets (section 2.2 of [Del Prete 2016])."""

    mass: PositiveFloat
    """[kg]."""
    centre_in_sensor: Vector3
    """[m]."""
    force_offset: Vector3 = (0.0, 0.0, 0.0)
    """[N] in the sensor's frame: what it reads without load."""
    torque_offset: Vector3 = (0.0, 0.0, 0.0)
    """[N·m]."""


class PositionTorque(Model):
    """Torque control through drives that take positions only, section 4 of [Del Prete 2016].

    Δq = K_τ τ* + K_v q̇ (10), τ* = τ^d + K_p e_τ + K_i ∫e_τ (11); the command is q + Δq.
    """

    motors: dict[str, MotorModel] = Field(default_factory=dict)
    """Of every joint, by name."""
    motors_from: str | None = None
    """A packaged set or YAML file, as `cosim identify motors` writes it, whose motors stand below `motors`."""
    torque_gain: NonNegative = 2.0
    """K_p."""
    torque_integral: NonNegative = 0.0
    """K_i [1/s]; the paper saw no use in it."""
    force_gain: NonNegative = 1.0
    """K_f."""
    position_gain: NonNegative = 1.0
    """K₆ [rad/rad]: 1 is as stiff as the drive itself. The stiffness is K_s = K₆ / (k_τ (1 + K_p))."""
    velocity_gain: NonNegative = 0.01
    """K₇ [s]; the damping is K_d = K₇ / (k_τ (1 + K_p)). The paper does not give it. About as much as the friction's
    feed-forward takes away keeps a foot from hopping that has lost its contact and finds it again."""
    feedforward: Share = 1.0
    """Share of K_τ τ^d and K_v q̇ that is given."""
    coulomb_velocity: PositiveFloat = 0.1
    """[rad/s]."""
    desired: Literal["inverse_dynamics", "qp"] = "inverse_dynamics"
    """τ^d of (12), or the QP's M q̈ʳ + h with the tasks of the phase."""
    estimator: Literal["savitzky_golay", "kalman"] = "savitzky_golay"
    savitzky_golay: SavitzkyGolayFilter = SavitzkyGolayFilter()
    kalman: JointKalmanFilter = JointKalmanFilter()
    sensor: str | None = None
    """Force/torque sensor at the end effector; None: no contact is assumed."""
    payload: SensorPayload | None = None
    """Of that sensor, instead of the URDF's body and no offsets."""
    imu: str | None = None
    """Inertial unit that tells the base's motion; None: the base stands still."""
    predict_velocity: bool = True
    """Carry a late velocity forward by what was desired since: q̇(t) ≈ q̇̂(t − t_d) + q̇^d(t) − q̇^d(t − t_d), for the
    friction and δ. The loop is the same as without, only what the posture asks for is no longer late. The paper has
    q̇̂(t − t_d) alone."""
    compensate_delay: bool = True
    """Command q + Δq + δ q̇ with the known delay δ from the sample to the drive's action, since the drive works with
    its own newest position; False: q + Δq, and the drive is damped by k_p δ."""
    start_s: PositiveFloat = 0.3
    """The difference between what the position control gave and what the law asks goes to zero in this time."""


class SineWrench(Model):
    """F^d(t) = mean + amplitude sin(2π f t) of the environment on the hand frame, world axes, at its origin."""

    mean: tuple[float, float, float, float, float, float]
    """[N, N·m]."""
    amplitude: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    frequency_hz: PositiveFloat = 0.5
    ramp_s: PositiveFloat = 1.0
    """Time in which the mean is reached, along a minimum-jerk curve; the sine begins then."""
