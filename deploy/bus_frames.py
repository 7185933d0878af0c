"""Frames one by one, each with its time and bus: a log's cycles laid out in time, as CAN tools want them."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from hal.bus.can_frame import split
from hal.profile import identifiers as cob
from hal.profile.bits import frame_bits
from hal.profile.frames import CAN_ERR_FLAG
from schemas.messages import BusFrames
from schemas.robot import RobotDescription

NANO: Final = 1_000_000_000
BOOT: Final = -1


@dataclass(frozen=True, slots=True)
class BusFrame:
    """One frame (16 bytes, `struct can_frame`) at the start of its transmission."""

    time_ns: int
    bus: str
    frame: bytes
    sent: bool
    """By the HAL."""

    @property
    def can_id(self) -> int:
        """Identifier with its flags."""
        return int.from_bytes(self.frame[:4], "little")

    @property
    def data(self) -> bytes:
        """At most 8 bytes."""
        return self.frame[8 : 8 + self.frame[4]]


def hal_identifiers(robot: RobotDescription, bus: str) -> frozenset[int]:
    """List what a HAL sends on a bus: NMT, SYNC, its heartbeat, RPDOs, SDO requests, sensors' commands."""
    ids = {cob.NMT, cob.SYNC, cob.HEARTBEAT + cob.HAL_NODE_ID}
    for joint in robot.joints:
        if joint.drive.bus == bus:
            node = joint.drive.node_id
            ids |= {cob.RPDO1 + node, cob.RPDO2 + node, cob.SDO_RX + node}
    ids |= {sensor.command_id for sensor in robot.force_torque_sensors if sensor.bus == bus}
    return frozenset(ids)


def in_time(robot: RobotDescription, messages: Iterable[BusFrames], buses: int | None = None) -> Iterator[BusFrame]:
    """Lay the cycles of a log out in time, as they follow one another on the wire.

    The SYNC of sequence k is at k periods, the HAL's heartbeat just before it, the boot whole periods before time 0.
    Reports follow the SYNC, each frame as long as its bits; commands come `compute_budget_s` after the last report of
    all buses, or earlier, as soon as their own bus is free, where they would not end before the next SYNC. A cycle that
    needs more than a period even so delays the next SYNC. Frames of a bus keep their order and each begins after the
    one before has ended; frames that arrived before their cycle's SYNC (the log does not tell) stand after it.

    Args:
        robot: the description.
        messages: `BusFrames` of some or all buses, in the log's order.
        buses: how many buses they are of; default: all of the robot.
    """
    rates = {bus.name: bus.bitrate for bus in robot.buses}
    cursor = _Cursor(robot, rates)
    for sequence, cycle in cycles(messages, len(robot.buses) if buses is None else buses):
        yield from heapq.merge(*cursor.lay(sequence, cycle), key=lambda each: each.time_ns)


class _Cursor:
    """Where in time the next cycle may begin."""

    def __init__(self, robot: RobotDescription, rates: Mapping[str, int]) -> None:
        self._robot = robot
        self._rates = rates
        self._end_ns: int | None = None
        """End of the last frame on any bus."""
        heartbeat = bytes((0x7F, 7, 0, 0, 1, 0, 0, 0, cob.HEARTBEAT_OPERATIONAL, 0, 0, 0, 0, 0, 0, 0))
        self._heartbeat_ns = max(duration_ns(heartbeat, rate) for rate in rates.values())

    def lay(self, sequence: int, cycle: Mapping[str, BusFrames]) -> list[list[BusFrame]]:
        if sequence == BOOT:
            return self._boot(cycle)
        period = self._robot.period_ns
        start = sequence * period
        parts = {bus: _parts(frames) for bus, frames in cycle.items()}
        if self._end_ns is not None:
            first = (sum(duration_ns(frame, self._rates[bus]) for frame in part.before) for bus, part in parts.items())
            start = max(start, self._end_ns + max(first))
        lines: dict[str, list[BusFrame]] = {}
        ends = {}
        for bus, part in parts.items():
            before = start - sum(duration_ns(frame, self._rates[bus]) for frame in part.before)
            lines[bus], _ = self._line(bus, part.before, before, sent=True)
            sync, now = self._line(bus, part.sync, start, sent=True)
            reports, ends[bus] = self._line(bus, part.received, now, sent=False)
            lines[bus] += sync + reports
        reports_end = max(ends.values())
        wanted = reports_end + round(self._robot.compute_budget_s * NANO)
        for bus, part in parts.items():
            needed = sum(duration_ns(frame, self._rates[bus]) for frame in part.after)
            latest = start + period - self._heartbeat_ns - needed
            commands, ends[bus] = self._line(bus, part.after, max(ends[bus], min(wanted, latest)), sent=True)
            lines[bus] += commands
        self._end_ns = max(ends.values())
        return list(lines.values())

    def _boot(self, cycle: Mapping[str, BusFrames]) -> list[list[BusFrame]]:
        ordered = {bus: list(_boot_order(frames)) for bus, frames in cycle.items()}
        lengths = {
            bus: sum(duration_ns(frame, self._rates[bus]) for frame, _ in frames) for bus, frames in ordered.items()
        }
        begin = -whole_periods(max(lengths.values()) + self._heartbeat_ns, self._robot.period_ns)
        self._end_ns = begin + max(lengths.values())
        lines = []
        for bus, frames in ordered.items():
            now, line = begin, []
            for frame, sent in frames:
                line.append(BusFrame(now, bus, frame, sent))
                now += duration_ns(frame, self._rates[bus])
            lines.append(line)
        return lines

    def _line(self, bus: str, frames: Sequence[bytes], now_ns: int, *, sent: bool) -> tuple[list[BusFrame], int]:
        line = []
        for frame in frames:
            line.append(BusFrame(now_ns, bus, frame, sent))
            now_ns += duration_ns(frame, self._rates[bus])
        return line, now_ns


