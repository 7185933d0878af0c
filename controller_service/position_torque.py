"""Torque control through a drive that takes positions only: section 4 of [Del Prete 2016].

The drive's motor gives τ for Δq = q_t − q = K_τ τ + K_v q̇ + k_c sign(q̇), (6), where τ is the motor's torque less the
friction: what Pinocchio's `rnea` gives, reflected rotor inertia included. The law is

    Δq = K_τ τ* + K_v q̇ (10),    τ* = τ^d + K_p e_τ + K_i ∫e_τ (11),    e_τ = τ^d − τ̂
    τ^d = M q̈^d + ĥ − Jᵀ f* + K_s e_q + K_d ė_q,    f* = f^d + K_f e_f (12)

and with τ̂ = M q̈̂ + ĥ − Jᵀ f̂ it falls apart into (13), the feed-forward, and (14), the feedback:

    Δq = K_τ (M q̈^d + ĥ − Jᵀ f^d) + K_v q̇ + K₆ e_q + K₇ ė_q + K₈ ë_q + K₉ e_f
    K₆ = K_τ (I + K_p) K_s,   K₇ = K_τ (I + K_p) K_d,   K₈ = K_τ K_p M,   K₉ = −K_τ (K_p Jᵀ (I + K_f) + Jᵀ K_f)

The sum is computed in this second form. An estimate that is late by t_d is compared with what was desired t_d ago,
which the first form cannot do for e_q: that one is not late, and delayed it would swing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller_service.model import Array
from schemas.control_law import PositionTorque


@dataclass(frozen=True, slots=True)
class FeedbackGains:
    """K₆ … K₉ of (14)."""

    position: Array
    """K₆ (n,) [rad/rad]."""
    velocity: Array
    """K₇ (n,) [s]."""
    acceleration: Array
    """K₈ (n, n) [s²]."""
    force: Array
    """K₉ (n, k) [rad/N]."""


def feedback_gains(
    torque_gain: Array, k_p: Array, stiffness: Array, damping: Array, k_f: Array, mass: Array, jacobian: Array
) -> FeedbackGains:
    """Give K₆ … K₉ of the user's gains.

    Args:
        torque_gain: k_τ (n,) [rad/(N·m)].
        k_p: K_p (n,).
        stiffness: K_s (n,) [N·m/rad].
        damping: K_d (n,) [N·m·s/rad].
        k_f: K_f (k,).
        mass: M (n, n) [kg·m²].
        jacobian: J (k, n).

    """
    whole = torque_gain * (1.0 + k_p)
    share = (k_p[:, np.newaxis] * (1.0 + k_f) + k_f) * torque_gain[:, np.newaxis]
    return FeedbackGains(
        whole * stiffness, whole * damping, (torque_gain * k_p)[:, np.newaxis] * mass, -share * jacobian.T
    )


def stiffness_of(position_gain: Array, torque_gain: Array, k_p: Array) -> Array:
    """K_s (n,) [N·m/rad] of K₆, or K_d [N·m·s/rad] of K₇, at a given K_p."""
    stiffness: Array = position_gain / (torque_gain * (1.0 + k_p))
    return stiffness


def force_gain_of(force_feedback: Array, torque_gain: Array, k_p: Array, jacobian: Array) -> Array:
    """K_f (k,) of K₉ (n, k) at a given K_p: the least-squares solution, exact for a K₉ that has one.

    Column c of K₉ is −(K_p + (1 + K_p) K_f,c) k_τ J_cᵀ.
    """
    columns = torque_gain[:, np.newaxis] * jacobian.T
    direction = (1.0 + k_p)[:, np.newaxis] * columns
    rest = -force_feedback - k_p[:, np.newaxis] * columns
    gain: Array = np.einsum("nk,nk->k", direction, rest) / np.einsum("nk,nk->k", direction, direction)
    return gain


@dataclass(frozen=True, slots=True)
class Motors:
    """Identified models (6) of all joints as arrays (n,)."""

    torque_gain: Array
    """k_τ [rad/(N·m)]."""
    velocity_gain: Array
    """k_v [s]."""
    coulomb: Array
    """k_c [rad]."""
    coulomb_velocity: float
    """v₀ [rad/s]: the Coulomb part is k_c tanh(q̇/v₀)."""

    @classmethod
    def of(cls, config: PositionTorque, names: tuple[str, ...]) -> Motors:
        """Stack the models in the order of the joints."""
        motors = [config.motors[name] for name in names]
        return cls(
            np.array([motor.torque_gain for motor in motors]),
            np.array([motor.velocity_gain for motor in motors]),
            np.array([motor.coulomb for motor in motors]),
            config.coulomb_velocity,
        )

    def friction(self, velocity: Array) -> Array:
        """K_v q̇ + k_c tanh(q̇/v₀) (n,) [rad]."""
        offset: Array = self.velocity_gain * velocity
        if self.coulomb.any():
            offset += self.coulomb * np.tanh(velocity / self.coulomb_velocity)
        return offset

    def torque(self, offset: Array, velocity: Array) -> Array:
        """τ (n,) [N·m] that an offset Δq gives at a velocity, (6) solved for τ."""
        torque: Array = (offset - self.friction(velocity)) / self.torque_gain
        return torque


@dataclass(frozen=True, slots=True)
class OffsetTerms:
    """The parts of Δq in (13) and (14), each (n,) [rad]."""

    torque: Array
    """Feed-forward torque."""
    friction: Array
    """Feed-forward friction."""
    position: Array
    """K₆ e_q."""
    velocity: Array
    """K₇ ė_q."""
    acceleration: Array
    """K₈ ë_q; with τ^d from the QP, K_τ K_p e_τ."""
    force: Array
    """K₉ e_f."""
    integral: Array
    """K_τ K_i ∫e_τ."""

    @property
    def of_torque(self) -> Array:
        """K_τ τ*: all but the friction."""
        total: Array = self.torque + self.position + self.velocity + self.acceleration + self.force + self.integral
        return total


@dataclass(frozen=True, slots=True)
class Errors:
    """Desired less measured or estimated, both at the time of the measurement."""

    position: Array
    """e_q (n,) [rad]."""
    velocity: Array
    """ė_q (n,) [rad/s]."""
    acceleration: Array
    """ë_q (n,) [rad/s²]."""
    wrench: Array | None
    """e_f (6,) [N, N·m] in world axes at the hand's origin; None without a sensor."""


