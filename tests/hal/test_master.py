"""The master's pairing of SYNCs and reports, and the pace of its heartbeat."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile.frames import unpack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from hal.profile.units import DriveUnits
from schemas.messages import HalStatus
from tests.hal.robots import report, robot


class SlowDrive(DirectPort):
    """A drive that stands at n counts at the n-th SYNC; its reports arrive one at a time, or late."""

    def __init__(self) -> None:
        super().__init__("a", lambda frames: b"")
        self.syncs = 0
        self.late = False
        self.wire: list[bytes] = []
        self.arrived: deque[bytes] = deque()

    def send(self, frames: bytes) -> None:
        self.syncs += 1
        (self.wire if self.late else self.arrived).append(report(1, counts=self.syncs))

    def receive(self, timeout_s: float) -> bytes:
        return self.arrived.popleft() if self.arrived else b""


def test_a_report_after_the_timeout_answers_no_later_sync() -> None:
    description = robot("torque")
    drive = SlowDrive()
    master = Master(description, [drive, DirectPort("b", lambda frames: b"")])
    master.core.start(np.zeros(1))
    units = DriveUnits.of(description)
    for sequence in range(12):
        drive.late = sequence == 5
        drive.arrived.extend(drive.wire)
        drive.wire.clear()
        master.sync(sequence)
        state = master.gather(sequence, 0.001)
        if not drive.late:
            expected = units.position_from_counts(np.array([sequence + 1]))
            assert state.position_measured == pytest.approx(expected.tolist(), abs=1e-12), sequence
    assert master.core.status is HalStatus.ACTIVE


@pytest.mark.parametrize("step", [1, 2, 3])
def test_heartbeats_keep_their_pace_when_syncs_are_left_out(step: int) -> None:
    description = robot("torque")
    sent: list[bytes] = []

    def deliver(frames: bytes) -> bytes:
        sent.append(frames)
        return b""

    master = Master(description, [DirectPort("a", deliver), DirectPort("b", lambda frames: b"")])
    sequences = range(1, 1001, step)
    for sequence in sequences:
        master.sync(sequence)
    heard = [[can_id for can_id, _ in unpack(frames)] for frames in sent]
    assert all(identifiers[-1] == SYNC for identifiers in heard)
    beats = [k for k, ids in zip(sequences, heard, strict=True) if HEARTBEAT + HAL_NODE_ID in ids]
    cycles = round(description.safety.heartbeat_s * description.rate_hz)
    assert beats[0] == 1
    gaps = np.diff(beats)
    assert (gaps >= cycles).all()
    assert (gaps < cycles + step).all()
