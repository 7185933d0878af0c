"""The torque law of [Benallegue 2021]: inverse dynamics (2) and what the integral of the velocity error adds to it.

With s = q̇ʳ − q̇ and e = ∫J̇ s dt the law (20) is that of (2), (3) in the velocity error a = s − J⁺e, whose reference
velocity and acceleration are

    q̇ᵃ = q̇ʳ − J⁺e                        (17)
    q̈ᵃ = q̈ʳ − J⁺J̇ s − (dJ⁺/dt) e          (19)

    uᵃ = M q̈ᵃ + C q̇ᵃ + g + K a = uʳ + C a − M (J⁺J̇ s + (dJ⁺/dt) e) + K a          (21)

(The paper prints (17) as "ȧ", (18) with J̇⁺ for dJ⁺/dt, and below (21) a uʳ with C q̇ʳ: since C q̇ᵃ = C q̇ + C a, uʳ is
that of (2) with C q̇, or C s would count twice.) Closed with (1) and no external force, M ȧ = −(C + K) a, so V = ½ aᵀM a
falls with V̇ = −aᵀK a, and J a = J s − e = ∫ë_T (25), since J J⁺ = I.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from controller_service.anti_windup import AntiWindupLimit
from controller_service.errors import ControllerError
from controller_service.model import Array, Configuration
from controller_service.null_space import TaskInverse, TaskJacobian, invert, smallest_singular_value
from schemas.control_law import Leak, NullSpace
from schemas.controller import ControllerConfig

CALM_S = 0.5
"""Time constant of the slow state's mean that a robot which gives way returns to."""
RETURN_S = 0.1
"""Time constant of that return."""
RETURN_FACTOR = 1.2
"""Of the smallest singular value: from where J⁺ is trusted again."""
PURE = Leak(slow_rate=0.0, fast_rate=0.0, fast_share=0.0)
"""A pure integrator: s̃ = s."""


@dataclass(frozen=True, slots=True)
class LawTerms:
    """The terms of u = uʳ + (C ã − feed-forward) + ũ_K, each (n,)."""

    velocity_error: Array
    """s = q̇ʳ − q̇ [rad/s], without leak."""
    inertial: Array
    """C ã − σ M (J⁺J̇ s̃ + (dJ⁺/dt) ẽ) [N·m]: what stays unlimited, since it vanishes with the velocity."""
    windup: Array
    """u_K [N·m], before the limit."""
    limited: Array
    """ũ_K [N·m]."""
    bound: Array
    """Of ũ_K [N·m]."""
    null_space_share: float
    """σ."""

    @property
    def integral(self) -> Array:
        """All that is added to uʳ (n,) [N·m]: L s of (3), or the terms after uʳ in (21)."""
        total: Array = self.inertial + self.limited
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


class LeakyState:
    """s^θ and e^θ of one forgetting rate θ: ṡ^θ = −θ s^θ + ṡ (12), ė^θ = −θ e^θ + J̇ s^θ.

    (13): s_k^θ = e^(−θT) s_{k−1}^θ + (s_k − s_{k−1}), exact for increments that come at the samples. e^θ takes the
    change of J over a period at the mean of both ends,

        e_k^θ = e^(−θT) e_{k−1}^θ + (J_k − J_{k−1}) ½ (e^(−θT) s_{k−1}^θ + s_k^θ),

    so that J_k s_k^θ − e_k^θ is exactly the leaky sum of ½ (J_k + J_{k−1})(s_k − s_{k−1}): with the leak, (25) still
    says that J a^θ is the (leaky) integral of the task's acceleration error J ṡ, whatever J does meanwhile.
    """

    def __init__(self, n: int, rate: float) -> None:
        self._rate = rate
        self.error = np.zeros(n)
        """s^θ (n,) [rad/s]."""
        self.drift: Array | None = None
        """e^θ (m,); None while no task runs."""

    def start(self, error: Array) -> None:
        """Set s^θ and forget e^θ."""
        self.error = error
        self.drift = None

    def advance(self, increment: Array, jacobian_change: Array | None, elapsed_s: float) -> None:
        """Take s_k − s_{k−1} (n,) and J_k − J_{k−1} (m, n); None where the task begins or does not run."""
        kept = math.exp(-self._rate * elapsed_s)
        before = kept * self.error
        self.error = before + increment
        if jacobian_change is None or self.drift is None:
            return
        self.drift = kept * self.drift + 0.5 * jacobian_change.dot(before + self.error)


