"""One CAN bus as a wire in simulated time: arbitration, frame lengths and mailboxes.

A frame waits in its sender's mailbox from the time it is ready. Whenever the bus is idle, the lowest identifier of
those ready goes (non-preemptive) and takes its bits, stuffed by its real content (`hal.profile.bits`). A sender has one
mailbox an identifier: a newer frame replaces an older one that still waits, so that an overloaded bus starves instead
of queueing without end. NMT, EMCY and SDO messages do not supersede one another: they queue, up to `QUEUE`.
"""

from __future__ import annotations

from enum import IntEnum
from heapq import heappop, heappush
from typing import Final

from hal.profile.bits import frame_bits
from hal.profile.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_RTR_FLAG, CAN_SFF_MASK
from hal.profile.identifiers import EMCY, HEARTBEAT, NMT, SDO_RX, SDO_TX, SYNC
from plant_service.wire_statistics import Account, WireStatistics

QUEUE: Final = 64
"""Messages of one kind that a sender keeps waiting before the oldest gives way."""
NODES: Final = 0x80
SECOND_NS: Final = 1_000_000_000
SHORTEST_BITS: Final = 47
"""Of a frame without data and stuff bits."""


class Origin(IntEnum):
    """Who sends a frame, and why."""

    OUTSIDE = 0
    """Somebody else than the nodes of the simulated robot."""
    ANSWER = 1
    """A node, to a SYNC."""
    NODE = 2
    """A node, for any other reason."""


OUTSIDE: Final = Origin.OUTSIDE
ANSWER: Final = Origin.ANSWER


Transmitted = tuple[bytes, int, Origin, int]
"""A frame that was on the bus: (frame, identifier with the flags of `struct can_frame`, origin, end_ns)."""


class _Mailbox:
    """Of one sender and identifier; queued messages have several, in turn."""

    __slots__ = ("account", "arbitration", "holds", "identifier", "is_data")

    def __init__(self, identifier: int, account: Account) -> None:
        self.identifier = identifier
        self.account = account
        self.arbitration = _arbitration(identifier)
        self.is_data = carries_process_data(identifier)
        """Process data, which a SYNC can overtake."""
        self.holds: _Waiting | None = None
        """The frame that contends; None: empty."""


_Waiting = tuple[int, int, _Mailbox, bytes, Origin, int, int]
"""A frame that is not on the bus yet: (ready_ns, order, mailbox, frame, origin, SYNCs on the bus and time at which the
cycle began when it was put); compares by the time it is ready, then in the order of putting."""


