"""Errors of the simulated plant."""

from __future__ import annotations

from schemas.errors import CosimError


class PlantError(CosimError):
    """Base of what the plant refuses or cannot go on with; the message names joint, field, value and bound."""


class DivergedError(PlantError):
    """The simulation left the finite numbers."""