class IntegralLaw:
    """What the law adds to uʳ, with the state q̇ʳ that it integrates.

    In closed loop on a perfect model M ṡ = −(C + K) s, so V = ½ sᵀ M s decays: V̇ = −sᵀ K s. Since s holds the
    integral of the tasks' errors, the tasks' PD becomes a PID: (p + λ)(p² + K_v p + K_p) e ~ p d/M for a disturbance d.
    q̇ʳ ← q̇ʳ + T q̈ʳ is exact for the q̈ʳ that (like the torque) is held over the period; it is the QP's q̈ʳ, limits and
    all: where one holds u back, q̇ʳ is held back with it.

    **Leak**: s̃ = μ s^θf + (1 − μ) s^θs (14) takes the place of s everywhere. A pure integrator has θ = 0, μ = 0.

    **Null space**: with a task and its share σ from 0 to 1 (`NullSpace.fade_s` apart) the law is (1 − σ)·(3) + σ·(21),
    with a^θ = s^θ − J⁺e^θ for both rates, and (26) for the gain: u_K = (1 − μ) JᵀJ⁺ᵀ K J⁺J a^θs + μ K a^θf. The slow
    memory then acts in the task alone; the null space keeps friction, damping and the fast part. With a leak the slow
    state's null-space part is forgotten at the fast rate.

    **Anti-windup**: u_K is limited (`AntiWindupLimit`). In (11) the place of s is taken by the velocity error whose V
    is to fall: s̃ with (14), ã = (1 − σ) s̃ + σ (μ a^θf + (1 − μ) a^θs) with (26), as V̇ = −ãᵀũ_K without leak. (26) has
    ãᵀu_K ≥ 0 for μ = 0, so ãᵀũ_K ≥ λ_w ãᵀu_K keeps the decay. With (14) and diagonal K the half-space never acts
    (`anti_windup.project`). λ_w u_K satisfies (11) whatever the vector, so it always has a solution.

    **Back-calculation** (not in the paper): while the limit acts, ṡ^θs gets −κ K⁻¹(u_K − ũ_K)/(1 − μ).

    Args:
        n: joints.
        config: λ, leak, anti-windup, null space.
        torque_limit: (n,) [N·m].

    """

    def __init__(self, n: int, config: ControllerConfig, torque_limit: Array) -> None:
        leak = config.leak or PURE
        self._lambda = config.lambda_
        self._share = leak.fast_share
        self._enabled = config.integral == "passivity"
        self._null_space: NullSpace | None = config.null_space
        self._back_calculation = config.anti_windup.back_calculation
        self._forget_rate = leak.fast_rate
        self._slow, self._fast = LeakyState(n, leak.slow_rate), LeakyState(n, leak.fast_rate)
        self._limit = AntiWindupLimit(torque_limit, config.anti_windup)
        self._jacobian: Array | None = None
        self._fade = 0.0
        self._applied = np.zeros(n)
        """ũ_K of the last tick."""
        self._calm = np.zeros(n)
        """Mean of the slow state over the last `CALM_S` or so without contact."""
        self._resting = False
        self._last = np.zeros(n)
        self.velocity_reference = np.zeros(n)
        """q̇ʳ (n,) [rad/s]."""

    def reset(self, now: Configuration, torque: Array | None = None) -> None:
        """Set q̇ʳ = q̇ + s₀ such that the law adds `torque` (section IV-A), or nothing.

        All of it goes into the slow state: (1 − μ)(C + K) s₀ = torque. The bound of u_K starts where that needs it.
        """
        zero: Array = np.zeros(len(now.velocity))
        start: Array = zero
        if torque is not None and self._enabled:
            *_, solution, fault = lapack.dgesv(integral_gain(now, self._lambda), torque)
            if fault != 0:
                raise ControllerError("the integral gain C + K is singular: change to torque mode at rest")
            start = solution / (1.0 - self._share)
        self._slow.start(start)
        self._fast.start(zero)
        self._calm = start
        self._last = start
        self._fade, self._jacobian = 0.0, None
        self.velocity_reference = now.velocity + start
        self._limit.start((1.0 - self._share) * self._lambda * now.mass.diagonal() * start)

    def integrate(self, acceleration: Array, elapsed_s: float) -> None:
        """q̇ʳ ← q̇ʳ + T q̈ʳ (n,), held for `elapsed_s`."""
        self.velocity_reference = self.velocity_reference + elapsed_s * acceleration

    def rest(self, now: Configuration, elapsed_s: float) -> None:
        """Let q̇ʳ go with the robot, in place of `integrate`, while it gives way to a contact.

        s stays, so that giving way winds nothing up, and the slow state returns to what it was before the contact
        (`CALM_S` ago on average): that carries errors of masses and torque constants, but does not push back.
        """
        self.velocity_reference = now.velocity + self._last
        share = 1.0 - math.exp(-elapsed_s / RETURN_S)
        self._slow.error = self._slow.error + share * (self._calm - self._slow.error)
        self._resting = True

    def terms(self, now: Configuration, task: TaskJacobian | None, elapsed_s: float) -> LawTerms:
        """Take up the velocity error of a tick, `elapsed_s` after the last one (0 at the first)."""
        if not self._enabled:
            zero = np.zeros(len(now.velocity))
            return LawTerms(zero, zero, zero, zero, self._limit.bound, 0.0)
        error = self.velocity_reference - now.velocity
        inverse = self._prepare(now, task, elapsed_s)
        change = None if inverse is None or self._jacobian is None else inverse.task.jacobian - self._jacobian
        self._jacobian = None if inverse is None else inverse.task.jacobian
        for state in (self._slow, self._fast):
            state.advance(error - self._last, change, elapsed_s)
        self._last = error
        if not self._resting:
            self._calm = self._calm + (1.0 - math.exp(-elapsed_s / CALM_S)) * (self._slow.error - self._calm)
        self._resting = False
        self._limit.advance(elapsed_s)
        gain = self._lambda * now.mass.diagonal()
        if inverse is None:
            mixed = self._mix(self._fast.error, self._slow.error)
            inertial, windup, velocity = now.coriolis.dot(mixed), gain * mixed, mixed
        else:
            inertial, windup, velocity = self._compliant(now, inverse, gain)
        limited = self._applied = self._limit.limit(windup, velocity)
        if self._back_calculation > 0.0 and elapsed_s > 0.0:
            share = min(1.0, self._back_calculation * elapsed_s) / (1.0 - self._share)
            self._slow.error = self._slow.error - share * (windup - limited) / gain
        return LawTerms(error, inertial, windup, limited, self._limit.bound, self._fade)

    def _prepare(self, now: Configuration, task: TaskJacobian | None, elapsed_s: float) -> TaskInverse | None:
        """Move σ towards 1 where the task can be inverted, towards 0 elsewhere; None while σ is 0."""
        config = self._null_space
        if config is None:
            return None
        inverse = None
        bound = config.smallest_singular_value * (1.0 if self._fade > 0.0 else RETURN_FACTOR)
        if task is not None and smallest_singular_value(task.jacobian) > bound:
            inverse = invert(now, task, config.inverse)
        if inverse is None:
            if self._fade > 0.0:
                # Without J⁺ there is nothing to fade over: (3) goes on from the torque that (21) gave last.
                gain = self._lambda * now.mass.diagonal() * (1.0 - self._share)
                self._slow.start((self._applied - self._share / (1.0 - self._share) * gain * self._fast.error) / gain)
                self._fast.drift = None
            self._fade = 0.0
            return None
        if self._slow.drift is None:
            m = len(inverse.task.jacobian)
            self._slow.drift, self._fast.drift, self._jacobian = np.zeros(m), np.zeros(m), None
        self._fade = min(1.0, self._fade + elapsed_s / config.fade_s)
        self._forget_null_space(inverse, elapsed_s)
        return inverse

    def _forget_null_space(self, inverse: TaskInverse, elapsed_s: float) -> None:
        """Let the slow state's null-space part (I − J⁺J) s^θs go at the fast rate, times σ.

        (26) keeps it out of u_K, where neither limit nor back-calculation sees it, but the inertial terms have it. It
        is no part of J s^θs, so the task's memory stays as it is.
        """
        kept = math.exp(-self._fade * self._forget_rate * elapsed_s)
        if kept < 1.0:
            slow = self._slow.error
            self._slow.error = slow - (1.0 - kept) * (slow - inverse.inverse.dot(inverse.task.jacobian.dot(slow)))

    def _compliant(self, now: Configuration, inverse: TaskInverse, gain: Array) -> tuple[Array, Array, Array]:
        """Inertial terms, u_K and ã of (1 − σ)·(3) + σ·(21) with (26)."""
        slow, fast, share, mu = self._slow, self._fast, self._fade, self._share
        assert slow.drift is not None
        assert fast.drift is not None
        jacobian, plus = inverse.task.jacobian, inverse.inverse
        error, drift = self._mix(fast.error, slow.error), self._mix(fast.drift, slow.drift)
        compliant = error - share * plus.dot(drift)
        feedforward = plus.dot(inverse.task.rate.dot(error)) + inverse.rate_times(drift)
        inertial = now.coriolis.dot(compliant) - share * now.mass.dot(feedforward)
        # J⁺J a^θs = J⁺(J s^θs − e^θs): the slow memory of the task alone
        slow_task = plus.dot(jacobian.dot(slow.error) - slow.drift)
        slow_torque = (gain * slow_task).dot(plus).dot(jacobian)
        fast_error = fast.error - share * plus.dot(fast.drift)
        windup = mu * gain * fast_error
        windup += (1.0 - mu) * ((1.0 - share) * gain * slow.error + share * slow_torque)
        return inertial, windup, compliant

    def _mix(self, fast: Array, slow: Array) -> Array:
        mixed: Array = self._share * fast + (1.0 - self._share) * slow
        return mixed
