"""Steady-state Kalman filter of the joints with the model of drive and robot: an estimate without a window's delay.

[Del Prete 2016] differentiates encoders without a model, 40 ms late, and names as what is left to do that "the state
estimation algorithm could also exploit [the identified model] to predict the future state and so nullify estimation
delays". Here each joint has the state [q, q̇, d]. The caller gives the acceleration u that its model expects,

    u = M⁻¹ (τ_motor − τ_friction − h + Jᵀ f),

constant over the period T, and d is what the model does not know: wrong parameters, friction at rest, a push.

    q⁺ = q + T q̇ + T²/2 (u + d + w),   q̇⁺ = q̇ + T (u + d + w),   d⁺ = d + v,   y = q + e,

w, v, e white with deviations σ_a, σ_d √T and σ_q. With x⁻ the prediction, x = x⁻ + K (y − q⁻) and, for each joint,

    P = A P Aᵀ − A P Cᵀ (C P Cᵀ + σ_q²)⁻¹ C P Aᵀ + Q,   K = P Cᵀ / (C P Cᵀ + σ_q²),   C = [1 0 0],

the stationary solution, computed once ([Simon 2006], ch. 7.3). In units of σ_q, T and their quotients only σ_a T²/σ_q
and σ_d T^2.5/σ_q are left, so the equation is solved in these.

**Delay.** The paper's objection to the Kalman filter is a model that is wrong under contact. d answers it: any constant
error of u is found, and then q, q̇ and q̈ = u + d are neither biased nor late; the same holds for a ramp of positions.
What the model does know, through u, is never late, at any frequency. Only a change of what it does not know is, by the
slowest of `poles`: −T / ln |pole|.

**Trade-off.** σ_q is the encoder's: a step δ of rounding gives δ/√12. While σ_a is small, d follows at about
(σ_d/(σ_q √T))^(1/3) rad/s: faster means more noise in q̈ and q̇. A large σ_a lets q̇ follow the encoder at once and d
only within σ_a √T/σ_d seconds. It should stay below a few σ_q/T²: above, one of the poles goes to −1, the zero of the
sampled double integrator, and q̇ alternates from cycle to cycle. With both small the filter trusts the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from controller_service.errors import StateError
from controller_service.model import Array
from schemas.errors import ConfigurationError

WHITE_BOUND = 1e3
WALK_BOUNDS = (1e-10, 1e4)
"""Of σ_a T²/σ_q and σ_d T^2.5/σ_q: inside, the Riccati equation is solved to rounding and all poles are stable."""


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Estimated motion of the joints at one instant, (n,) each."""

    position: Array
    """[rad]."""
    velocity: Array
    """[rad/s]."""
    acceleration: Array
    """u + d [rad/s²], the mean over the period that ends at the instant."""


