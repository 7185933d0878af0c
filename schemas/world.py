"""What the world does to the simulated robot: obstacles in its way, pushes, hands that hold it.

The plant alone reads this; the controller is not told. Times are simulated seconds since sequence 0; vectors lie in the
world.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from schemas.base import Model, Quaternion, Vector3

NonNegative = Annotated[float, Field(ge=0.0)]
Name = Annotated[str, Field(min_length=1)]
WayPoint = tuple[NonNegative, float, float, float]
"""(time since the event's start [s], displacement along x, y, z of the world [m])."""

UNIT_TOLERANCE = 1e-3
"""Of a quaternion's norm."""


class Pole(Model):
    """A fixed rigid rod with round ends."""

    kind: Literal["pole"] = "pole"
    name: Name
    start_in_world: Vector3
    """Centre of one round end [m]."""
    end_in_world: Vector3
    radius: PositiveFloat
    friction: NonNegative = 0.5
    """Coefficient μ of dry friction between it and any link."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.start_in_world == self.end_in_world:
            raise ValueError("end_in_world is start_in_world: a pole has a length")
        return self


class Box(Model):
    """A rigid box that is fixed, or stands on springs: what gives way under a foot is rarely nothing."""

    kind: Literal["box"] = "box"
    name: Name
    position_in_world: Vector3
    """Of its centre [m]."""
    half_sizes: tuple[PositiveFloat, PositiveFloat, PositiveFloat]
    """Along its own axes [m]."""
    orientation_to_world: Quaternion = (1.0, 0.0, 0.0, 0.0)
    friction: NonNegative = 0.5
    """Coefficient μ of dry friction between it and any link."""
    stiffness: PositiveFloat | None = None
    """[N/m] of its springs along each axis of the world, damped to half the critical; it does not turn. None: fixed."""
    mass: PositiveFloat = 5.0
    """[kg] on the springs, which carry its weight beforehand."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        norm = sum(value * value for value in self.orientation_to_world) ** 0.5
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise ValueError(f"orientation_to_world has the norm {norm:g}, expected a unit quaternion (w, x, y, z)")
        return self


class Push(Model):
    """A force on a point of a link: its direction stays in the world, its point goes with the link."""

    kind: Literal["push"] = "push"
    name: Name
    link: str
    point_in_link: Vector3 = (0.0, 0.0, 0.0)
    """[m] in the frame of the URDF's link."""
    force_in_world: Vector3
    """At its greatest [N]."""
    start_s: NonNegative
    duration_s: PositiveFloat
    """From the first to the last force, ramps included."""
    shape: Literal["trapezoid", "half_sine"] = "trapezoid"
    ramp_s: NonNegative = 0.05
    """Of a trapezoid: time in which the force rises, and falls, along a minimum-jerk curve. 0 is a step."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.shape == "trapezoid" and 2.0 * self.ramp_s > self.duration_s:
            raise ValueError(f"ramp_s: two ramps of {self.ramp_s:g} s do not fit into duration_s {self.duration_s:g} s")
        return self


class HandHeld(Model):
    """A person's hand on a point of a link: a spring and damper between that point and one that the person moves.

    F = k (p_h − p) + d (ṗ_h − ṗ), its norm at most `force_limit`; p_h(0) is where the point truly is at the start.
    """

    kind: Literal["hand_held"] = "hand_held"
    name: Name
    link: str
    point_in_link: Vector3 = (0.0, 0.0, 0.0)
    """[m] in the frame of the URDF's link."""
    start_s: NonNegative
    duration_s: PositiveFloat
    """Then the hand lets go."""
    ramp_s: NonNegative = 0.0
    """Time after the end in which the force fades along a minimum-jerk curve; 0 lets go at once."""
    path: tuple[WayPoint, ...] = ()
    """Displacements of p_h from p_h(0), minimum-jerk from each to the next and at rest at each; the last one is kept.
    It begins without displacement at time 0, said or not. Empty: held where it was."""
    stiffness: NonNegative
    """k [N/m]."""
    damping: NonNegative = 0.0
    """d [N·s/m]."""
    force_limit: PositiveFloat
    """[N]."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for (before, *_), (after, *_) in pairwise(self.path):
            if not before < after:
                raise ValueError(f"path: the way point at {after:g} s does not come after the one at {before:g} s")
        if self.path and self.path[0][0] == 0.0 and any(self.path[0][1:]):
            raise ValueError("path: the way point at 0 s must be without displacement: it is where the hand takes hold")
        if self.path and self.path[-1][0] > self.duration_s:
            raise ValueError(
                f"path: the way point at {self.path[-1][0]:g} s comes after the end, duration_s {self.duration_s:g} s"
            )
        return self


Obstacle = Annotated[Pole | Box, Field(discriminator="kind")]
WorldEvent = Annotated[Push | HandHeld, Field(discriminator="kind")]


class World(Model):
    """All that the world does in a run. Events that act at one time add up."""

    obstacles: tuple[Obstacle, ...] = ()
    events: tuple[WorldEvent, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [obstacle.name for obstacle in self.obstacles] + [event.name for event in self.events]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"the name {name!r} is given twice")
        return self
