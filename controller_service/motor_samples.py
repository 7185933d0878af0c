"""Samples from which the motor model of one joint is identified, and what they must have, [Del Prete 2016] 3.

The model of a motor whose drive takes angles alone is (6) of the paper, one joint:

    Δq = k_τ τ + k_v q̇ + k_c sign(q̇),    Δq = q_target − q.

Data that cannot tell its gains apart are refused here, before a fit makes numbers of them: "it is then important to
make sure that the collected data properly cover the whole operative region of τ and q̇" (3.4).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from controller_service.model import Array
from schemas.errors import CosimError

BLOCK: Final = 2048
"""Samples handled at once: no large temporary is made, and products so small stay in one thread of the algebra library,
so that sums do not depend on how many it has."""


class Fault(StrEnum):
    """Why samples or arguments are refused; the texts are in `IdentificationError`."""

    SHAPE = "shape"
    TOO_FEW = "too few"
    TOO_MANY = "too many"
    NOT_FINITE = "not finite"
    TORQUE_SPREAD = "torque spread"
    VELOCITY_SPREAD = "velocity spread"
    OFFSET_SIGN = "offset sign"
    VELOCITY_SIGN = "velocity sign"
    COLLINEAR = "collinear"
    NO_MODEL = "no model"
    ARGUMENT = "argument"


_TEXTS: Final = {
    Fault.SHAPE: "{detail} has {value:.0f} samples, the offset {bound:.0f}. Give one-dimensional arrays of one length",
    Fault.TOO_FEW: "{value:.0f} samples, fewer than {bound:.0f}. Record longer, or thin the log less",
    Fault.TOO_MANY: "{value:.0f} samples, more than the {bound:.0f} of the QP. Thin them, or use method newton",
    Fault.NOT_FINITE: "{value:.0f} samples are not finite. Leave out those for which there is no estimate",
    Fault.TORQUE_SPREAD: "torques deviate by {value:.3g} N·m, not by more than {bound:.3g}. Load the joint more",
    Fault.VELOCITY_SPREAD: "velocities deviate by {value:.3g} rad/s, not by more than {bound:.3g}. Move it faster",
    Fault.OFFSET_SIGN: "{value:.2%} of the offsets have the rarer sign, less than {bound:.2%}. Load it both ways",
    Fault.VELOCITY_SIGN: "{value:.2%} of the motion is the rarer way, less than {bound:.2%}. Move it both ways",
    Fault.COLLINEAR: "torque and {detail} have condition number {value:.3g}, more than {bound:.3g}: their gains cannot"
    " be told apart. Vary them independently",
    Fault.NO_MODEL: "the piecewise fit ended with {detail} in iteration {value:.0f}. Start it nearer to the bends, or"
    " record larger torques",
    Fault.ARGUMENT: "{detail} is {value:.3g}, beyond its bound {bound:.3g}. Change it",
}


class IdentificationError(CosimError):
    """Samples from which a joint's motor model cannot be identified, or an argument that has no meaning.

    Attributes:
        joint: its name.
        reason: what is wrong.
        value, bound: the figure and what it should have kept, in the units of the message.

    """

    def __init__(self, joint: str, reason: Fault, value: float, bound: float, detail: str = "", part: str = "") -> None:
        super().__init__(f"{joint}{part}: {_TEXTS[reason].format(value=value, bound=bound, detail=detail)}.")
        self.joint = joint
        self.reason = reason
        self.value = value
        self.bound = bound


@dataclass(frozen=True, slots=True)
class MotorSamples:
    """m samples of one joint, each of one instant; in any order."""

    offset: Array
    """Δq = q_target − q (m,) [rad]: the target that acts in the drive, the angle measured."""
    torque: Array
    """τ (m,) [N·m]: estimated joint torque, motor less friction."""
    velocity: Array
    """q̇ (m,) [rad/s], estimated."""

    def __len__(self) -> int:
        return len(self.offset)

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> MotorSamples:
        """Give the samples of a mask or of indices."""
        return MotorSamples(self.offset[chosen], self.torque[chosen], self.velocity[chosen])

    def thinned(self, count: int) -> MotorSamples:
        """Give at most `count` samples, evenly picked (10³ "are enough to identify the model", 3.3)."""
        if count >= len(self):
            return self
        return self.where(np.arange(count, dtype=np.int64) * len(self) // count)


@dataclass(frozen=True, slots=True)
class SampleBounds:
    """What samples must have to be fitted."""

    samples: int = 50
    """Least number."""
    torque_range: float | None = None
    """Range of τ [N·m] of the joint's work; None: only a τ that does not vary at all is refused."""
    velocity_range: float | None = None
    """Range of q̇ [rad/s]; as `torque_range`."""
    excitation: float = 0.05
    """Least standard deviation of τ and q̇ over these ranges; of values spread evenly over the range it is 0.29."""
    sign_share: float = 0.01
    """Least share of the rarer sign of Δq, and of q̇ beyond the velocity that counts for rest."""
    condition: float = 30.0
    """Largest condition number of A with unit columns; more than 30 does harm [Belsley, Kuh, Welsch 1980]."""


