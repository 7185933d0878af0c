"""Frames that a CAN interface's driver or a socket has dropped, as the kernel counts them."""

from __future__ import annotations

import os
import socket
import struct
from contextlib import suppress
from typing import Final

DRIVER_COUNTERS: Final = (
    "rx_dropped",
    "rx_over_errors",
    "rx_fifo_errors",
    "rx_missed_errors",
    "rx_errors",
    "tx_dropped",
    "tx_fifo_errors",
    "tx_errors",
)
"""Files of `/sys/class/net/<interface>/statistics`; a controller's full FIFO counts as `rx_over_errors`."""
SOCKET_COUNTER: Final = "socket_dropped"
SO_MEMINFO: Final = 55
_DROPS: Final = 8
_MEMINFO: Final = struct.Struct("=9I")


class DropCounters:
    """Rises of an interface's counters and of one socket's; the files stay open, for they are read once a second."""

    def __init__(self, interface: str, connection: socket.socket, directory: str = "/sys/class/net") -> None:
        self._socket = connection
        self._path = os.path.join(directory, interface, "statistics")
        self._files: dict[str, int] = {}
        self._last: dict[str, int] = {}
        self._open()
        self._last = self._read()

    def rises(self) -> dict[str, int]:
        """Counters that have risen since the last call, and by how much."""
        now = self._read()
        # An interface that was taken out and put in again counts from zero.
        rises = {
            name: count - (before if count >= (before := self._last.get(name, 0)) else 0) for name, count in now.items()
        }
        self._last |= now
        return {name: rise for name, rise in rises.items() if rise}

    def close(self) -> None:
        """Close the files."""
        for descriptor in self._files.values():
            os.close(descriptor)
        self._files.clear()

    def _open(self) -> None:
        for name in DRIVER_COUNTERS:
            with suppress(OSError):  # no driver has all counters, and a sandbox has no /sys
                self._files[name] = os.open(os.path.join(self._path, name), os.O_RDONLY | os.O_CLOEXEC)

    def _read(self) -> dict[str, int]:
        try:
            counts = {name: int(os.pread(descriptor, 32, 0)) for name, descriptor in self._files.items()}
        except (OSError, ValueError):  # the interface went away; its next life has files of its own
            self.close()
            self._open()
            counts = {}
        counts[SOCKET_COUNTER] = _MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size))[
            _DROPS
        ]
        return counts


def describe(rises: dict[str, int]) -> str:
    """Write rises as text."""
    return ", ".join(f"{name} +{rise}" for name, rise in rises.items())