class JointKalman:
    """Estimator of all joints; in every cycle `predict` with the model's acceleration, then `correct`.

    Args:
        period_s: T.
        measurement_noise: σ_q (n,) [rad] of the encoders at the joint.
        acceleration_noise: σ_a [rad/s²], white from period to period.
        disturbance_noise: σ_d [rad/s² per √s], of the random walk d.

    Attributes:
        gain: K (n, 3), of q [1], q̇ [1/s] and d [1/s²].
        predicted_covariance: P (n, 3, 3) of [q, q̇, d] before the measurement.
        innovation_deviation: (n,) [rad], that y − q⁻ has if the noises are as assumed.
        poles: (n, 3), eigenvalues of the error from one cycle to the next, all inside the unit circle.
        innovation: y − q⁻ (n,) [rad] of the last `correct`; zero at the first.

    Raises:
        ConfigurationError: a noise or period that is not positive (σ_a may be zero), or noises too far apart.

    """

    def __init__(
        self, period_s: float, measurement_noise: Array, acceleration_noise: float, disturbance_noise: float
    ) -> None:
        noise = np.array(measurement_noise, dtype=np.float64)
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise ConfigurationError(f"the period of the joint filter must be positive, not {period_s} s")
        if noise.ndim != 1 or not noise.size or not (np.isfinite(noise).all() and noise.min() > 0.0):
            raise ConfigurationError(
                f"measurement_noise must be a positive deviation [rad] for each joint, not {measurement_noise}; an"
                " encoder that is exact but for its step has step/√12"
            )
        if not (math.isfinite(acceleration_noise) and acceleration_noise >= 0.0):
            raise ConfigurationError(f"acceleration_noise must be zero or positive, not {acceleration_noise} rad/s²")
        if not (math.isfinite(disturbance_noise) and disturbance_noise > 0.0):
            raise ConfigurationError(
                f"disturbance_noise must be positive, not {disturbance_noise} rad/s²/√s: at zero the filter would never"
                " learn an error of the model"
            )
        joints = [_stationary(period_s, float(sigma), acceleration_noise, disturbance_noise) for sigma in noise]
        self.gain: Array = np.array([gain for gain, _, _ in joints])
        self.predicted_covariance: Array = np.array([covariance for _, covariance, _ in joints])
        self.poles: NDArray[np.complex128] = np.array([poles for _, _, poles in joints])
        self.innovation_deviation: Array = np.sqrt(self.predicted_covariance[:, 0, 0] + noise**2)
        self._period = period_s
        self._shape = noise.shape
        self._gain = np.vstack((self.gain.T, np.zeros(noise.size)))
        self._step = _step(period_s)
        self._state = np.zeros((4, noise.size))
        """q, q̇, d and u in rows."""
        self._started = False
        self.innovation: Array = np.zeros(noise.size)

    def predict(self, model_acceleration: Array, cycles: int = 1) -> None:
        """Go on in time with u (n,) [rad/s²]; before the first `correct` it changes nothing that counts.

        With several cycles u is held over them, as by as many calls. The gain of the `correct` after that stays the
        stationary one, which is stable but trusts the longer prediction too much.

        Raises:
            StateError: a wrong shape, a value that is not finite (it would stay for ever), or cycles < 1.

        """
        u = model_acceleration
        if u.shape != self._shape or cycles < 1 or not math.isfinite(u.dot(u)):
            raise StateError(
                f"the joint filter expects {self._shape[0]} finite accelerations over at least one cycle, got {u} over"
                f" {cycles}. Check the drive model and the wrench that it was given."
            )
        state = self._state
        state[3] = u
        state[:2] = (self._step if cycles == 1 else _step(cycles * self._period)).dot(state)

    def correct(self, position: Array) -> JointMotion:
        """Take the measured positions (n,) [rad] of the instant up to which was predicted, and return the motion there.

        The first call starts at rest there with d = 0.

        Raises:
            StateError: a wrong shape, or a value that is not finite.

        """
        if position.shape != self._shape or not math.isfinite(position.dot(position)):
            raise StateError(
                f"the joint filter expects {self._shape[0]} finite positions, got {position}. Predict over the cycles"
                " without a measurement instead."
            )
        state = self._state
        if not self._started:
            state[:] = 0.0
            state[0] = position
            self._started = True
        self.innovation = position - state[0]
        state += self._gain * self.innovation
        position, velocity, acceleration = _READ.dot(state)
        return JointMotion(position, velocity, acceleration)


_READ = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
"""q, q̇ and q̈ = d + u from q, q̇, d and u: one product gives new arrays for all of them."""


def _step(t: float) -> Array:
    """Return what makes q and q̇ a time t later of q, q̇, d and u, (2, 4)."""
    return np.array([[1.0, t, 0.5 * t * t, 0.5 * t * t], [0.0, 1.0, t, t]])


def _stationary(
    period_s: float, sigma_q: float, sigma_a: float, sigma_d: float
) -> tuple[Array, Array, NDArray[np.complex128]]:
    """Return K (3,), P (3, 3) and the poles (3,) of one joint."""
    transition = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    white, walk = sigma_a * period_s**2 / sigma_q, sigma_d * period_s**2.5 / sigma_q
    if not (white <= WHITE_BOUND and WALK_BOUNDS[0] <= walk <= WALK_BOUNDS[1]):
        raise ConfigurationError(
            f"the joint filter's noises σ_q = {sigma_q:g} rad, σ_a = {sigma_a:g} rad/s², σ_d = {sigma_d:g} rad/s²/√s"
            f" are too far apart at T = {period_s:g} s: σ_a T²/σ_q = {white:.2g} (bound {WHITE_BOUND:g}), σ_d T^2.5/σ_q"
            f" = {walk:.2g} (bounds {WALK_BOUNDS[0]:g} and {WALK_BOUNDS[1]:g}). Check their units."
        )
    drive = np.array([0.5, 1.0, 0.0])
    process = white**2 * np.outer(drive, drive)
    process[2, 2] = walk**2
    measured = np.array([[1.0, 0.0, 0.0]])
    covariance = solve_discrete_are(transition.T, measured.T, process, np.eye(1))
    gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
    poles = np.linalg.eigvals(transition - np.outer(transition @ gain, measured)).astype(np.complex128)
    scale = np.array([1.0, 1.0 / period_s, 1.0 / period_s**2])
    return gain * scale, covariance * np.outer(scale, scale) * sigma_q**2, poles
