"""The simulated nodes of one bus, and the wire that carries their frames."""

from __future__ import annotations

from typing import Final, Protocol

from hal.profile.frames import CAN_ERR_FLAG, split, unpack
from hal.profile.identifiers import SYNC
from plant_service.wire import Origin, Transmitted, Wire, carries_process_data

SYNC_HEAD: Final = SYNC.to_bytes(4, "little") + b"\0"


class Device(Protocol):
    """A node of a bus: pure, frames of 16 bytes out."""

    @property
    def revision(self) -> int:
        """Grows when `can_ids` changes."""
        ...

    @property
    def can_ids(self) -> frozenset[int]:
        """Identifiers that it listens to."""
        ...

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Hear one frame."""
        ...

    def sync(self, now_ns: int) -> list[bytes]:
        """Answer a SYNC without data."""
        ...

    def tick(self, now_ns: int) -> list[bytes]:
        """Act on the time."""
        ...


class BusNodes:
    """The nodes of one bus and the way of frames to them."""

    def __init__(self, devices: list[Device]) -> None:
        self.devices = devices
        self._routes: dict[int, list[Device]] = {}
        self._revision = -1

    def hear(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Give a frame to the nodes that listen; their answers."""
        listeners = self._routes.get(can_id)
        if listeners is None:
            listeners = self._routes[can_id] = [device for device in self.devices if can_id in device.can_ids]
        answers: list[bytes] = []
        for device in listeners:
            answers += device.receive(can_id, data, now_ns)
        if answers:  # every service that can change what a node listens to is answered
            revision = sum(device.revision for device in self.devices)
            if revision != self._revision:
                self._routes.clear()
                self._revision = revision
        return answers

    def sync(self, now_ns: int) -> list[bytes]:
        """Give a SYNC without data to all; their answers, node by node."""
        answers: list[bytes] = []
        for device in self.devices:
            answers += device.sync(now_ns)
        return answers

    def tick(self, now_ns: int) -> list[bytes]:
        """Let the time act on all; what they say by themselves."""
        said: list[bytes] = []
        for device in self.devices:
            said += device.tick(now_ns)
        return said


class UntimedBus:
    """Nodes whose frames take no time: before the first SYNC of a lockstep run, and on a wire that is real."""

    def __init__(self, nodes: BusNodes) -> None:
        self._nodes = nodes
        self._waiting: list[bytes] = []
        """What arose while nobody listened (heartbeats, EMCY of a watchdog): sent with the next answer to a SYNC."""

    def exchange(self, packet: bytes, now_ns: int) -> bytes:
        """Give frames to the nodes; all their answers, those to a SYNC in the order of arbitration."""
        answers: list[bytes] = []
        for can_id, data in unpack(packet):
            if can_id == SYNC and not data:
                self._waiting += self._nodes.sync(now_ns)
                answers.append(self.collect())
            else:
                answers += self._nodes.hear(can_id, data, now_ns)
        return b"".join(answers)

    def tick(self, now_ns: int) -> None:
        """Let the time act on the nodes; what they say waits."""
        self._waiting += self._nodes.tick(now_ns)

    def collect(self) -> bytes:
        """Take what waits, in the order of arbitration (a node's own frames keep their order)."""
        frames = sorted(self._waiting, key=_identifier)
        self._waiting.clear()
        return b"".join(frames)

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()


class TimedBus:
    """Nodes on a `Wire`: what they hear and say passes it, and takes its time."""

    def __init__(self, nodes: BusNodes, wire: Wire) -> None:
        self.wire = wire
        self.answered_ns = 0
        """When the answers to the last SYNC had all been on the bus; the limit of `sync` when they had not."""
        self._nodes = nodes
        self._awaited: set[int] = set()
        """Identifiers of the answers to SYNCs that have not been on the bus yet."""
        self._sync_waits = False

    def put(self, packet: bytes, ready_ns: int) -> None:
        """Give frames from outside to their mailboxes; a bus error is no frame of the wire.

        Raises:
            ProfileError: the packet is not a whole number of frames.

        """
        for frame in split(packet):
            if not frame[3] & CAN_ERR_FLAG >> 24:
                self.wire.put(frame, ready_ns, Origin.OUTSIDE)

    def sync(self, frame: bytes, ready_ns: int, last_start_ns: int, now_ns: int) -> bytes:
        """Put a SYNC and let the bus work until all answers to it are through; the nodes' frames until then."""
        self.begin(frame, ready_ns)
        sent: list[bytes] = []
        while self._awaited or self._sync_waits:
            transmitted = self.wire.transmit(last_start_ns)
            if transmitted is None:
                self.answered_ns = max(last_start_ns, ready_ns)
                return b"".join(sent)
            self._pass(transmitted, sent, now_ns)
        self.answered_ns = self.wire.idle_ns
        return b"".join(sent)

    def begin(self, frame: bytes, ready_ns: int) -> None:
        """Put a SYNC: a cycle begins."""
        self._sync_waits = True
        self.wire.begin(ready_ns)
        self.wire.put(frame, ready_ns, Origin.OUTSIDE)

    def run(self, last_start_ns: int, now_ns: int) -> bytes:
        """Let the bus transmit what can start by `last_start_ns`; the nodes' frames among it."""
        sent: list[bytes] = []
        while (transmitted := self.wire.transmit(last_start_ns)) is not None:
            self._pass(transmitted, sent, now_ns)
        return b"".join(sent)

    def tick(self, now_ns: int) -> None:
        """Let the time act on the nodes; what they say goes into their mailboxes."""
        for frame in self._nodes.tick(now_ns):
            self.wire.put(frame, now_ns, Origin.NODE)

    def clear(self) -> None:
        """Forget what waits: the bus is down."""
        self.wire.clear()
        self._awaited.clear()
        self._sync_waits = False

    def _pass(self, transmitted: Transmitted, sent: list[bytes], now_ns: int) -> None:
        """Let a frame that was on the bus reach those it is for."""
        frame, identifier, origin, end_ns = transmitted
        if origin is not Origin.OUTSIDE:
            sent.append(frame)
            self._awaited.discard(identifier)
            return
        if identifier == SYNC and is_sync(frame):
            self._sync_waits = False
            for answer in self._nodes.sync(now_ns):
                self._awaited.add(_identifier(answer))
                self.wire.put(answer, end_ns, Origin.ANSWER)
            return
        for answer in self._nodes.hear(identifier, frame[8 : 8 + frame[4]], now_ns):
            self.wire.put(answer, end_ns, Origin.NODE)


def is_sync(frame: bytes) -> bool:
    """Whether a frame is a SYNC: one with data is none."""
    return frame[:5] == SYNC_HEAD


def is_process_data(frame: bytes) -> bool:
    """Whether a frame is of no service that is answered: nobody misses it before the next SYNC."""
    return carries_process_data(int.from_bytes(frame[:4], "little"))


def _identifier(frame: bytes) -> int:
    """Read the identifier of a packed 11-bit frame."""
    return frame[1] << 8 | frame[0]