@dataclass(frozen=True, slots=True)
class _Parts:
    """Frames of one bus and cycle: sent before the SYNC, the SYNC, received, sent after it."""

    before: tuple[bytes, ...]
    sync: tuple[bytes, ...]
    received: tuple[bytes, ...]
    after: tuple[bytes, ...]


def _parts(frames: BusFrames) -> _Parts:
    sent = tuple(split(frames.sent))
    at = next((index for index, frame in enumerate(sent) if identifier(frame) == cob.SYNC), None)
    received = tuple(split(frames.received))
    if at is None:
        return _Parts((), (), received, sent)
    return _Parts(sent[:at], sent[at : at + 1], received, sent[at + 1 :])


def _boot_order(frames: BusFrames) -> Iterator[tuple[bytes, bool]]:
    """Put each SDO answer after its request, and what came before an answer before the request."""
    received = list(split(frames.received))
    for frame in split(frames.sent):
        number = identifier(frame)
        if cob.SDO_RX < number <= cob.SDO_RX + 0x7F:
            answer = next(
                (index for index, each in enumerate(received) if cob.SDO_TX < identifier(each) <= cob.SDO_TX + 0x7F),
                None,
            )
            if answer is not None:
                yield from ((each, False) for each in received[:answer])
                yield frame, True
                if identifier(received[answer]) - cob.SDO_TX == number - cob.SDO_RX:
                    yield received[answer], False
                    answer += 1
                del received[:answer]
                continue
        yield frame, True
    yield from ((each, False) for each in received)


def cycles(messages: Iterable[BusFrames], buses: int) -> Iterator[tuple[int, dict[str, BusFrames]]]:
    """Gather the messages of each sequence number, in order; a cycle that lacks a bus waits for the next whole one."""
    pending: dict[int, dict[str, BusFrames]] = {}
    for message in messages:
        cycle = pending.setdefault(message.sequence, {})
        cycle[message.bus] = message
        if len(cycle) == buses:
            for sequence in sorted(each for each in pending if each <= message.sequence):
                yield sequence, pending.pop(sequence)
    for sequence in sorted(pending):
        yield sequence, pending[sequence]


def whole_periods(time_ns: int, period_ns: int) -> int:
    """Round a time up to whole periods."""
    return -(-time_ns // period_ns) * period_ns


def from_zero(frames: Iterable[BusFrame], period_ns: int) -> Iterator[BusFrame]:
    """Shift times by whole periods so that none is negative, as files want them; the first frame is the earliest."""
    shift_ns = None
    for each in frames:
        if shift_ns is None:
            shift_ns = whole_periods(max(-each.time_ns, 0), period_ns)
        yield replace(each, time_ns=each.time_ns + shift_ns) if shift_ns else each


def identifier(frame: bytes) -> int:
    """Read the identifier of a frame, with its flags."""
    return int.from_bytes(frame[:4], "little")


def duration_ns(frame: bytes, bitrate: int) -> int:
    """Time that a frame takes on the wire, rounded up to ns."""
    if identifier(frame) & CAN_ERR_FLAG:
        return 0  # the controller's message to its host was never on the wire
    return -(-frame_bits(frame) * NANO // bitrate)
