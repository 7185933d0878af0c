"""Savitzky-Golay filters: value and derivatives of sampled signals, section 2.1 of [Del Prete 2016].

A polynomial of a low order p is fitted by least squares to the last w samples y_{k−w+1} … y_k, T apart, and read at
one place of the window, c samples after its first one. With x_i = i − c and V_ij = x_i^j, j = 0 … p, the estimate of
the derivative d is

    ŷ^(d) = d!/T^d e_dᵀ (Vᵀ V)⁻¹ Vᵀ y = a_dᵀ y:

the pseudo-inverse is known beforehand, all rows a_d together are one product with the window ([Schafer 2011];
[Luo, Ying & Bai 2005] for even windows, where the centre lies between two samples). No model of the joint enters, so
none can be wrong when somebody pushes; the price is the delay or the noise:

- `centre`: c = (w − 1)/2. The coefficients are symmetric or antisymmetric about it, so the phase is linear: value and
  derivatives of *any* signal belong to one instant, (w − 1)/2 T ago. The paper calls this half the window, 40 ms for
  80 samples of 1 ms; it is 39.5 ms. A polynomial of order p + 1 is still right in every second derivative, from p
  downwards: the mean of a ramp is its middle.
- `end`: c = w − 1. Right now and not late, but only for polynomials up to order p; the noise of the value is about
  (p + 1)/√w of the samples', at the centre 1/√w for p ≤ 1 and 1.5/√w for p ≤ 3. Moreover the highest derivative,
  d = p, is one number over the whole window, the same in both modes: q̈ from parabolas is as late at the end as at
  the centre, and what is combined with q̇ and q at the end belongs to another instant.

Identification works on records, where nothing has to be causal (section 3.4.3): `smooth` puts the estimate of the
centre at the time to which it belongs.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from controller_service.errors import StateError
from controller_service.model import Array
from schemas.errors import ConfigurationError

EXACTNESS = 1e-6
"""How far coefficients may be from giving the polynomials back, as a share of what rounding acts upon."""


class SavitzkyGolay:
    """The filter of all channels of a signal, sample by sample.

    Args:
        channels: of a sample, n.
        window: w, samples in the fit.
        order: p, of the polynomial; w > p.
        period_s: T.
        derivatives: the highest that is wanted, 0 … p.
        at: the place of the estimate in the window, its centre or its last sample.

    Attributes:
        delay_s: age of what is estimated: (w − 1)/2 T at the centre (the paper: half the window), 0 at the end.
        noise_gain: (derivatives + 1,): white noise of deviation σ in the samples gives `noise_gain[d]` σ in the
            derivative d, the root of the sum of its squared coefficients; [1/s^d].

    Raises:
        ConfigurationError: a window below 2 or not above the order, more derivatives than the order has, a period or
            number of channels that is not positive, or an order too high to be computed for this window.

    """

    def __init__(
        self,
        channels: int,
        window: int,
        order: int,
        period_s: float,
        *,
        derivatives: int = 0,
        at: Literal["centre", "end"] = "centre",
    ) -> None:
        if channels < 1:
            raise ConfigurationError(f"a Savitzky-Golay filter needs at least one channel, not {channels}")
        if at not in ("centre", "end"):
            raise ConfigurationError(f"a Savitzky-Golay filter estimates at the 'centre' or at the 'end', not {at!r}")
        _check(window, order, derivatives, period_s)
        half = 0.5 * (window - 1)
        self._coefficients = np.array(
            [
                _coefficients(window, order, d, period_s, half if at == "centre" else window - 1.0)
                for d in range(derivatives + 1)
            ]
        )
        self.delay_s: float = half * period_s if at == "centre" else 0.0
        self.noise_gain: Array = np.sqrt(np.sum(self._coefficients**2, axis=1))
        self._window = window
        self._shape = (channels,)
        self._samples = np.zeros((2 * window, channels))
        """Every sample twice, w rows apart, so that the last w are always one slice, in order."""
        self._pair = self._samples.reshape(2, window, channels)
        """The same memory: `_pair[:, i]` are both places of a sample."""
        self._last = 0
        """Row of the last sample, 0 … w − 1."""
        self._seen = 0

    @property
    def ready(self) -> bool:
        """Whether a whole window of samples was seen, those filled in for missed ones included."""
        return self._seen >= self._window

    def restart(self) -> None:
        """Forget everything: the next sample is a first one."""
        self._seen = 0

    def update(self, sample: Array, cycles: int = 1) -> Array:
        """Take the next sample and return its value and derivatives, (derivatives + 1, n), [unit/s^d] in row d.

        The first sample fills the window, as of a robot that stands still. The result is a new array at every call.

        Args:
            sample: (n,).
            cycles: periods since the last sample. Those in between were missed and are taken from the line from the
                last sample to this one.

        Raises:
            StateError: a wrong shape, a value that is not finite (it would stay for a whole window), or cycles < 1.

        """
        if sample.shape != self._shape or cycles < 1 or not math.isfinite(sample.dot(sample)):
            raise StateError(
                f"a Savitzky-Golay filter expects {self._shape[0]} finite values, at least one cycle after the last,"
                f" got {sample} after {cycles} cycles. Leave out what a sensor did not measure, and count its cycles."
            )
        if not self._seen:
            self._samples[:] = sample
            self._last, self._seen = 0, 1
        elif cycles == 1:
            self._last = (self._last + 1) % self._window
            self._pair[:, self._last] = sample
            self._seen += 1
        else:
            self._fill(sample, cycles)
        estimate: Array = self._coefficients.dot(self._samples[self._last + 1 : self._last + 1 + self._window])
        return estimate

    def _fill(self, sample: Array, cycles: int) -> None:
        """Put the sample and the missed ones before it, at most a window of them, into the ring."""
        count = min(cycles, self._window)
        before = self._samples[self._last]
        backwards = np.arange(count - 1.0, -1.0, -1.0)[:, None] / cycles
        line = sample - backwards * (sample - before)
        rows = (self._last + 1 + np.arange(count)) % self._window
        self._pair[:, rows] = line
        self._last = int(rows[-1])
        self._seen += count


def smooth(signal: Array, window: int, order: int, period_s: float, derivative: int = 0) -> Array:
    """Estimate a whole recorded signal without delay, section 3.4.3 of [Del Prete 2016].

    Row k is the estimate for the time of row k, from the window that has it in its centre; in the first and last half
    window, from the polynomial of the first and last whole window, where the noise is larger. An even window has no
    sample in its centre and is taken one longer. So with w odd, or w + 1 for it, and D = (w − 1)/2, row k is what
    `SavitzkyGolay` gives at the centre when it has seen row k + D.

    Args:
        signal: (K, n), T apart, K at least the window.
        window: w.
        order: p < w.
        period_s: T.
        derivative: d, 0 … p.

    Returns:
        (K, n) [unit/s^d].

    Raises:
        ConfigurationError: as of `SavitzkyGolay`, or a signal that is no matrix, too short or not finite.

    """
    _check(window, order, derivative, period_s)
    odd = window + 1 - window % 2
    if signal.ndim != 2 or len(signal) < odd:
        raise ConfigurationError(
            f"expected a signal (samples, channels) of at least {odd} samples, the window, got {signal.shape}."
            " Record longer or take a shorter window."
        )
    if not np.isfinite(signal).all():
        row = int(np.flatnonzero(~np.isfinite(signal).all(axis=1))[0])
        raise ConfigurationError(
            f"the signal is not finite in sample {row}: {signal[row]}. Cut it out before smoothing."
        )
    _coefficients(odd, order, derivative, period_s, 0.5 * (odd - 1))
    smoothed: Array = savgol_filter(signal, odd, order, deriv=derivative, delta=period_s, axis=0, mode="interp")
    return smoothed


def _check(window: int, order: int, derivatives: int, period_s: float) -> None:
    if window < 2 or not 0 <= order < window:
        raise ConfigurationError(
            f"a Savitzky-Golay window of {window} samples cannot hold a polynomial of order {order}:"
            " at least 2 samples, and more than the order, which is 0 or higher"
        )
    if not 0 <= derivatives <= order:
        raise ConfigurationError(
            f"a polynomial of order {order} has no derivative {derivatives}: ask for 0 to {order}, or raise the order"
        )
    if not (math.isfinite(period_s) and period_s > 0.0):
        raise ConfigurationError(f"the period of a Savitzky-Golay filter must be positive, not {period_s} s")


def _coefficients(window: int, order: int, derivative: int, period_s: float, place: float) -> Array:
    """Return a_d (w,) for the estimate `place` samples after the first one, or refuse when rounding has spoilt it."""
    coefficients: Array = savgol_coeffs(window, order, deriv=derivative, delta=period_s, pos=place, use="dot")
    # scipy solves with the bare powers of up to w, ill-conditioned for high orders, and does not say when it fails
    reach = max(place, window - 1.0 - place)
    powers = ((np.arange(window) - place) / reach) ** np.arange(order + 1)[:, None]
    wanted = np.zeros(order + 1)
    wanted[derivative] = math.factorial(derivative) / (reach * period_s) ** derivative
    error = np.max(np.abs(powers @ coefficients - wanted)) / np.sum(np.abs(coefficients))
    if not error <= EXACTNESS:
        raise ConfigurationError(
            f"Savitzky-Golay coefficients of order {order} over {window} samples are wrong by {error:.1g} of their sum"
            f" (bound {EXACTNESS:g}): rounding. Take a lower order or a shorter window."
        )
    return coefficients
