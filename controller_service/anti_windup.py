"""The limit of the integral torque u_K = K s̃: QP-based anti-windup, section III-B of [Benallegue 2021]."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from controller_service.errors import ControllerError
from controller_service.model import Array
from controller_service.osqp_solver import OsqpSolver
from schemas.control_law import AntiWindup
from schemas.errors import ConfigurationError

SMALLEST = 1e-140
"""Components of s below are no way to change sᵀx: their squares and inverses stay finite above."""
EPSILON = float(np.finfo(float).eps)
NEGLIGIBLE = 1e-6
"""Excess of the bound over τ_m, as a share of it, that counts as none: b reaches τ_m within some 14 time constants."""
OSQP_ITERATIONS = 4000
OSQP_TOLERANCE = 1e-7
"""Of `residuals`, with torques over the largest bound and s at unit length."""

Projection = Callable[[Array, Array, Array], Array]
"""(torque, direction, bound) → limited torque."""


class AntiWindupError(ControllerError):
    """The integral torque cannot be limited.

    Attributes:
        torque, bound: as given, each (n,) [N·m].

    """

    def __init__(self, what: str, torque: Array, bound: Array) -> None:
        super().__init__(f"anti-windup: {what}")
        self.torque = torque
        self.bound = bound


def scaling_factor(torque: Array, bound: Array) -> float:
    """λ_w = min(1, min_i b_i/|u_i|) of (10): the largest factor up to 1 that takes u into the box.

    Joints within their bound do not count, so u_i = 0 divides nothing; b_i = 0 with u_i ≠ 0 gives 0.

    Args:
        torque: u (n,) [N·m].
        bound: b (n,) [N·m], not negative.

    """
    size = np.abs(torque)
    over = size > bound
    return float((bound[over] / size[over]).min()) if np.count_nonzero(over) else 1.0


def scale(torque: Array, bound: Array) -> Array:
    """λ_w u (n,), the baseline of (10), within the box exactly (b/|u|·|u| may round to beyond b)."""
    return _into_box(scaling_factor(torque, bound) * torque, bound)


def project(torque: Array, direction: Array, bound: Array) -> Array:
    """Solve (11): min ‖x − u‖² subject to −b ≤ x ≤ b and sᵀx ≥ λ_w sᵀu.

    **Dual.** With the multiplier ν ≥ 0 of the half-space, L = ½‖x − u‖² + ν (λ_w sᵀu − sᵀx), which in the box is least
    at x(ν) = clip(u + ν s, −b, b). g(ν) = sᵀx(ν) is continuous, piecewise linear and nondecreasing, with slope Σ s_i²
    over the joints strictly within their bounds. So ν = 0 where g(0) ≥ λ_w sᵀu; else ν lies between the two break
    points (a joint enters or leaves the box) whose g enclose the target, and linear interpolation is exact. The target
    is at most max g = Σ |s_i| b_i, since λ_w u is in the box; there every joint has reached its bound along s.

    **When the half-space matters.** Clipping shortens each component, |clip u|_i ≥ λ_w |u_i| with the same sign, so
    s_i clip(u)_i ≥ λ_w s_i u_i wherever s_i u_i ≥ 0. For u = K s with diagonal K ≥ 0 this holds for all joints: the
    half-space is never active, not even by rounding, and the solution is the clipped torque, 0 ≤ x_i/u_i ≤ 1. So it is
    for (3) with K = λ diag(M), and for (14) with s̃ in the place of s. It can be active only if s_i u_i < 0 for some
    joint: with a full K, as (26) has, or where s is not the vector that K multiplies. A joint's torque may then change
    its sign; the sum sᵀx ≥ λ_w sᵀu still holds, so it is positive where sᵀu is and no b_i = 0 meets u_i ≠ 0. sᵀu ≤ 0 is
    no trouble: λ_w u is always feasible.

    The box holds exactly, the half-space to rounding: a shortage below n ε Σ |s_i clip(u)_i| counts as none. The target
    is taken from `scale`, which is why rounding activates nothing.

    Args:
        torque: u (n,) [N·m], finite; not checked.
        direction: s (n,) [rad/s], or the vector in its place, finite; a factor > 0 changes nothing.
        bound: b (n,) [N·m], finite and not negative; b_i = 0 gives x_i = 0.

    Returns:
        x (n,), a new array; equal to u where u lies in the box.

    """
    clipped, shortage = _clip(torque, direction, bound)
    if shortage <= 0.0:
        return clipped
    return _into_box(torque + _multiplier(torque, direction, bound, clipped, shortage) * direction, bound)


def _clip(torque: Array, direction: Array, bound: Array) -> tuple[Array, float]:
    """clip(u), and what sᵀclip(u) lacks of the half-space, 0 where that is rounding."""
    size = np.abs(torque)
    over = size > bound
    if not np.count_nonzero(over):
        return torque.copy(), 0.0
    clipped = _into_box(torque, bound)
    scaled = _into_box((bound[over] / size[over]).min() * torque, bound)
    shortage = float(direction.dot(scaled - clipped))
    if shortage > 0.0 and shortage <= len(torque) * EPSILON * np.abs(direction).dot(np.abs(clipped)):
        shortage = 0.0
    return clipped, shortage


def _multiplier(torque: Array, direction: Array, bound: Array, clipped: Array, shortage: float) -> float:
    """ν > 0 with g(ν) − g(0) = `shortage`, or the last break point where rounding leaves g below it."""
    goal, movable = _room(direction, bound, clipped)
    # Joint i stays at clip(u)_i until ν = start_i, then moves by ν s_i until it reaches its goal at end_i
    ends = np.zeros((2, len(torque)))
    np.divide(clipped - torque, direction, out=ends[0], where=movable)
    np.divide(goal - torque, direction, out=ends[1], where=movable)
    start, end = ends
    points = np.sort(ends, axis=None)
    # g at every point by itself: running sums of slopes would lose joints with a small s_i beside large ones
    gained = (np.minimum(np.maximum(points[:, None], start), end) - start).dot(direction * direction)
    k = int(gained.searchsorted(shortage, side="right"))
    if k == len(points):
        return float(points[-1])
    before, after = float(gained[k - 1]), float(gained[k])
    low, high = float(points[k - 1]), float(points[k])
    return low + (high - low) * ((shortage - before) / (after - before))


def _room(direction: Array, bound: Array, clipped: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where each joint's torque ends as ν grows, and which are not there yet."""
    goal: Array = np.copysign(bound, direction)
    return goal, (clipped != goal) & (np.abs(direction) > SMALLEST)


