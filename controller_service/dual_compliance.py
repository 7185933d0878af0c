"""When the hand gives way: the switch of dual compliance, section IV-C of [Benallegue 2021]."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.control_law import DualCompliance


@dataclass(frozen=True, slots=True)
class Compliance:
    """State of the switch at a tick."""

    active: bool
    """The hand is to give way: admittance, and no stiffness."""
    engaged: bool
    """It became so at this tick."""
    released: bool
    """It ceased to be so at this tick: where the hand is now is where it is to stay."""


class DualComplianceSwitch:
    """On when the force at the hand is above `force_on`, off when it has stayed below `force_off` for `dwell_s`.

    The gap between the two forces keeps noise, and the dwell the moment in which a guiding hand changes direction, from
    switching it back and forth.

    Args:
        config: thresholds and dwell.
        period_s: of the control cycle.

    """

    def __init__(self, config: DualCompliance, period_s: float) -> None:
        self._config = config
        self._dwell = config.dwell_s - 0.5 * period_s
        """Half a period less, so that a sum of rounded periods does not wait for one cycle more."""
        self._active = False
        self._below: float | None = None
        """Time [s] since the first force below `force_off` of those that followed each other; None: not below."""

    def reset(self) -> None:
        """Switch off without a release, as when the hand task starts anew."""
        self._active = False
        self._below = None

    def update(self, force_norm: float, elapsed_s: float) -> Compliance:
        """Take the norm [N] of the estimated force at the hand, `elapsed_s` after the last."""
        if not self._active:
            self._active = force_norm > self._config.force_on
            self._below = None
            return Compliance(self._active, engaged=self._active, released=False)
        if not force_norm < self._config.force_off:
            self._below = None
            return Compliance(active=True, engaged=False, released=False)
        self._below = 0.0 if self._below is None else self._below + elapsed_s
        self._active = self._below < self._dwell
        return Compliance(self._active, engaged=False, released=not self._active)
