"""The master's pairing of SYNCs and reports, and the pace of its heartbeat."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
import pytest

from hal.bus.errors import BusOverflowError
from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile.frames import can_ids, pack, unpack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from hal.profile.objects import SUPPORTED_DRIVE_MODES
from hal.profile.units import DriveUnits
from plant_service.device import DriveDevice
from plant_service.object_dictionary import key_of
from schemas.messages import HalStatus
from schemas.robot import Safety
from tests.hal.foreign_objects import Habits
from tests.hal.foreign_robot import foreign_robot, wire
from tests.hal.robots import mode_report, report, robot
from tests.plant_service.conftest import RigidAxis


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


def heartbeats(port: DirectPort, pause_s: float, **identity: Any) -> int:
    """Heartbeats of the HAL in ten cycles of lockstep after the boot, each of which takes a wall-clock time."""
    master = Master(foreign_robot((1,), safety=Safety(heartbeat_s=0.02), **identity), [port])
    master.boot(2.0)
    master.frames(-1)
    for sequence in range(10):
        time.sleep(pause_s)
        master.sync(sequence)
    return master.frames(9)[0].sent.count(pack(HEARTBEAT + HAL_NODE_ID, b"\x05"))


OURS = {"vendor_id": 0x402, "product_code": 1}


@pytest.mark.parametrize("identity", [{}, OURS], ids=["its own ids", "the simulated drives' ids"])
def test_other_makers_drives_get_heartbeats_by_the_wall_clock(identity: dict[str, Any]) -> None:
    assert heartbeats(wire(Habits(**identity)), 0.012, **identity) == 10
    assert heartbeats(wire(Habits(**identity)), 0.0, **identity) <= 5


def test_simulated_drives_get_heartbeats_by_simulated_time() -> None:
    drive = DriveDevice(1, RigidAxis(), {key_of(SUPPORTED_DRIVE_MODES): 0x280})

    def deliver(frames: bytes) -> bytes:
        return b"".join(answer for can_id, data in unpack(frames) for answer in drive.receive(can_id, data, 0))

    assert heartbeats(DirectPort("right", deliver), 0.012, **OURS) == 3, "every 20 ms of 10 cycles at 200 Hz"


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


class CutShort(DirectPort):
    """A bus whose interface goes down with half of the first SYNC's reports: they are read, and it is down."""

    def __init__(self) -> None:
        super().__init__("a", lambda frames: report(1))

    @property
    def down(self) -> str | None:  # type: ignore[override]  # a state here
        return f"bus {self.name}: interface can7 is down"


def test_nothing_more_is_awaited_of_a_bus_whose_last_frames_come_with_its_end() -> None:
    reports = report(2) + mode_report(2, 8)
    master = Master(robot("torque", "torque", "torque"), [CutShort(), DirectPort("b", lambda frames: reports)])
    master.core.start(np.zeros(3))
    begun = time.monotonic()
    master.sync(0)
    master.gather(0, 10.0)
    assert time.monotonic() - begun < 5.0
    master.apply(None)
    assert master.core.status is HalStatus.SAFE_STOP
    assert master.core.troubled_buses == ("a",)


def test_commands_that_a_full_bus_did_not_take_stop_the_robot_though_its_syncs_pass() -> None:
    reports = report(1) + report(3)
    near = Unreliable("a", lambda frames: reports if SYNC in can_ids(frames) else b"")
    far = DirectPort("b", lambda frames: report(2) if SYNC in can_ids(frames) else b"")
    master = Master(robot("torque", "torque", "torque"), [near, far])
    master.core.start(np.zeros(3))
    near.room = 1000
    for sequence in range(4):
        master.sync(sequence)
        master.gather(sequence, 0.001)
        master.apply(None)
        near.room = 16
    kinds = [event.kind for event in master.core.drain_events()]
    assert kinds[:2] == ["bus_down", "safe_stop"]
    assert kinds.count("bus_down") < 4
