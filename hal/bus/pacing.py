"""Pace of a sender: no burst is faster than the wire, whatever the controllers between take."""

from __future__ import annotations

from typing import Final

FRAMES_AHEAD: Final = 4
"""Frames that may wait in the controllers: an SJA1000 receives into 64 bytes, five 8-byte frames of 11 bytes each."""
_OVERHEAD_BITS: Final = 47
"""Of an 11-bit data frame without stuff bits, interframe space included: no real wire is faster."""


def wire_time_s(length: int, bitrate: int) -> float:
    """Shortest time [s] that a frame with `length` data bytes takes on a wire of `bitrate` [bit/s]."""
    return (_OVERHEAD_BITS + 8 * length) / bitrate


class WirePacer:
    """A token bucket over the frames' wire time: `FRAMES_AHEAD` at once, the rest as fast as the wire."""

    def __init__(self, bitrate: int) -> None:
        self._times = tuple(wire_time_s(length, bitrate) for length in range(9))
        self._ahead_s = FRAMES_AHEAD * self._times[8]
        self._free_s = 0.0
        """When a wire would have carried all frames so far."""

    def wait_s(self, length: int, now_s: float) -> float:
        """Book a frame at `now_s` [s]; the time [s] to wait before it is sent."""
        self._free_s = max(self._free_s, now_s) + self._times[length]
        return max(0.0, self._free_s - now_s - self._ahead_s)