class PositionTorqueLaw:
    """(13) and (14) with the gains of a configuration, and the integral of e_τ.

    Args:
        config: gains.
        motors: of all joints.
        torque_limit: (n,) [N·m], bounds K_i ∫e_τ.

    """

    def __init__(self, config: PositionTorque, motors: Motors, torque_limit: Array) -> None:
        self.motors = motors
        self._config = config
        gain = motors.torque_gain
        self._zero = np.zeros_like(gain)
        self._acceleration_gain = gain * config.torque_gain
        self._stiffness = stiffness_of(np.full_like(gain, config.position_gain), gain, np.array(config.torque_gain))
        self._damping = stiffness_of(np.full_like(gain, config.velocity_gain), gain, np.array(config.torque_gain))
        self._limit = torque_limit
        self._integral = np.zeros_like(gain)

    def reset(self) -> None:
        """Forget the integral."""
        self._integral = np.zeros_like(self._zero)

    def terms(
        self,
        reference: Array,
        velocity: Array,
        errors: Errors,
        mass: Array,
        jacobian: Array | None,
        force_gain: float,
        elapsed_s: float,
    ) -> OffsetTerms:
        """Compute all parts of Δq.

        Args:
            reference: M q̈^d + ĥ − Jᵀ f^d (n,) [N·m].
            velocity: q̇̂ (n,) [rad/s], for the friction.
            errors: of this tick.
            mass: M (n, n).
            jacobian: J (6, n) of the hand, for e_f.
            force_gain: K_f; 0 where no wrench is controlled: then an external wrench is what the robot gives way to.
            elapsed_s: since the last tick.

        """
        config, gain = self._config, self.motors.torque_gain
        inertial = mass.dot(errors.acceleration)
        force, of_wrench = self._zero, self._zero
        if errors.wrench is not None and jacobian is not None:
            of_wrench = errors.wrench.dot(jacobian)
            force = -(config.torque_gain * (1.0 + force_gain) + force_gain) * gain * of_wrench
        if config.torque_integral > 0.0:
            error = inertial - (1.0 + force_gain) * of_wrench
            error += self._stiffness * errors.position + self._damping * errors.velocity
            self._accumulate(error, elapsed_s)
        return OffsetTerms(
            torque=config.feedforward * gain * reference,
            friction=config.feedforward * self.motors.friction(velocity),
            position=config.position_gain * errors.position,
            velocity=config.velocity_gain * errors.velocity,
            acceleration=self._acceleration_gain * inertial,
            force=force,
            integral=gain * self._integral,
        )

    def torque_terms(self, desired: Array, velocity: Array, torque_error: Array, elapsed_s: float) -> OffsetTerms:
        """(10) and (11) for a τ^d (n,) [N·m] from elsewhere; `torque_error` is e_τ at the time of τ̂."""
        config, gain, zero = self._config, self.motors.torque_gain, self._zero
        if config.torque_integral > 0.0:
            self._accumulate(torque_error, elapsed_s)
        return OffsetTerms(
            torque=config.feedforward * gain * desired,
            friction=config.feedforward * self.motors.friction(velocity),
            position=zero,
            velocity=zero,
            acceleration=self._acceleration_gain * torque_error,
            force=zero,
            integral=gain * self._integral,
        )

    def _accumulate(self, error: Array, elapsed_s: float) -> None:
        """K_i ∫e_τ, held within the torque limit so that it cannot wind up."""
        step = self._config.torque_integral * elapsed_s * error
        self._integral = np.minimum(np.maximum(self._integral + step, -self._limit), self._limit)
