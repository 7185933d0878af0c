"""The plants of a sweep: each seed has torque constants, friction and masses of its own, none as the controller's."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

VARIATION_STREAM: Final = 20
"""A generator of its own beside those of the plant, so that one more draw here or there changes nothing elsewhere."""
TORQUE_SCALE: Final = (0.85, 1.0)
"""Range of the true over the nominal motor torque, uniform."""
FRICTION_ERROR: Final = 0.3
"""Each joint's friction is the scenario's times a factor in 1 ± this, which the plant draws from the run's seed."""
MASS_ERROR: Final = 0.1
"""Each link's mass and inertia is the description's times 1 ± this, signs drawn by the plant from the run's seed."""


def vary(seed: int) -> dict[str, Any]:
    """Draw the plant of a seed, as overrides for `schemas.load.load_run`.

    Depends on `seed` alone: the same for one run and for the same seed in a sweep of any length.
    """
    generator = np.random.default_rng([seed, VARIATION_STREAM])
    return {
        "plant.torque_scale": float(generator.uniform(*TORQUE_SCALE)),
        "plant.friction_error": FRICTION_ERROR,
        "plant.mass_error": MASS_ERROR,
    }


def varied(overrides: dict[str, Any], seed: int) -> dict[str, Any]:
    """Put the variation of a seed below a user's overrides: a field that these set, or a whole of fields, holds."""
    return {path: value for path, value in vary(seed).items() if path not in overrides} | overrides
