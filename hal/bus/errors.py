"""Errors of the buses."""

from __future__ import annotations

import hal.errors


class BusError(hal.errors.HalError):
    """Base of everything that can go wrong on a CAN bus or while opening one."""


class BusUnavailableError(BusError):
    """The bus cannot be opened: nobody serves it, or its name or interface is wrong."""


class BusInUseError(BusError):
    """Another process serves this virtual bus already."""


class BusLostError(BusError, hal.errors.BusLostError):
    """The bus has gone while it was open: its host ended or its interface went down."""


class BusOverflowError(BusError):
    """The bus takes no more frames: its other side has stopped to read."""
