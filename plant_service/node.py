"""The CANopen side of a simulated drive: object dictionary, NMT, SDO, EMCY, heartbeats, PDOs and SYNC (CiA 301)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from hal.profile import frames, identifiers, objects
from hal.profile.cia402 import EmergencyCode
from plant_service.emergency import Emergency
from plant_service.nmt import K_CONSUMER, HeartbeatConsumer, HeartbeatProducer, NmtSlave, NmtState
from plant_service.object_dictionary import AbortCode, DeviceDictionary, key_of
from plant_service.pdo import CAN_ID_BITS, K_SYNC_COUNTER, Rpdo, Tpdo, check_can_id
from plant_service.sdo_server import SdoServer
from plant_service.watchdog import K_SYNC_PERIOD

PDO_COUNT: Final = 2
"""Of each direction."""
K_SYNC_COB_ID: Final = key_of(objects.SYNC_COB_ID)
OPERATIONAL: Final = NmtState.OPERATIONAL


class CanopenNode:
    """What CiA 301 asks of one device, apart from what its objects do.

    `fixed` overrides defaults of the EDS for this device, by `key_of` (identity, supported modes, …).
    """

    def __init__(self, node_id: int, fixed: Mapping[int, int] | None = None, eds: Path | None = None) -> None:
        self.node_id = node_id
        self.revision = 0
        """Grows when the device listens to other identifiers than before."""
        self._fixed = dict(fixed or {})
        self.dictionary = DeviceDictionary(eds or Path(objects.eds_path()), node_id)
        self._values: dict[int, Any] = self.dictionary.values
        self._values.update(self._fixed)
        self.emergency = Emergency(self.dictionary)
        self.nmt = NmtSlave(node_id)
        self._producer = HeartbeatProducer(self.dictionary, self.nmt)
        self._consumer = HeartbeatConsumer(self.dictionary)
        self._sdo = SdoServer(self.dictionary)
        self._sync_id = identifiers.SYNC
        self._sync_length = 0
        """1 while 0x1019 asks for a counter in the SYNC."""
        self._misfit = False
        """An RPDO or SYNC of the wrong length came since the last SYNC."""
        self._rpdo_of: dict[int, Rpdo] = {}
        self._rpdos: tuple[Rpdo, ...] = ()
        self._tpdos: tuple[Tpdo, ...] = ()
        self._active_tpdos: tuple[Tpdo, ...] = ()
        """Valid, and not waiting for their SYNC start value."""
        self._rpdos = tuple(Rpdo(self.dictionary, number, self._route) for number in range(PDO_COUNT))
        self._tpdos = tuple(Tpdo(self.dictionary, number, self._route) for number in range(PDO_COUNT))
        self._route()
        self._outbox = [self.nmt.boot()]
        self.dictionary.on_write |= {K_SYNC_COB_ID: self._check_sync, K_SYNC_COUNTER: self._check_counter}
        self.dictionary.written |= {
            K_SYNC_COB_ID: lambda _: self._route(),
            K_SYNC_COUNTER: lambda _: self._start_tpdos(),
            K_CONSUMER: lambda _: self._watch_another(),
        }

    @property
    def can_ids(self) -> frozenset[int]:
        """Identifiers that this device listens to now."""
        others = {identifiers.NMT, self._sync_id, identifiers.SDO_RX + self.node_id}
        return frozenset(others | set(self._rpdo_of) | ({self._consumer.can_id} - {0}))

    def _answer(self, request: bytes) -> None:
        """Serve an SDO request."""
        answer = None if self.nmt.state is NmtState.STOPPED else self._sdo.request(request)
        if answer is not None:
            self._outbox.append(frames.pack(identifiers.SDO_TX + self.node_id, answer))

    def _count(self, data: bytes) -> bool:
        """Take the counter of a SYNC. Returns whether the SYNC has the length that 0x1019 asks for."""
        if self.nmt.state is NmtState.STOPPED:
            return False
        if len(data) != self._sync_length:
            self._misfit = True
            self.emergency.appear(EmergencyCode.SYNC_LENGTH)
            return False
        if self.nmt.state is OPERATIONAL and any([tpdo.count(data[0]) for tpdo in self._tpdos]):
            self._route()
        return True

    def _watch_another(self) -> None:
        self._consumer.reset()
        self._route()

    def _start_tpdos(self) -> None:
        for tpdo in self._tpdos:
            tpdo.restart()
        self._route()

    def _reset_objects(self, *, node: bool, faulty: bool) -> None:
        """Take power-on values after an NMT reset; `faulty`: the errors are still present."""
        self.dictionary.reset(last=0xFFFF if node else 0x1FFF)
        self._values.update(self._fixed)
        self.emergency.restart(faulty=faulty)
        self._sdo.reset()
        self._consumer.reset()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.rebuild()
        self._outbox = [self.nmt.boot()]

    def _flush(self) -> list[bytes]:
        """Take what is to be sent now."""
        if not self._outbox and not self.emergency.frames:
            return []
        sent = self._outbox
        if self.emergency.frames:
            if self.nmt.state is not NmtState.STOPPED:
                sent += self.emergency.frames
            self.emergency.frames.clear()
        self._outbox = []
        return sent

    def _route(self) -> None:
        self._sync_id = self._values[K_SYNC_COB_ID] & CAN_ID_BITS
        self._sync_length = int(self._values[K_SYNC_COUNTER] > 0)
        self._rpdo_of = {rpdo.can_id: rpdo for rpdo in self._rpdos if rpdo.valid}
        self._active_tpdos = tuple(tpdo for tpdo in self._tpdos if tpdo.valid and not tpdo.waiting)
        self.revision += 1

    def _check_sync(self, cob_id: int) -> None:
        entry = self.dictionary.entries[K_SYNC_COB_ID]
        check_can_id(cob_id, entry)
        if cob_id & ~CAN_ID_BITS:  # bit 30 would make it a producer
            raise entry.abort(AbortCode.VALUE_INVALID)

    def _check_counter(self, overflow: int) -> None:
        entry = self.dictionary.entries[K_SYNC_COUNTER]
        if self._values[K_SYNC_PERIOD]:
            raise entry.abort(AbortCode.DEVICE_STATE)
        if overflow == 1:  # reserved, as is all above the EDS's limit
            raise entry.abort(AbortCode.VALUE_INVALID)
