"""Generalized inverses of a task's Jacobian and their derivatives: what (15)-(26) of [Benallegue 2021] are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import lapack

from controller_service.model import Array, Configuration

Inverse = Literal["pseudo", "dynamic"]


@dataclass(frozen=True, slots=True)
class TaskJacobian:
    """A task T(q) with m < n components: Ṫ = J q̇."""

    jacobian: Array
    """J (m, n)."""
    rate: Array
    """J̇ (m, n)."""


@dataclass(frozen=True, slots=True)
class TaskInverse:
    """J⁺ = W Jᵀ Λ, Λ = (J W Jᵀ)⁻¹, so J J⁺ = I: n × m (the paper prints m × n, a slip).

    W = I gives the pseudo-inverse, W = M⁻¹ the dynamically consistent one [Khatib 1995], of which J̄ᵀ maps joint torques
    to the task forces that they are equivalent to: a torque that it maps to zero does not accelerate the task.
    """

    task: TaskJacobian
    inverse: Array
    """J⁺ (n, m)."""
    task_mass: Array
    """Λ (m, m)."""
    weight: Array | None
    """W (n, n); None stands for I."""
    weight_mass_rate: Array | None
    """W Ṁ (n, n) with Ṁ = C + Cᵀ; None for W = I."""

    def rate_times(self, vector: Array) -> Array:
        """(dJ⁺/dt) z (n,) for z (m,).

        dJ⁺/dt = (I − J⁺J)(Ẇ Jᵀ + W J̇ᵀ) Λ − J⁺ J̇ J⁺ with Ẇ = −W Ṁ W: differentiate J⁺ = W Jᵀ Λ, Λ̇ = −Λ (dΛ⁻¹/dt) Λ.
        """
        J, rate = self.task.jacobian, self.task.rate
        force = self.task_mass.dot(vector)
        change: Array = force.dot(rate)
        if self.weight is not None and self.weight_mass_rate is not None:
            moved = self.inverse.dot(vector)
            change = self.weight.dot(change) - self.weight_mass_rate.dot(moved)
        change -= self.inverse.dot(J.dot(change) + rate.dot(self.inverse.dot(vector)))
        return change


def invert(now: Configuration, task: TaskJacobian, kind: Inverse) -> TaskInverse | None:
    """J⁺ at a configuration; None where J has no full rank, to rounding."""
    J = task.jacobian
    if kind == "pseudo":
        weight = weight_mass_rate = None
        weighted = J.T
    else:
        factor, fault = lapack.dpotrf(now.mass, lower=1)
        if fault != 0:
            return None
        weight = lapack.dpotrs(factor, np.eye(len(factor)), lower=1)[0]
        weight_mass_rate = weight.dot(now.coriolis + now.coriolis.T)
        weighted = weight.dot(J.T)
    _, task_mass, fault = lapack.dposv(J.dot(weighted), np.eye(len(J)), lower=1)
    if fault != 0:
        return None
    return TaskInverse(task, weighted.dot(task_mass), task_mass, weight, weight_mass_rate)


def smallest_singular_value(jacobian: Array) -> float:
    """Of J (m, n), m ≤ n: the distance from a singular configuration."""
    squared = float(np.linalg.eigvalsh(jacobian.dot(jacobian.T))[0])
    return float(np.sqrt(max(squared, 0.0)))
