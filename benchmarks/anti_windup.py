"""What limiting the integral torque costs a tick, by method and by what is active."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.measure import Timing, measure
from controller_service.anti_windup import OsqpProjection, project, scale
from controller_service.model import Array

JOINTS = 9


def anti_windup(n: int) -> list[Timing]:
    """Time `n` calls of each for nine joints: nothing saturated, clipping enough, the half-space of (11) active."""
    direction, bound, inside, clipped, turned = problems(JOINTS)
    osqp = OsqpProjection(JOINTS)
    calls: tuple[tuple[str, Callable[[], Array]], ...] = (
        ("anti-windup (11), nothing saturated", lambda: project(inside, direction, bound)),
        ("anti-windup (11), box active", lambda: project(clipped, direction, bound)),
        ("anti-windup (11), half-space active", lambda: project(turned, direction, bound)),
        ("anti-windup (11), half-space, OSQP", lambda: osqp(turned, direction, bound)),
        ("anti-windup (10), scaling", lambda: scale(turned, bound)),
    )
    return [measure(name, call, n) for name, call in calls]


def problems(n: int) -> tuple[Array, Array, Array, Array, Array]:
    """s, b, and three u, all (n,): in the box; K s with diagonal K, beyond it; one that needs the half-space."""
    rng = np.random.default_rng(1)
    direction, bound = rng.normal(size=n), rng.uniform(5.0, 20.0, n)
    clipped = 20.0 * direction
    # The second half of the joints works against s, further beyond its bounds than the first
    turned = direction * np.where(np.arange(n) < n // 2, 100.0, -20.0)
    return direction, bound, scale(0.9 * clipped, bound), clipped, turned
