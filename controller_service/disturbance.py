"""Momentum-based observer of external joint torques, [De Luca & Mattone, ICRA 2003 and 2005].

With p = M q̇, Ṁ = C + Cᵀ and M q̈ + C q̇ + g = τ_motor − τ_f + τ_ext,

    ṗ = τ_motor − τ_f + Cᵀ q̇ − g + τ_ext,     r = K_O [p − p(0) − ∫ (τ_motor − τ_f + Cᵀ q̇ − g + r) dt],

so ṙ = K_O (τ_ext − r): r is τ_ext through a first-order low-pass, without accelerations and without inverting M.

In discrete time momentum and impulses are balanced over the interval of length T that ends at SYNC k:

    r_k = a r_{k−1} + (1 − a) (p_k − p_{k−1} − J_k)/T,   a = exp(−K_O T),   J_k = ∫ (τ_motor − τ_f + Cᵀ q̇ − g) dt,

exact for a τ_ext that is constant over the interval, for any T, with nothing that integrates up. In J_k the motor
torque is the one that state k reports: the drive gave it from SYNC k−1 to SYNC k. In torque mode that is exact; in
position mode the torque moves within the period and the report is its last value. The other terms follow the state:
the mean of both ends. When states were lost, the last torque stands for those that nobody saw: where they differed
by Δτ, r is off by less than (1 − a) Δτ, which decays with 1/K_O.

**Late velocities.** The velocity is the backward difference v̄ through a low-pass, v̂_k = α v̂_{k−1} + (1 − α)
v̄_k, and p̂ = M v̂ is as late as that. τ_motor − g, which is not late, is made so by the same recursion: the
momentum that it gives by its impulses w, P_k = P_{k−1} + w_k, has the mean P_{k−1} + w_k/2 over the interval, of
which the estimator would make z_k = α z_{k−1} + (1 − α) (P_{k−1} + w_k/2). Only y = z − P is kept, which stays
bounded. Cᵀ v̂ and τ_f(v̂) are late already. Without this every step Δτ of the motor torque would appear in r as
about K_O D Δτ, D the estimator's delay.

**Friction** is known as c sign(q̇) + v q̇ while the joint moves. At rest it takes any value that holds the joint,
so nothing can be subtracted: the sign is replaced by σ = tanh((q̇/v_d)³), flat at zero, a dead band without edges,
with v_d two encoder counts a cycle. There r is τ_ext less the friction that holds the joint, and all that is known
is an interval: τ_ext, low-passed, lies in r ± `half_width`, the low-passed c (1 − |σ̄|) with σ̄ the mean over the
interval: c at rest, 0 in motion. Not in it, but in r: friction beyond the configured c (breakaway, an error of c),
wrong masses, a wrong torque constant, and at a reversal 2 c K_O D, since it is seen late by D.
"""

from __future__ import annotations

import math

import numpy as np

from controller_service.errors import StateError
from controller_service.friction import FrictionModel
from controller_service.model import Array, Configuration
from schemas.control_law import DisturbanceObserver
from schemas.robot import RobotDescription

REST_COUNTS = 2.0
"""Encoder counts a cycle: v_d, below which a velocity may be one flickering count."""


