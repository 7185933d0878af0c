"""The scenario: which robot, which clock, how the plant differs from the model, what the controller does."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, PositiveFloat, model_validator

from schemas.base import Clock, Model
from schemas.controller import ControllerConfig
from schemas.world import Box, World

NonNegative = Annotated[float, Field(ge=0.0)]


class Friction(Model):
    """Friction at the motor side, [Cisneros 2018] Table I; reflected to the joint through the gear N.

    τ_f(q̇) = N (c + (b − c) exp(−(q̇ N / v_s)²)) sign(q̇) + N² v q̇; at rest any torque up to N b is resisted.
    """

    coulomb: NonNegative = 0.04
    """c [N·m]."""
    breakaway: NonNegative = 0.05
    """b [N·m]."""
    viscous: NonNegative = 0.0005
    """v [N·m·s/rad]."""
    stribeck_velocity: PositiveFloat = 0.2
    """v_s [rad/s] of the motor."""


class DriveAsymmetry(Model):
    """What a drive's closed firmware does beside its PD law: gains that depend on the sign of the velocity.

    Section 3.2.1 of [Del Prete 2016] found this on HRP-2. With σ = tanh(q̇/v₀) the position law becomes
    k_p (1 + α_p σ) (q_t − q) + k_d (1 + α_d σ) (q̇_t − q̇).
    """

    position_gain: Annotated[float, Field(gt=-1.0, lt=1.0)] = 0.0
    """α_p."""
    velocity_gain: Annotated[float, Field(gt=-1.0, lt=1.0)] = 0.0
    """α_d."""
    smoothing_velocity: PositiveFloat = 0.02
    """v₀ [rad/s] at the joint."""


class SensorNoise(Model):
    """Standard deviations of white noise, and of biases drawn once a run; zero is a clean signal."""

    force: NonNegative = 0.0
    torque: NonNegative = 0.0
    force_bias: NonNegative = 0.0
    torque_bias: NonNegative = 0.0
    angular_velocity: NonNegative = 0.0
    acceleration: NonNegative = 0.0
    motor_torque: NonNegative = 0.0
    """[N·m] at the joint, on the reported motor torque."""


class PlantConfig(Model):
    """How the simulated robot differs from its description, and how finely it is simulated."""

    substep_s: PositiveFloat = 0.0005
    """MuJoCo and firmware step; must divide the period."""
    torque_scale: PositiveFloat = 0.9
    """True motor torque over the nominal one."""
    mass_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.1
    """Every link's mass (and inertia) is multiplied by 1 ± this, the sign drawn from the seed."""
    dead_zone_scale: NonNegative = 1.0
    """True dead zone over the described one."""
    drive_asymmetry: DriveAsymmetry = DriveAsymmetry()
    friction: Friction = Friction()
    friction_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Every joint's friction (Coulomb, breakaway, viscous) is multiplied by a factor within 1 ± this, uniform, drawn
    from the seed."""
    noise: SensorNoise = SensorNoise()
    free_run_after_s: PositiveFloat = 10.0
    """Lockstep: wall-clock silence of the bus after which the plant runs on by itself so that drives notice a HAL that
    hangs; one that died is noticed at once. Longer than the HAL waits for a command (`safety.command_timeout_s`)."""
    initial_posture: dict[str, float] = Field(default_factory=dict)
    """Joint angles [rad] at the start; joints not named start at 0 or the nearest limit."""
    truth_frames: tuple[str, ...] = ()
    """Extra URDF frames whose true poses are reported; the hand frame always is."""
    world: World = World()
    """Obstacles, pushes and hands that the controller does not know of."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for index, obstacle in enumerate(self.world.obstacles):
            if isinstance(obstacle, Box) and obstacle.stiffness is not None:
                turn = self.substep_s * (obstacle.stiffness / obstacle.mass) ** 0.5
                if turn > 1.0:
                    raise ValueError(
                        f"world.obstacles.{index}.stiffness: {obstacle.name} with {obstacle.mass:g} kg turns by"
                        f" {turn:.2g} rad of its own swing in substep_s {self.substep_s:g} s; expected at most 1: lower"
                        " the stiffness, raise the mass"
                    )
        for index, event in enumerate(self.world.events):
            if event.duration_s < self.substep_s:
                raise ValueError(
                    f"world.events.{index}.duration_s: {event.name} would be missed: {event.duration_s:g} s is less"
                    f" than substep_s, {self.substep_s:g} s"
                )
        return self


class Scenario(Model):
    """One run, whole: with the robot description it determines every message of a lockstep run."""

    name: str
    description: str = ""
    robot: str
    """Name of a robot that comes with the package, or path of a robot file, relative to this file."""
    clock: Clock = Clock.LOCKSTEP
    duration_s: PositiveFloat
    seed: Annotated[int, Field(ge=0)] = 0
    namespace: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")] = "cosim"
    """First part of all Zenoh keys."""
    allow_overload: bool = False
    """Run although the robot's buses cannot carry the plan (`schemas.bus_load`): frames are late or never sent."""
    plant: PlantConfig = PlantConfig()
    controller: ControllerConfig