def _into_box(torque: Array, bound: Array) -> Array:
    limited: Array = np.minimum(np.maximum(torque, -bound), bound)
    return limited


class OsqpProjection:
    """(11) by OSQP with one workspace: for comparison, `project` is exact and faster.

    OSQP is asked only where clipping violates the half-space. Joints whose clipped torque is at its bound along s are
    constants there (to leave it would take them away from u and sᵀx down): the rows are I, and s of the others at unit
    length. With all of s as a row, one that is nearly parallel to the axis of a joint at its bound would let OSQP run
    out of iterations. Components of s a thousand times smaller than the largest are beyond its accuracy.

    Args:
        n: joints.
        iterations: upper bound a solve.

    """

    def __init__(self, n: int, iterations: int = OSQP_ITERATIONS) -> None:
        self._solver = OsqpSolver(n, n + 1, iterations, OSQP_TOLERANCE)
        self._identity = np.eye(n)
        self._rows = np.eye(n + 1, n)
        self._lower = np.empty(n + 1)
        self._upper = np.full(n + 1, np.inf)

    def __call__(self, torque: Array, direction: Array, bound: Array) -> Array:
        """Solve; arguments and result as of `project`.

        Raises:
            AntiWindupError: OSQP did not reach the tolerance within its iterations.

        """
        clipped, shortage = _clip(torque, direction, bound)
        _, movable = _room(direction, bound, clipped)
        row = np.where(movable, direction, 0.0)
        largest = float(np.abs(row).max())
        if shortage <= 0.0 or largest == 0.0:
            return clipped
        row /= largest
        length = math.sqrt(row.dot(row))
        row /= length
        n, unit = len(torque), float(bound.max())
        self._rows[n] = row
        self._lower[n] = (row.dot(clipped) + shortage / largest / length) / unit
        np.divide(bound, unit, out=self._upper[:n])
        np.negative(self._upper[:n], out=self._lower[:n])
        aim = np.where(movable, torque, clipped) / unit
        solution = self._solver.solve(self._identity, -aim, self._rows, self._lower, self._upper)
        if not solution.solved:
            raise AntiWindupError(
                f"OSQP ended with {solution.status!r} after {solution.iterations} iterations (primal residual"
                f" {solution.primal_residual:.2g}, dual {solution.dual_residual:.2g}). Set"
                " controller.anti_windup.solver to dual.",
                torque,
                bound,
            )
        return _into_box(solution.x * unit, bound)