@dataclass(frozen=True, slots=True)
class PenaltySums:
    """The penalty (8) at some gains, W = diag(w where r > 0, else 1)."""

    cost: float
    """Σ Φ(r) [rad²]."""
    gradient: Array
    """Aᵀ W (A x − b) (unknowns,): half the gradient of the cost."""
    weighted: Array
    """[A b]ᵀ W [A b] (unknowns + 1, unknowns + 1); its part of A is half the Hessian."""
    over: NDArray[np.bool_]
    """Where the weight is w (m,)."""

    def residual(self, free: NDArray[np.int64]) -> float:
        """Give the largest gradient of the unknowns `free` over Cauchy's bound of its parts, ‖√W a_j‖ ‖√W b‖."""
        square = self.weighted.diagonal()
        return float((np.abs(self.gradient[free]) / np.sqrt(square[free] * square[-1])).max())


@dataclass(frozen=True, slots=True)
class Regression:
    """A and b of (7): columns τ, q̇ and, with k_c, sign(q̇); b = Δq."""

    samples: MotorSamples
    coulomb: bool = False
    sign_velocity: float = 0.0
    """|q̇| [rad/s] below which sign(q̇) is taken for 0."""

    @property
    def unknowns(self) -> int:
        """Columns of A."""
        return 3 if self.coulomb else 2

    def blocks(self) -> Iterator[tuple[slice, Array]]:
        """Give the transposed [A b] of `BLOCK` samples at a time, (unknowns + 1, ≤ BLOCK), in one buffer used anew."""
        m = len(self.samples)
        buffer = np.empty((self.unknowns + 1, min(BLOCK, m)))
        for first in range(0, m, BLOCK):
            part = slice(first, min(first + BLOCK, m))
            block = buffer[:, : part.stop - first]
            block[0] = self.samples.torque[part]
            block[1] = velocity = self.samples.velocity[part]
            if self.coulomb:
                block[2] = sign_beyond(velocity, self.sign_velocity)
            block[-1] = self.samples.offset[part]
            yield part, block

    def gram(self) -> Array:
        """Give [A b]ᵀ [A b] (unknowns + 1, unknowns + 1)."""
        total = np.zeros((self.unknowns + 1, self.unknowns + 1))
        for _, block in self.blocks():
            total += block @ block.T
        return total

    def penalty(self, gains: Array, weight: float, gram: Array) -> PenaltySums:
        """Sum the penalty (8) and its derivatives at gains (unknowns,), in one pass; `gram` as the method gives it."""
        seen = np.append(gains, -1.0)
        cost, gradient, over_gram = 0.0, np.zeros(self.unknowns), np.zeros_like(gram)
        over = np.empty(len(self.samples), dtype=bool)
        for part, block in self.blocks():
            error = seen @ block
            # r > 0 is e Δq > 0; the equality takes Δq = 0 along, and e = 0 adds nothing
            mask = np.greater_equal(error * block[-1], 0.0, out=over[part])
            chosen = block * mask
            over_gram += chosen @ block.T
            gradient += block[:-1] @ error + (weight - 1.0) * (chosen[:-1] @ error)
            error *= error
            cost += float(error.sum() + (weight - 1.0) * (error @ mask))
        return PenaltySums(cost, gradient, gram + (weight - 1.0) * over_gram, over)


