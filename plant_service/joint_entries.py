"""The joints' entries of MuJoCo's arrays, where they lie side by side and where they do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class JointEntries:
    """The entries of n joints in a longer array that lives as long as this object's owner.

    Args:
        array: one of MuJoCo's, one row an address.
        addresses: of the joints, shape (n,).

    """

    def __init__(self, array: Array, addresses: NDArray[np.intp]) -> None:
        self._array = array
        self._addresses = addresses
        first, count = int(addresses[0]), len(addresses)
        self._adjacent = bool((addresses == np.arange(first, first + count)).all())
        self._entries = array[first : first + count] if self._adjacent else np.empty(count)

    def read(self) -> Array:
        """Entries as they are now, shape (n,); a view or a buffer, valid until MuJoCo steps or the next call."""
        if not self._adjacent:
            np.take(self._array, self._addresses, out=self._entries)
        return self._entries

    def write(self, values: Array) -> None:
        """Set the entries, shape (n,)."""
        if self._adjacent:
            self._entries[:] = values
        else:
            self._array[self._addresses] = values
