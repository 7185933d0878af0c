"""What was a while ago: a delay line of vectors, for comparing a late estimate with what was desired at its time."""

from __future__ import annotations

import math

import numpy as np

from controller_service.model import Array


class DelayLine:
    """Rows of the last cycles, read back a fixed time later, between two rows by their straight line.

    Args:
        channels: numbers a row.
        delay_s: how late a row comes out.
        period_s: of a cycle.

    """

    def __init__(self, channels: int, delay_s: float, period_s: float) -> None:
        cycles = delay_s / period_s
        whole = math.floor(cycles + 1e-9)
        self._share = max(0.0, cycles - whole)
        self._whole = whole
        self._rows = np.zeros((whole + 2, channels))
        self._next = 0
        self._empty = True

    def push(self, row: Array, cycles: int = 1) -> Array:
        """Take this cycle's row (channels,), `cycles` after the last one, and give the one of `delay_s` ago.

        Cycles that were missed are filled along a straight line; before the first row all were like it.
        """
        rows, size = self._rows, len(self._rows)
        if self._empty:
            rows[:] = row
            self._empty = False
        elif cycles > 1:
            last = rows[self._next - 1].copy()
            for missed in range(max(1, cycles - size), cycles):
                self._put(last + (missed / cycles) * (row - last))
        self._put(row)
        newer = rows[(self._next - 1 - self._whole) % size]
        if self._share == 0.0:
            whole: Array = newer.copy()
            return whole
        older = rows[(self._next - 2 - self._whole) % size]
        between: Array = newer + self._share * (older - newer)
        return between

    def _put(self, row: Array) -> None:
        self._rows[self._next] = row
        self._next = (self._next + 1) % len(self._rows)