def sign_beyond(velocity: Array, threshold: float) -> Array:
    """Give sign(q̇) (m,), 0 where |q̇| is below a threshold [rad/s]."""
    sign: Array = np.sign(velocity)
    if threshold > 0.0:
        sign *= np.abs(velocity) >= threshold
    return sign


def condition_number(gram: Array) -> float:
    """Condition number of A with its columns scaled to unit length, from AᵀA; infinite where A lacks rank."""
    length = np.sqrt(gram.diagonal())
    if not length.all():
        return np.inf
    values = np.linalg.eigvalsh(gram / np.outer(length, length))
    # Below the rounding of the sums the smallest eigenvalue means nothing
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-13 else np.inf


DEFAULT_BOUNDS: Final = SampleBounds()


def check_samples(
    joint: str,
    samples: MotorSamples,
    *,
    moving: bool = True,
    coulomb: bool = False,
    sign_velocity: float = 0.0,
    bounds: SampleBounds = DEFAULT_BOUNDS,
    part: str = "",
) -> None:
    """Refuse samples from which the gains of (6) cannot be told.

    Args:
        joint: its name, for the message.
        samples: of one joint.
        moving: k_v is wanted; without it velocities may be anything finite.
        coulomb: k_c is wanted too.
        sign_velocity: |q̇| [rad/s] that counts for rest.
        bounds: what is asked of the samples.
        part: which of the joint's samples these are, for the message.

    Raises:
        IdentificationError: the first fault found.

    """
    regression = Regression(samples, coulomb, sign_velocity)
    fault = next(_faults(regression, moving, bounds), None)
    if fault is not None:
        raise IdentificationError(joint, *fault, part=part)


def _faults(regression: Regression, moving: bool, bounds: SampleBounds) -> Iterator[tuple[Fault, float, float, str]]:
    """Give fault, value, bound and detail, one after the other as they are found."""
    samples = regression.samples
    m = np.size(samples.offset)
    arrays = {"the offset": samples.offset, "the torque": samples.torque, "the velocity": samples.velocity}
    for name, values in arrays.items():
        if np.shape(values) != (m,):
            yield Fault.SHAPE, np.size(values), m, name
    if m < bounds.samples:
        yield Fault.TOO_FEW, m, bounds.samples, ""
    finite = np.isfinite(samples.offset) & np.isfinite(samples.torque) & np.isfinite(samples.velocity)
    if not finite.all():
        yield Fault.NOT_FINITE, m - int(np.count_nonzero(finite)), 0, ""
    spread, least = _spread(samples.torque, bounds.torque_range, bounds)
    if spread <= least:
        yield Fault.TORQUE_SPREAD, spread, least, ""
    share = _rarer_sign(samples.offset, 0.0)
    if share < bounds.sign_share:
        yield Fault.OFFSET_SIGN, share, bounds.sign_share, ""
    if not moving:
        return
    spread, least = _spread(samples.velocity, bounds.velocity_range, bounds)
    if spread <= least:
        yield Fault.VELOCITY_SPREAD, spread, least, ""
    share = _rarer_sign(samples.velocity, regression.sign_velocity)
    if share < bounds.sign_share:
        yield Fault.VELOCITY_SIGN, share, bounds.sign_share, ""
    condition = condition_number(regression.gram()[:-1, :-1])
    if condition > bounds.condition:
        names = "velocity and its sign" if regression.coulomb else "velocity"
        yield Fault.COLLINEAR, condition, bounds.condition, names


def _spread(values: Array, given: float | None, bounds: SampleBounds) -> tuple[float, float]:
    """Give the standard deviation and what it must exceed; without a range, what rounding makes of a constant."""
    least = 1e-9 * float(np.abs(values).max()) if given is None else bounds.excitation * given
    return float(values.std()), least


def _rarer_sign(values: Array, threshold: float) -> float:
    positive, negative = int(np.count_nonzero(values > threshold)), int(np.count_nonzero(values < -threshold))
    return min(positive, negative) / max(positive + negative, 1)
