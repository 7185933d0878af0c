"""Cycles of a capture: which frames of which bus belong to one sequence number."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from deploy.bus_frames import BOOT, NANO, BusFrame, identifier
from hal.profile import identifiers as cob
from hal.profile import objects
from schemas.base import Clock
from schemas.robot import RobotDescription


def by_time(frames: Iterable[BusFrame], window_ns: int = 10 * NANO) -> Iterator[BusFrame]:
    """Put frames of several buses in the order of their times, those of one bus staying in theirs.

    A tool that reads several interfaces takes one frame of each in turn, so a file may be ahead on one bus of another.

    Args:
        frames: as a file has them.
        window_ns: by how much it may be ahead.
    """
    waiting: list[tuple[int, int, BusFrame]] = []
    latest: dict[str, int] = {}
    for number, each in enumerate(frames):
        time_ns = latest[each.bus] = max(each.time_ns, latest.get(each.bus, each.time_ns))
        heapq.heappush(waiting, (time_ns, number, each))
        while waiting[0][0] < time_ns - window_ns:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


@dataclass(slots=True)
class Cycle:
    """Frames of one cycle, by bus."""

    sequence: int
    sent: dict[str, bytearray]
    received: dict[str, bytearray]


@dataclass(slots=True)
class _Line:
    """Where one bus stands."""

    cycle: int = BOOT
    heartbeats: list[bytes] = field(default_factory=list)
    """Of the HAL: they belong to the SYNC that follows."""


class CycleGrouper:
    """Sorts frames into cycles: those of a bus from one SYNC up to the next, with the HAL's heartbeats before it.

    A SYNC begins a new cycle when its bus has had one in this cycle, or when commands have been sent on a bus that has:
    a master commands when it has sent SYNC everywhere. So a capture may begin between the SYNCs of two buses. In
    realtime, where a full bus may delay its SYNC beyond another's commands, half a period must have passed as well.
    """

    def __init__(self, robot: RobotDescription, clock: Clock) -> None:
        """Prepare for a robot.

        Args:
            robot: the description.
            clock: `realtime` numbers cycles by their times, because SYNCs may have been left out; `lockstep` counts
                them, because wall-clock time says nothing there.
        """
        self._period_ns = robot.period_ns
        self._realtime = clock is Clock.REALTIME
        self._buses = tuple(bus.name for bus in robot.buses)
        self._rpdos = {
            (joint.drive.bus, pdo.cob_id(joint.drive.node_id))
            for joint in robot.joints
            for pdo in objects.RPDOS[joint.drive.kind]
        }
        self._lines = {bus: _Line() for bus in self._buses}
        self._pending: dict[int, Cycle] = {}
        self._sequence = BOOT
        self._begun_ns = 0
        self._synced: set[str] = set()
        self._commanded = False
        self.seen: set[str] = set()
        """Buses with any frame."""

    def add(self, frame: BusFrame) -> Iterator[Cycle]:
        """Take a frame; yields the cycles that are complete by it."""
        line, number = self._lines[frame.bus], identifier(frame.frame)
        self.seen.add(frame.bus)
        if not frame.sent:
            self._cycle(line.cycle).received[frame.bus] += frame.frame
        elif number == cob.HEARTBEAT + cob.HAL_NODE_ID:
            line.heartbeats.append(frame.frame)
        else:
            if number == cob.SYNC:
                self._sync(frame)
            elif (frame.bus, number) in self._rpdos and frame.bus in self._synced:
                self._commanded = True
            self._put(frame.bus, line, frame.frame)
            if number == cob.SYNC:
                yield from self._take(min(each.cycle for each in self._lines.values()))

    def finish(self) -> Iterator[Cycle]:
        """Yield what is left."""
        for bus, line in self._lines.items():
            if line.heartbeats:
                self._put(bus, line, b"")
        yield from self._take(self._sequence + 1)

    def _sync(self, frame: BusFrame) -> None:
        if self._sequence == BOOT:
            self._sequence, self._begun_ns = 0, frame.time_ns
        elif frame.bus in self._synced or (self._commanded and self._is_later(frame)):
            passed = round((frame.time_ns - self._begun_ns) / self._period_ns) if self._realtime else 1
            self._sequence += max(1, passed)
            self._begun_ns = frame.time_ns
            self._synced.clear()
            self._commanded = False
        self._synced.add(frame.bus)
        self._lines[frame.bus].cycle = self._sequence

    def _is_later(self, frame: BusFrame) -> bool:
        return not self._realtime or frame.time_ns - self._begun_ns > self._period_ns / 2

    def _put(self, bus: str, line: _Line, frame: bytes) -> None:
        self._cycle(line.cycle).sent[bus] += b"".join(line.heartbeats) + frame
        line.heartbeats.clear()

    def _cycle(self, sequence: int) -> Cycle:
        if sequence not in self._pending:
            empty = ({bus: bytearray() for bus in self._buses} for _ in range(2))
            self._pending[sequence] = Cycle(sequence, *empty)
        return self._pending[sequence]

    def _take(self, end: int) -> Iterator[Cycle]:
        for sequence in sorted(each for each in self._pending if each < end):
            yield self._pending.pop(sequence)