class MomentumObserver:
    """r (n,) [N·m], the external torques at the joints; positive helps motion, as Jᵀ F of a force F on the robot.

    Args:
        description: gears, encoders and rate.
        config: K_O and the friction that is known, at the motor.
        velocity_cutoff_hz: of the `VelocityEstimator` that the velocities come from; None: they are exact.

    """

    def __init__(
        self, description: RobotDescription, config: DisturbanceObserver, velocity_cutoff_hz: float | None = None
    ) -> None:
        friction = FrictionModel(description, config.coulomb, config.viscous)
        resolution = [2.0 * math.pi / (joint.encoder_counts * joint.gear_ratio) for joint in description.joints]
        self._bandwidth = config.bandwidth
        self._lag_rate = None if velocity_cutoff_hz is None else 2.0 * math.pi * velocity_cutoff_hz
        self._coulomb, self._viscous = friction.coulomb, friction.viscous
        self._per_rest_velocity = 1.0 / (REST_COUNTS * description.rate_hz * np.array(resolution))
        n = len(description.joints)
        self._shape = (n,)
        self._momentum: Array | None = None
        """p̂ at the last state; None before the first."""
        self._rates = np.zeros((3, n))
        """At the last state: −g, Cᵀ v̂ − τ_f, and c σ."""
        self._lag: Array | None = None
        """y; None before the first interval."""
        self._state = np.zeros((2, n))
        """Through the low-pass: τ_ext, that is r, and c |σ̄|."""

    @property
    def half_width(self) -> Array:
        """How far low-passed τ_ext may be from r for the known friction at rest, (n,) [N·m]."""
        width: Array = self._coulomb - self._state[1]
        return width

    def reset(self, now: Configuration) -> None:
        """Start again from a state with r = 0, as if the first torque to come had acted for long before."""
        self._momentum = now.mass.dot(now.velocity)
        self._rates = self._evaluate(now)
        self._lag = None
        self._state = np.zeros((2, *self._shape))

    def update(self, now: Configuration, motor_torque_measured: Array, elapsed_s: float) -> Array:
        """Take the next state and return r (n,) [N·m]; the first one ever is taken as by `reset`.

        Args:
            now: dynamics at the measured positions and estimated velocities.
            motor_torque_measured: [N·m] at the joints (n,), reported with these positions: of the interval before them.
            elapsed_s: length of that interval, the time since the last state.

        Raises:
            StateError: wrong shape, or time that does not pass.

        """
        if motor_torque_measured.shape != self._shape or not elapsed_s > 0.0:
            raise StateError(
                f"the observer needs {self._shape[0]} motor torques over a positive time, got"
                f" {motor_torque_measured.shape} over {elapsed_s} s: give it every state once, in order"
            )
        if self._momentum is None:
            self.reset(now)
            return np.zeros(self._shape)
        momentum: Array = now.mass.dot(now.velocity)
        rates = self._evaluate(now)
        impulses = rates + self._rates
        impulses *= 0.5 * elapsed_s
        weight, moved, dry = impulses
        weight += elapsed_s * motor_torque_measured
        external = np.subtract(momentum - self._momentum, moved, out=moved)
        external -= weight if self._lag_rate is None else self._late(weight, elapsed_s, self._lag_rate)
        np.abs(dry, out=dry)
        pole = math.exp(-self._bandwidth * elapsed_s)
        impulses *= (1.0 - pole) / elapsed_s
        self._state *= pole
        self._state += impulses[1:]
        self._momentum, self._rates = momentum, rates
        estimate: Array = self._state[0].copy()
        return estimate

    def _evaluate(self, now: Configuration) -> Array:
        """−g, Cᵀ v̂ − τ_f, and c σ, (3, n) [N·m]."""
        velocity = now.velocity
        rates: Array = np.empty_like(self._rates)
        weight, moved, dry = rates
        np.subtract(now.coriolis.dot(velocity), now.nonlinear, out=weight)
        np.multiply(velocity, self._per_rest_velocity, out=dry)
        dry *= dry * dry
        np.tanh(dry, out=dry)
        dry *= self._coulomb
        np.subtract(velocity.dot(now.coriolis), dry, out=moved)
        moved -= velocity * self._viscous
        return rates

    def _late(self, impulse: Array, elapsed_s: float, rate: float) -> Array:
        """z_k − z_{k−1} of w_k = `impulse`: y ← α (y − w) − (1 − α) w/2, and Δz = Δy + w."""
        pole = math.exp(-rate * elapsed_s)
        behind = (0.5 + 0.5 * pole) * impulse
        if self._lag is None:
            self._lag = behind / (pole - 1.0)
            return impulse
        lag: Array = pole * self._lag
        lag -= behind
        late = impulse + lag
        late -= self._lag
        self._lag = lag
        return late