class Wire:
    """A bus of one bit rate [bit/s] and one period of SYNC. Times [ns] are passed in; frames are 16 bytes each."""

    def __init__(self, bitrate: int, period_ns: int) -> None:
        self.idle_ns = 0
        """End of the transmission that began last, interframe space included."""
        self.statistics = WireStatistics(period_ns)
        self._bit_ns = SECOND_NS / bitrate
        self._order = 0
        self._mailboxes: dict[int, _Mailbox] = {}
        self._future: list[_Waiting] = []
        """Frames that have been put, as a heap."""
        self._contending: list[tuple[int, int, _Mailbox]] = []
        """(arbitration, order, mailbox) of the frames that are ready, as a heap."""
        self._syncs = 0
        """SYNCs that have been on the bus."""
        self._cycle_ns = 0

    @property
    def busy_ns(self) -> int | None:
        """Time before which the last of the waiting frames cannot start; None when none waits."""
        waiting = len(self._contending) + len(self._future)
        return None if not waiting else self.idle_ns + round((waiting - 1) * SHORTEST_BITS * self._bit_ns)

    def begin(self, now_ns: int) -> None:
        """Begin a cycle: the time at which its SYNC is ready, from which completions count."""
        self._cycle_ns = now_ns
        self.statistics.begin(now_ns, self.idle_ns)

    def end(self, now_ns: int) -> None:
        """End the last cycle: no SYNC is to come."""
        self.statistics.end(now_ns, self.idle_ns)

    def put(self, frame: bytes, ready_ns: int, origin: Origin) -> None:
        """Give a frame to its sender's mailbox, to contend from `ready_ns` on."""
        self._order = order = self._order + 1
        identifier = int.from_bytes(frame[:4], "little")
        key = identifier << 1 | (origin is OUTSIDE)
        mailbox = self._mailboxes.get(key)
        if mailbox is None:
            mailbox = self._mailbox(identifier, key, order)
        heappush(self._future, (ready_ns, order, mailbox, frame, origin, self._syncs, self._cycle_ns))

    def transmit(self, last_start_ns: int) -> Transmitted | None:
        """Transmit the next frame if it can start by `last_start_ns`; None when none can."""
        future, contending = self._future, self._contending
        start_ns = self.idle_ns
        if not contending:
            if not future:
                return None
            if future[0][0] > start_ns:
                start_ns = future[0][0]
        if start_ns > last_start_ns:
            return None
        while future and future[0][0] <= start_ns:
            waiting = heappop(future)
            mailbox = waiting[2]
            if mailbox.holds is None:
                heappush(contending, (mailbox.arbitration, waiting[1], mailbox))
            else:
                mailbox.account.replaced += 1
            mailbox.holds = waiting
        mailbox = heappop(contending)[2]
        sent, mailbox.holds = mailbox.holds, None
        assert sent is not None  # a mailbox contends while it holds a frame
        ready_ns, _, _, frame, origin, syncs, cycle_ns = sent
        end_ns = self.idle_ns = start_ns + round(frame_bits(frame) * self._bit_ns)
        statistics, account = self.statistics, mailbox.account
        account.add(start_ns - ready_ns)
        statistics.busy_ns += end_ns - start_ns
        if mailbox.is_data:
            if syncs != self._syncs:
                account.late += 1
            statistics.completed(end_ns - cycle_ns, origin is OUTSIDE, origin is ANSWER)
        elif mailbox.identifier == SYNC:
            self._syncs += 1
        return frame, mailbox.identifier, origin, end_ns

    def resume(self, now_ns: int) -> None:
        """Carry frames again, no earlier than now: what was put meanwhile contends, the newest of each mailbox."""
        self.idle_ns = max(self.idle_ns, now_ns)

    def clear(self) -> None:
        """Forget what waits: the bus is down."""
        self._future.clear()
        self._contending.clear()
        self._mailboxes.clear()

    def _mailbox(self, identifier: int, key: int, order: int) -> _Mailbox:
        """Give a new mailbox, or the one whose turn it is of a queue."""
        if _queues(identifier):
            key |= (order % QUEUE + 1) << 33
            if key in self._mailboxes:
                return self._mailboxes[key]
        mailbox = self._mailboxes[key] = _Mailbox(identifier, self.statistics.account(identifier))
        return mailbox


def carries_process_data(identifier: int) -> bool:
    """Whether an identifier is of process data: neither a SYNC nor a heartbeat nor a message that queues."""
    is_heartbeat = HEARTBEAT <= identifier < HEARTBEAT + NODES
    return identifier != SYNC and not is_heartbeat and not _queues(identifier)


def _queues(identifier: int) -> bool:
    """Whether frames of an identifier are messages of their own, of which none replaces another."""
    return SDO_TX <= identifier < SDO_RX + NODES or EMCY < identifier < EMCY + NODES or identifier == NMT


def _arbitration(identifier: int) -> int:
    """Build the bits by which frames contend, the lowest wins: 11 bits, RTR or SRR, IDE, 18 bits, RTR."""
    remote = 1 if identifier & CAN_RTR_FLAG else 0
    if identifier & CAN_EFF_FLAG:
        number = identifier & CAN_EFF_MASK
        return number >> 18 << 21 | 0b11 << 19 | (number & 0x3FFFF) << 1 | remote
    return (identifier & CAN_SFF_MASK) << 21 | remote << 20
