"""NMT slave, heartbeat producer and heartbeat consumer, CiA 301 section 7.2.8. Times in ns are passed in."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Final

from hal.profile import frames, identifiers
from hal.profile.objects import CONSUMER_HEARTBEAT, PRODUCER_HEARTBEAT_MS
from plant_service.object_dictionary import DeviceDictionary, key_of

NEVER_NS: Final = 2**63
LEAVE_OPERATIONAL: Final = 0
STOP_NODE: Final = 2
"""Values of 0x1029:1, beside 1 for no change."""
K_PRODUCER: Final = key_of(PRODUCER_HEARTBEAT_MS)
K_CONSUMER: Final = key_of(CONSUMER_HEARTBEAT, 1)


class NmtState(IntEnum):
    """NMT states, by the byte that a heartbeat carries."""

    INITIALISING = identifiers.HEARTBEAT_BOOT_UP
    STOPPED = identifiers.HEARTBEAT_STOPPED
    OPERATIONAL = identifiers.HEARTBEAT_OPERATIONAL
    PRE_OPERATIONAL = identifiers.HEARTBEAT_PRE_OPERATIONAL


class NmtReset(Enum):
    """What the device itself has to reset after a command."""

    NODE = identifiers.NMT_RESET_NODE
    COMMUNICATION = identifiers.NMT_RESET_COMMUNICATION


STATE_OF_COMMAND: Final = {
    identifiers.NMT_START: NmtState.OPERATIONAL,
    identifiers.NMT_STOP: NmtState.STOPPED,
    identifiers.NMT_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


class NmtSlave:
    """NMT state of one node."""

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self.state = NmtState.INITIALISING

    def boot(self) -> bytes:
        """Enter PRE-OPERATIONAL; the boot-up message."""
        self.state = NmtState.PRE_OPERATIONAL
        return frames.pack(identifiers.HEARTBEAT + self.node_id, bytes([NmtState.INITIALISING]))

    def command(self, data: bytes) -> NmtReset | None:
        """Act on an NMT frame if it means this node (or 0, all); a reset is left to the device."""
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return None
        if data[0] in STATE_OF_COMMAND:
            self.state = STATE_OF_COMMAND[data[0]]
            return None
        return NmtReset(data[0]) if data[0] in (NmtReset.NODE.value, NmtReset.COMMUNICATION.value) else None

    def lose_heartbeat(self, behaviour: int) -> NmtState:
        """Take the state that object 0x1029:1 wants after a lost heartbeat; the state then."""
        if behaviour == STOP_NODE:
            self.state = NmtState.STOPPED
        elif behaviour == LEAVE_OPERATIONAL and self.state is NmtState.OPERATIONAL:
            self.state = NmtState.PRE_OPERATIONAL
        return self.state


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 ms."""

    def __init__(self, dictionary: DeviceDictionary, nmt: NmtSlave) -> None:
        self._values = dictionary.values
        self._nmt = nmt
        self._sent_ns: int | None = None

    @property
    def due_ns(self) -> int:
        """Time of the next heartbeat."""
        period_ns = self._values[K_PRODUCER] * 1_000_000
        if period_ns == 0:
            return NEVER_NS
        return 0 if self._sent_ns is None else int(self._sent_ns + period_ns)

    def tick(self, now_ns: int) -> bytes | None:
        """Give the heartbeat if it is due; the first one comes a period after the producer was configured."""
        period_ns = self._values[K_PRODUCER] * 1_000_000
        if period_ns == 0:
            self._sent_ns = None
            return None
        if self._sent_ns is None:
            self._sent_ns = now_ns
        if now_ns - self._sent_ns < period_ns:
            return None
        self._sent_ns += (now_ns - self._sent_ns) // period_ns * period_ns
        return frames.pack(identifiers.HEARTBEAT + self._nmt.node_id, bytes([self._nmt.state]))


class HeartbeatConsumer:
    """Watches the node of 0x1016:1 (node << 16 | ms) from its first heartbeat on; to be reset when that changes."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self._values = dictionary.values
        self._heard_ns: int | None = None
        self.lost = False

    def reset(self) -> None:
        """Wait for the first heartbeat again."""
        self._heard_ns = None
        self.lost = False

    @property
    def can_id(self) -> int:
        """Identifier of the watched heartbeat; 0 when none is watched."""
        entry = self._values[K_CONSUMER]
        node_id = entry >> 16 & 0xFF
        return identifiers.HEARTBEAT + node_id if 0 < node_id < 128 and entry & 0xFFFF else 0

    @property
    def due_ns(self) -> int:
        """Time at which the watched node is lost if it is not heard before."""
        time_ns = (self._values[K_CONSUMER] & 0xFFFF) * 1_000_000
        if self._heard_ns is None or self.lost or time_ns == 0:
            return NEVER_NS
        return int(self._heard_ns + time_ns)

    def hear(self, now_ns: int) -> bool:
        """Note a heartbeat of the watched node. Returns whether it had been lost."""
        self._heard_ns = now_ns
        was_lost, self.lost = self.lost, False
        return was_lost

    def tick(self, now_ns: int) -> bool:
        """Whether the watched node has just been lost."""
        if self._heard_ns is None or self.lost:
            return False
        time_ns = (self._values[K_CONSUMER] & 0xFFFF) * 1_000_000
        self.lost = time_ns > 0 and now_ns - self._heard_ns > time_ns
        return self.lost
