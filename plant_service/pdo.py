"""PDOs of a device: the standard's rules for changing them, and packing from and into the object dictionary.

CiA 301 section 7.5.2.35-38. A PDO is changed in this order: bit 31 of its COB-ID is set, the count of its mapping is
set to 0, the entries are written, the count is set, bit 31 is cleared; anything else is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any, Final

from hal.profile.identifiers import COB_ID_INVALID
from hal.profile.objects import RPDO_COMMUNICATION, RPDO_MAPPING, SYNC_COUNTER, TPDO_COMMUNICATION, TPDO_MAPPING
from plant_service.nmt import NEVER_NS
from plant_service.object_dictionary import AbortCode, DeviceDictionary, Entry, key_of

CAN_ID_BITS: Final = 0x7FF
EXTENDED_IDENTIFIER: Final = 1 << 29
MAXIMUM_BITS: Final = 64
FRAME_DATA: Final = 8
MAXIMUM_ENTRIES: Final = 8
LAST_CYCLIC_TYPE: Final = 240
EVENT_TYPES: Final = (254, 255)
K_SYNC_COUNTER: Final = key_of(SYNC_COUNTER)
RESTRICTED: Final = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)
"""Identifiers that no PDO, SYNC or EMCY may take (CiA 301 table 40), first and last."""


def check_can_id(value: int, entry: Entry) -> None:
    """Refuse a COB-ID with a 29-bit identifier, or with a restricted one that is to be valid (bit 31 clear).

    Raises:
        SdoAbort: VALUE_INVALID.

    """
    can_id = value & CAN_ID_BITS
    used = not value & COB_ID_INVALID
    restricted = used and any(first <= can_id <= last for first, last in RESTRICTED)
    if value & EXTENDED_IDENTIFIER or value & 0x1FFF_F800 or restricted:
        raise entry.abort(AbortCode.VALUE_INVALID)


class Pdo:
    """One PDO: its records in the dictionary and what they mean now.

    `keys` and `codec` describe the mapped objects in order; both are rebuilt when the mapping changes.
    """

    def __init__(
        self, dictionary: DeviceDictionary, communication: int, mapping: int, changed: Callable[[], None], *, sent: bool
    ) -> None:
        self._dictionary = dictionary
        self._communication = communication
        self._mapping = mapping
        self._changed = changed
        self._sent = sent
        self.can_id = 0
        self.valid = False
        self.type = 0
        self.keys: tuple[int, ...] = ()
        self.codec = struct.Struct("<")
        self.synchronous = True
        """Sent after, or acting at, a SYNC."""
        self.event_driven = False
        """Sent when it changes or when its event timer runs out; an RPDO acts at once."""
        self.inhibit_ns = 0
        """Shortest time between two event-driven transmissions."""
        self.event_timer_ns = 0
        """Longest time between two, 0 is none; for an RPDO the deadline of its reception."""
        hooks = dictionary.on_write
        hooks[key_of(communication, 1)] = self._check_cob_id
        hooks[key_of(communication, 2)] = self._check_type
        hooks[key_of(communication, 3)] = self._check_inhibit
        if key_of(communication, 6) in dictionary.entries:
            hooks[key_of(communication, 6)] = self._check_sync_start
        hooks[key_of(mapping, 0)] = self._check_count
        for subindex in range(1, MAXIMUM_ENTRIES + 1):
            hooks[key_of(mapping, subindex)] = partial(self._check_entry, subindex)
        for subindex in (1, 2, 3, 5, 6):
            dictionary.written[key_of(communication, subindex)] = self._rebuild
        dictionary.written[key_of(mapping, 0)] = self._rebuild
        self._rebuild(0)

    def _rebuild(self, _: int) -> None:
        values = self._dictionary.values
        cob_id = values[key_of(self._communication, 1)]
        self.can_id = cob_id & CAN_ID_BITS
        self.type = values[key_of(self._communication, 2)]
        self.synchronous = self.type <= LAST_CYCLIC_TYPE
        self.event_driven = self.type in EVENT_TYPES
        self.inhibit_ns = values[key_of(self._communication, 3)] * 100_000
        self.event_timer_ns = values[key_of(self._communication, 5)] * 1_000_000
        count = values[key_of(self._mapping, 0)]
        self.keys = tuple(values[key_of(self._mapping, sub)] >> 8 for sub in range(1, count + 1))
        codecs = [self._dictionary.entries[key].codec for key in self.keys]
        self.codec = struct.Struct("<" + "".join(codec.format.lstrip("<") for codec in codecs if codec))
        self.valid = not cob_id & COB_ID_INVALID and bool(self.keys)
        self._changed()

    def rebuild(self) -> None:
        """Read the records again, after a reset changed them."""
        self._rebuild(0)

    @property
    def size(self) -> int:
        """Data bytes."""
        return self.codec.size

    def _entry(self, index: int, subindex: int) -> Entry:
        return self._dictionary.entries[key_of(index, subindex)]

    def _exists(self) -> bool:
        return not self._dictionary.values[key_of(self._communication, 1)] & COB_ID_INVALID

    def _check_cob_id(self, value: int) -> None:
        entry = self._entry(self._communication, 1)
        check_can_id(value, entry)
        now = self._dictionary.values[entry.index << 8 | 1]
        if self._exists() and not value & COB_ID_INVALID and (value ^ now) & 0x3FFF_FFFF:
            raise entry.abort(AbortCode.VALUE_INVALID)

    def _check_type(self, value: int) -> None:
        if not (value <= LAST_CYCLIC_TYPE or value in EVENT_TYPES):
            raise self._entry(self._communication, 2).abort(AbortCode.VALUE_INVALID)

    def _check_inhibit(self, _: int) -> None:
        if self._exists():
            raise self._entry(self._communication, 3).abort(AbortCode.DEVICE_STATE)

    def _check_sync_start(self, _: int) -> None:
        if self._exists():
            raise self._entry(self._communication, 6).abort(AbortCode.DEVICE_STATE)

    def _check_entry(self, subindex: int, value: int) -> None:
        own = self._entry(self._mapping, subindex)
        if self._exists() or self._dictionary.values[key_of(self._mapping, 0)]:
            raise own.abort(AbortCode.DEVICE_STATE)
        if value == 0:
            return
        mapped = self._dictionary.entries.get(value >> 8)
        if mapped is None:
            raise own.abort(AbortCode.NO_OBJECT)
        direction = mapped.access != "rww" if self._sent else mapped.writable and mapped.access != "rwr"
        if not mapped.mappable or not direction or value & 0xFF != mapped.bits:
            raise own.abort(AbortCode.NOT_MAPPABLE)

    def _check_count(self, value: int) -> None:
        own = self._entry(self._mapping, 0)
        if self._exists():
            raise own.abort(AbortCode.DEVICE_STATE)
        if value > MAXIMUM_ENTRIES:
            raise own.abort(AbortCode.MAPPING_TOO_LONG)
        entries = [self._dictionary.values[key_of(self._mapping, sub)] for sub in range(1, value + 1)]
        if any(entry == 0 for entry in entries):
            raise own.abort(AbortCode.NO_OBJECT)
        if sum(entry & 0xFF for entry in entries) > MAXIMUM_BITS:
            raise own.abort(AbortCode.MAPPING_TOO_LONG)


class Rpdo(Pdo):
    """A PDO that the device receives."""

    def __init__(self, dictionary: DeviceDictionary, number: int, changed: Callable[[], None]) -> None:
        self.received_ns: int | None = None
        """When it came last; None: its deadline is not watched before it comes again."""
        super().__init__(dictionary, RPDO_COMMUNICATION + number, RPDO_MAPPING + number, changed, sent=False)

    @property
    def deadline_ns(self) -> int:
        """Time by which it must have come again, by its event timer."""
        if self.received_ns is None or not self.event_timer_ns:
            return NEVER_NS
        return self.received_ns + self.event_timer_ns


def _nothing(_: dict[int, Any]) -> tuple[Any, ...]:
    return ()


class Tpdo(Pdo):
    """A PDO that the device sends."""

    def __init__(self, dictionary: DeviceDictionary, number: int, changed: Callable[[], None]) -> None:
        self.last: bytes | None = None
        """Frame sent last; None: never since the PDO became valid."""
        self._selected: tuple[Any, ...] = ()
        """Values in `last`."""
        self._sent_ns = 0
        self._syncs = 0
        self._start = 0
        self.waiting = False
        """For the SYNC whose counter is the SYNC start value."""
        self._values = dictionary.values
        self._select: Callable[[dict[int, Any]], tuple[Any, ...]] = _nothing
        self._frame = struct.Struct("<IB3x8x")
        super().__init__(dictionary, TPDO_COMMUNICATION + number, TPDO_MAPPING + number, changed, sent=True)

    def _rebuild(self, _: int) -> None:
        self._start = self._values[key_of(self._communication, 6)]
        self.restart()
        super()._rebuild(_)
        size = self.codec.size
        if size > FRAME_DATA:
            self.valid = False
            return
        self._frame = struct.Struct(f"<IB3x{self.codec.format[1:]}{FRAME_DATA - size}x")
        self._select = itemgetter(*self.keys) if len(self.keys) > 1 else self._select_few

    def _select_few(self, values: dict[int, Any]) -> tuple[Any, ...]:
        return tuple(values[key] for key in self.keys)

    def restart(self) -> None:
        """Begin anew: an event-driven PDO has never been sent, a cyclic one counts from the next SYNC."""
        self.last = None
        self._syncs = 0
        self.waiting = bool(self._start and self._values[K_SYNC_COUNTER])

    def count(self, counter: int) -> bool:
        """Hear the counter of a SYNC. Returns whether this SYNC is the first one for a PDO that was waiting."""
        begins = self.waiting and counter == self._start
        if begins:
            self.waiting = False
        return begins

    def pack(self) -> bytes:
        """Frame of 16 bytes with the mapped objects as they are now."""
        return self._frame.pack(self.can_id, self.codec.size, *self._select(self._values))

    def at_sync(self, now_ns: int) -> bytes | None:
        """Frame that this SYNC asks for, if it asks for one; counts the SYNC."""
        if self.type == 1:
            return self.pack()
        if self.event_driven:
            return self.by_event(now_ns)
        if self.synchronous and self.type:
            self._syncs += 1
            if self._syncs < self.type:
                return None
            self._syncs = 0
            return self.pack()
        return self._changed_frame() if self.type == 0 else None

    def by_event(self, now_ns: int) -> bytes | None:
        """Frame of an event-driven PDO that has changed, its inhibit time over, or whose event timer ran out."""
        if not self.event_driven:
            return None
        age, timer = now_ns - self._sent_ns, self.event_timer_ns
        if self.last is not None and timer > 0 and age >= timer:
            self.last = None
        elif self.last is not None and age < self.inhibit_ns:
            return None
        frame = self._changed_frame()
        if frame is not None:
            self._sent_ns = now_ns
        return frame

    def _changed_frame(self) -> bytes | None:
        """Frame to send unless it is the one sent last."""
        selected = self._select(self._values)
        if self.last is not None and selected == self._selected:
            return None
        self.last = self._frame.pack(self.can_id, self.codec.size, *selected)
        self._selected = selected
        return self.last
