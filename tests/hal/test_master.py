"""The master's pairing of SYNCs and reports, and the pace of its heartbeat."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
import pytest

from hal.bus.errors import BusOverflowError
from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile.frames import can_ids, pack, unpack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from hal.profile.units import DriveUnits
from schemas.messages import HalStatus
from schemas.robot import RobotDescription, Safety
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


def heartbeats(description: RobotDescription, cycles: int, pause_s: float) -> int:
    """Heartbeats of the HAL in some cycles of lockstep, each of which takes a wall-clock time."""
    sent: list[bytes] = []

    def deliver(frames: bytes) -> bytes:
        sent.append(frames)
        return b""

    master = Master(description, [DirectPort("a", deliver), DirectPort("b", lambda frames: b"")])
    for sequence in range(cycles):
        time.sleep(pause_s)
        master.sync(sequence)
    return b"".join(sent).count(pack(HEARTBEAT + HAL_NODE_ID, b"\x05"))


def test_other_makers_drives_get_heartbeats_by_the_wall_clock() -> None:
    safety = Safety(heartbeat_s=0.02)
    own = robot("torque", safety=safety)
    foreign = robot("torque", safety=safety, drive={"vendor_id": 0x1234})
    assert heartbeats(own, 10, 0.012) == 1
    assert heartbeats(foreign, 10, 0.012) == 10
    assert heartbeats(foreign, 10, 0.0) <= 5


class Unreliable(DirectPort):
    """A bus that takes no more than some bytes at a time, then says so."""

    room = 0

    def send(self, frames: bytes) -> None:
        if self.room < len(frames):
            raise BusOverflowError(f"bus {self.name}: can7 takes no more frames", self.room)
        super().send(frames)


def test_a_full_bus_is_in_trouble_and_only_what_it_took_is_logged() -> None:
    answers = [report(1), report(2)]
    near = Unreliable("a", lambda frames: answers[0] if SYNC in can_ids(frames) else b"")
    master = Master(
        robot("torque", "torque"),
        [near, DirectPort("b", lambda frames: answers[1] if SYNC in can_ids(frames) else b"")],
    )
    master.core.start(np.zeros(2))
    near.room = 16
    master.sync(0)
    near.room = 0
    master.gather(0, 0.001)
    master.apply(None)
    sent = [list(unpack(frames.sent)) for frames in master.frames(0)]
    assert [can_id for can_id, _ in sent[0]] == [HEARTBEAT + HAL_NODE_ID]
    assert [can_id for can_id, _ in sent[1]][:2] == [HEARTBEAT + HAL_NODE_ID, SYNC]
    assert master.core.status is HalStatus.SAFE_STOP
    assert master.core.troubled_buses == ("a",)
    near.room = 1000
    for sequence in range(1, 5):
        master.sync(sequence)
        master.gather(sequence, 0.001)
        master.apply(None)
    kinds = [event.kind for event in master.core.drain_events()]
    assert kinds == ["bus_down", "safe_stop"]
    assert master.core.expected_reports[0], "its frames are awaited again"
