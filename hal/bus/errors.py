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


class BusStuckError(BusError):
    """The bus takes no frames now, but may again; `sent` bytes of the packet went out before."""

    def __init__(self, text: str, sent: int = 0) -> None:
        self.sent = sent
        super().__init__(text)


class BusOverflowError(BusStuckError):
    """The bus takes no more frames: its other side has stopped to read, or no node acknowledges."""


class BusDownError(BusStuckError):
    """The interface is down or absent; it is used again as soon as it comes back."""
