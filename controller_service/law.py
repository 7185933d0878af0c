"""The torque law (2)-(4) of [Benallegue 2021]: inverse dynamics and the passivity-based integral term."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller_service.model import Array, Configuration


@dataclass(frozen=True, slots=True)
class LawTerms:
    """The terms of u = uʳ + L s, each (n,)."""

    velocity_error: Array
    """s [rad/s]."""
    reference: Array
    """uʳ [N·m]."""
    integral: Array
    """L s [N·m]."""

    @property
    def torque(self) -> Array:
        """The sum u [N·m]."""
        total: Array = self.reference + self.integral
        return total


def inverse_dynamics(now: Configuration, acceleration: Array) -> Array:
    """(2) without contacts: uʳ = M q̈ʳ + C q̇ + g (n,) [N·m]."""
    torque: Array = now.mass.dot(acceleration)
    torque += now.nonlinear
    return torque


def integral_gain(now: Configuration, lambda_: float) -> Array:
    """(4): L = C + K (n, n), K = λ diag(M) [N·m·s/rad]."""
    gain = now.coriolis.copy()
    gain.flat[:: len(gain) + 1] += lambda_ * now.mass.diagonal()
    return gain


class IntegralTerm:
    """State q̇ʳ of the integral term L s, s = q̇ʳ − q̇.

    In closed loop on a perfect model M ṡ = −(C + K) s, so V = ½ sᵀ M s decays: V̇ = −sᵀ K s. Since s holds the
    integral of the tasks' errors, the tasks' PD becomes a PID: (p + λ)(p² + K_v p + K_p) e ~ p d/M for a disturbance d.

    q̇ʳ is integrated by q̇ʳ ← q̇ʳ + T q̈ʳ, which is exact for the q̈ʳ that (like the torque) is held over the period. It is
    the QP's q̈ʳ, torque limits and all, that is integrated: where a limit holds u back, q̇ʳ is held back with it.

    Args:
        n: joints.
        lambda_: λ [1/s].
        enabled: False gives s ≡ 0, u = uʳ.

    """

    def __init__(self, n: int, lambda_: float, *, enabled: bool = True) -> None:
        self._lambda = lambda_
        self._enabled = enabled
        self.velocity_reference = np.zeros(n)
        """q̇ʳ (n,) [rad/s]."""

    def reset(self, now: Configuration, torque: Array | None = None) -> None:
        """Set q̇ʳ = q̇ + s₀ with (C + K) s₀ = `torque` (section IV-A), or s₀ = 0."""
        self.velocity_reference = now.velocity.copy()
        if torque is not None and self._enabled:
            self.velocity_reference += np.linalg.solve(integral_gain(now, self._lambda), torque)

    def terms(self, now: Configuration) -> tuple[Array, Array]:
        """(s, L s), both (n,)."""
        if not self._enabled:
            return np.zeros_like(now.velocity), np.zeros_like(now.velocity)
        error = self.velocity_reference - now.velocity
        torque: Array = now.coriolis.dot(error)
        torque += self._lambda * now.mass.diagonal() * error
        return error, torque

    def advance(self, acceleration: Array, elapsed_s: float) -> None:
        """Integrate q̈ʳ (n,), held for `elapsed_s`."""
        self.velocity_reference = self.velocity_reference + elapsed_s * acceleration
