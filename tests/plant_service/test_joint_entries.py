"""Entries of the joints in a longer array, adjacent or not."""

from __future__ import annotations

import numpy as np
import pytest

from plant_service.joint_entries import JointEntries


@pytest.mark.parametrize("addresses", [[2, 3, 4], [0, 2, 5], [4, 3, 2]])
def test_entries_are_read_and_written_in_the_order_of_the_joints(addresses):
    array = np.arange(6.0)
    entries = JointEntries(array, np.array(addresses))
    assert entries.read().tolist() == addresses
    entries.write(np.array([10.0, 20.0, 30.0]))
    assert array[addresses].tolist() == [10.0, 20.0, 30.0]
    assert set(np.flatnonzero(array != np.arange(6.0))) == set(addresses)
    array += 1.0
    assert entries.read().tolist() == [11.0, 21.0, 31.0]