class AntiWindupLimit:
    """Limits u_K by the configured method, with a bound that starts where the change of mode needs it.

    The bound is τ_m = `torque_share` × torque limit. At a change of mode u_K takes over the whole torque difference
    (section IV-A), which may be more: the bound then starts at |u_K| and falls to τ_m by b ← τ_m + (b − τ_m) e^(−t/T).

    Args:
        torque_limit: τ_l (n,) [N·m].
        config: method, solver, share, decay.

    Raises:
        ConfigurationError: a torque limit that is negative or not finite.

    """

    def __init__(self, torque_limit: Array, config: AntiWindup) -> None:
        wrong = np.flatnonzero(~(np.isfinite(torque_limit) & (torque_limit >= 0.0)))
        if len(wrong):
            raise ConfigurationError(
                f"controller.anti_windup: the torque limit of joint {wrong[0]} is {torque_limit[wrong[0]]:g} N·m; give"
                " a finite one, not below 0, in the robot's description"
            )
        self._decay_s = config.decay_s
        self._method = config.method
        self._solve: Projection = OsqpProjection(len(torque_limit)) if config.solver == "osqp" else project
        self._final: Array = config.torque_share * torque_limit
        self._excess = np.zeros_like(torque_limit)
        """What b is above τ_m; kept by itself, since τ_m + excess would stop falling at some hundred ulp."""
        self.bound: Array = self._final
        """b (n,) [N·m] in effect; replaced, never changed in place."""

    def start(self, torque: Array) -> None:
        """Let the bound begin at max(τ_m, |u_K|), u_K (n,) [N·m] at the change of mode.

        Raises:
            AntiWindupError: u_K is of another shape or not finite.

        """
        if torque.shape != self._final.shape or not np.isfinite(torque).all():
            raise AntiWindupError(
                f"the torque at the change of mode is {torque}, wanted are {len(self._final)} finite values [N·m]."
                " Check the measured torques and the integral gain.",
                torque,
                self._final,
            )
        self._excess = np.maximum(np.abs(torque) - self._final, 0.0)
        self.bound = np.maximum(self._final, np.abs(torque))

    def advance(self, elapsed_s: float) -> None:
        """Let the bound fall for `elapsed_s`, exactly, however the time is divided."""
        if np.count_nonzero(self._excess):
            self._excess = self._excess * math.exp(-elapsed_s / self._decay_s)
            self._excess[self._excess < NEGLIGIBLE * self._final] = 0.0
            self.bound = self._final + self._excess

    def limit(self, torque: Array, direction: Array) -> Array:
        """ũ_K (n,) [N·m] for u_K = `torque`; `direction` is s of (11), or the vector in its place.

        Raises:
            AntiWindupError: with OSQP, see `OsqpProjection`.

        """
        if self._method == "qp":
            return self._solve(torque, direction, self.bound)
        if self._method == "scaling":
            return scale(torque, self.bound)
        return torque.copy()
