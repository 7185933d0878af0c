"""A simulated CiA 402 drive on CANopen: what its node says on the bus, given what it hears and the time.

Pure: frames and times [ns] come in, frames of 16 bytes go out. Choices where the standards leave room:

- An RPDO of any wrong length is dropped with EMCY 0x8210; the next right one takes the error back.
- Event-driven TPDOs (types 254, 255) go out with the answer to the SYNC, or at a tick while no SYNC is running.
- Watchdogs (`Watchdogs`) over SYNC (EMCY 0x8100) and RPDOs (EMCY 0x8250) make the drive hold by its own means
  (`Power.lose_command`). A torque written by SDO counts as a command.
- Leaving OPERATIONAL, or losing the heartbeat of 0x1016 (EMCY 0x8130), acts by option 0x6007: 0 hold as above, 1 fault,
  2 disable voltage, 3 quick stop. A fault cannot be reset while the heartbeat is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from hal.profile import frames, identifiers, objects
from hal.profile.cia402 import EmergencyCode, StatusBit
from plant_service.axis import Axis
from plant_service.drive_objects import K_ABORT_OPTION, K_SYNC_COB_ID, abort_connection, configure_all, install_hooks
from plant_service.emergency import Emergency
from plant_service.nmt import HeartbeatConsumer, HeartbeatProducer, NmtReset, NmtSlave, NmtState
from plant_service.object_dictionary import DeviceDictionary, key_of
from plant_service.pdo import CAN_ID_BITS, Rpdo, Tpdo
from plant_service.power import CST, K_TORQUE, K_TORQUE_ACTUAL, OPERATION_ENABLED, Power
from plant_service.sdo_server import SdoServer
from plant_service.watchdog import SYNC_TIMEOUT, Watchdogs
from schemas.messages import DriveState

PDO_COUNT: Final = 2
"""Of each direction."""

K_STATUSWORD = key_of(objects.STATUSWORD)
K_POSITION_ACTUAL = key_of(objects.POSITION_ACTUAL)
K_TORQUE_DEMAND = key_of(objects.TORQUE_DEMAND)
K_SUPPORTED = key_of(objects.SUPPORTED_DRIVE_MODES)
REMOTE: Final = int(StatusBit.REMOTE)
OPERATIONAL: Final = NmtState.OPERATIONAL


class DriveDevice:
    """One drive. `fixed` overrides defaults of the EDS for this device, by `key_of` (identity, supported modes, …)."""

    def __init__(
        self, node_id: int, axis: Axis, fixed: Mapping[int, int] | None = None, eds: Path | None = None
    ) -> None:
        self.node_id = node_id
        self.revision = 0
        """Grows when the device listens to other identifiers than before."""
        self._axis = axis
        self._fixed = dict(fixed or {})
        self.dictionary = DeviceDictionary(eds or Path(objects.eds_path()), node_id)
        self._values: dict[int, Any] = self.dictionary.values
        self._values.update(self._fixed)
        self.emergency = Emergency(self.dictionary)
        self.nmt = NmtSlave(node_id)
        self.power = Power(self._values, axis, self._values[K_SUPPORTED])
        self._producer = HeartbeatProducer(self.dictionary, self.nmt)
        self._consumer = HeartbeatConsumer(self.dictionary)
        self._sdo = SdoServer(self.dictionary)
        self._watchdogs = Watchdogs(self._values)
        self._rpdo_of: dict[int, Rpdo] = {}
        self._rpdos: tuple[Rpdo, ...] = ()
        self._tpdos: tuple[Tpdo, ...] = ()
        self._valid_tpdos: tuple[Tpdo, ...] = ()
        self._rpdos = tuple(Rpdo(self.dictionary, number, self._route) for number in range(PDO_COUNT))
        self._tpdos = tuple(Tpdo(self.dictionary, number, self._route) for number in range(PDO_COUNT))
        self._route()
        self._pending: dict[Rpdo, bytes] = {}
        self._now_ns = 0
        self._due_ns = 0
        """Before this time a tick has nothing to do but to measure the speed; 0: see at the next tick."""
        install_hooks(self.dictionary, axis, self.power.supports, setpoint=self._set_by_sdo, routes=self._route)
        self._outbox = [self.nmt.boot()]

    @property
    def can_ids(self) -> frozenset[int]:
        """Identifiers that this device listens to now."""
        others = {identifiers.NMT, self._sync_id, identifiers.SDO_RX + self.node_id}
        return frozenset(others | set(self._rpdo_of) | ({self._consumer.can_id} - {0}))

    @property
    def state(self) -> DriveState:
        """State of the power state machine."""
        return self.power.state

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Hear a frame; the frames to send because of it, in order."""
        self._now_ns = now_ns
        rpdo = self._rpdo_of.get(can_id)
        if rpdo is not None:
            if self.nmt.state is OPERATIONAL:
                self._receive_rpdo(rpdo, data)
            return self._flush()
        if can_id == self._sync_id:
            return self.sync(now_ns, data)
        self._due_ns = 0
        if can_id == identifiers.SDO_RX + self.node_id:
            if self.nmt.state is not NmtState.STOPPED:
                self._request(data)
        elif can_id == identifiers.NMT:
            self._command(data)
        elif can_id == self._consumer.can_id and self._consumer.hear(now_ns):
            self.emergency.vanish(EmergencyCode.HEARTBEAT_LOST)
        return self._flush()

    def sync(self, now_ns: int, data: bytes = b"") -> list[bytes]:
        """Latch what came since the last SYNC, sample, and answer: EMCY, then the TPDOs that are due."""
        self._now_ns = now_ns
        if data:
            self.emergency.appear(EmergencyCode.SYNC_LENGTH)
            return self._flush()
        if self.nmt.state is not OPERATIONAL:
            return self._flush()
        watchdogs = self._watchdogs
        if watchdogs.sync_ns is None:
            self._due_ns = 0
        watchdogs.sync_ns = now_ns
        self._measure()
        if self._pending:
            for rpdo, raw in self._pending.items():
                self._apply(rpdo, raw)
            self._pending.clear()
        self._latch()
        self._report()
        if self.emergency.active:
            self._recover()
        sent = self._flush()
        for tpdo in self._valid_tpdos:
            frame = tpdo.at_sync(now_ns)
            if frame is not None:
                sent.append(frame)
        return sent

    def tick(self, now_ns: int) -> list[bytes]:
        """Time has passed: watchdogs, heartbeats, ramps, event-driven TPDOs without SYNC."""
        self._now_ns = now_ns
        self.power.tick(now_ns)
        if now_ns < self._due_ns:
            return []
        self._watch(now_ns)
        if self._consumer.tick(now_ns):
            self.emergency.appear(EmergencyCode.HEARTBEAT_LOST)
            self._abort_connection(EmergencyCode.HEARTBEAT_LOST)
        heartbeat = self._producer.tick(now_ns)
        sent = self._flush()
        without_sync = self._watchdogs.sync_ns is None and self.nmt.state is OPERATIONAL
        if without_sync:
            self._sample()
            for tpdo in self._valid_tpdos:
                frame = tpdo.by_event(now_ns)
                if frame is not None:
                    sent.append(frame)
        if heartbeat:
            sent.append(heartbeat)
        self._due_ns = 0 if without_sync else self._next_due_ns()
        return sent

    def fault(self, code: int) -> None:
        """Inject a fault: EMCY, fault reaction, FAULT; a fault reset takes it back."""
        self._due_ns = 0
        self.emergency.appear(code)
        self.power.fault()

    # ---- what arrives

    def _receive_rpdo(self, rpdo: Rpdo, data: bytes) -> None:
        if len(data) != rpdo.codec.size:
            self.emergency.appear(EmergencyCode.PDO_LENGTH)
            return
        if self._watchdogs.command_ns is None or rpdo.received_ns is None:
            self._due_ns = 0
        self._watchdogs.command_ns = rpdo.received_ns = self._now_ns
        if rpdo.synchronous:
            self._pending.pop(rpdo, None)
            self._pending[rpdo] = data
        else:
            self._apply(rpdo, data)
            self._latch()

    def _apply(self, rpdo: Rpdo, data: bytes) -> None:
        self._values.update(zip(rpdo.keys, rpdo.codec.unpack(data), strict=True))
        self._act(rpdo.keys)

    def _act(self, keys: tuple[int, ...]) -> None:
        power = self.power
        state, mode = power.state, power.mode
        if power.receive(keys, can_reset=not self._consumer.lost):
            kept = (EmergencyCode.PDO_LENGTH, EmergencyCode.SYNC_LENGTH)
            self.emergency.vanish(*(code for code in self.emergency.active if code not in kept))
        if power.state is not state or power.mode != mode:
            self._due_ns = 0

    def _latch(self) -> None:
        if self.power.latch():
            self.fault(EmergencyCode.FOLLOWING_ERROR)

    def _request(self, data: bytes) -> None:
        self._sample()
        answer = self._sdo.request(data)
        if answer is not None:
            self._outbox.append(frames.pack(identifiers.SDO_TX + self.node_id, answer))

    def _command(self, data: bytes) -> None:
        before = self.nmt.state
        reset = self.nmt.command(data)
        if reset is not None:
            self._reset(node=reset is NmtReset.NODE)
        elif before is NmtState.OPERATIONAL and self.nmt.state is not NmtState.OPERATIONAL:
            self._watchdogs.clear()
            self._pending.clear()
            self._abort_connection(SYNC_TIMEOUT)
        elif self.nmt.state is NmtState.OPERATIONAL and before is not NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                tpdo.last = None

    # ---- what the device does by itself

    def _sample(self) -> None:
        self._measure()
        self._report()

    def _measure(self) -> None:
        self._values[K_POSITION_ACTUAL] = self._axis.position_counts()
        self._values[K_TORQUE_ACTUAL] = self._axis.torque_per_mille()

    def _report(self) -> None:
        values, power = self._values, self.power
        values[K_TORQUE_DEMAND] = values[K_TORQUE] if power.mode == CST and power.following else 0
        remote = REMOTE if self.nmt.state is OPERATIONAL else 0
        values[K_STATUSWORD] = power.statusword() | remote

    def _watch(self, now_ns: int) -> None:
        if self.power.state is OPERATION_ENABLED:
            torque = self.power.mode == CST
            for code in self._watchdogs.expired(self._rpdo_of.values(), now_ns, torque=torque):
                self.emergency.appear(code)
                self.power.lose_command()

    def _next_due_ns(self) -> int:
        due_ns = min(self._consumer.due_ns, self._producer.due_ns)
        if self.power.state is OPERATION_ENABLED:
            torque = self.power.mode == CST
            due_ns = min(due_ns, self._watchdogs.due_ns(self._rpdo_of.values(), torque=torque))
        return due_ns

    def _recover(self) -> None:
        """Take back the errors whose cause is gone: PDOs of the right length, a fresh start after a hold."""
        commanded = self._watchdogs.command_ns == self._now_ns
        gone = [EmergencyCode.PDO_LENGTH, EmergencyCode.SYNC_LENGTH] if commanded else []
        if not self.power.left_alone and self.power.state is OPERATION_ENABLED:
            self.emergency.vanish(SYNC_TIMEOUT, EmergencyCode.RPDO_TIMEOUT)
        self.emergency.vanish(*gone)

    def _abort_connection(self, code: int) -> None:
        if abort_connection(self.power, self._values[K_ABORT_OPTION], self._now_ns):
            self.fault(code)

    def _reset(self, *, node: bool) -> None:
        self.dictionary.reset(last=0xFFFF if node else 0x1FFF)
        self._values.update(self._fixed)
        self.emergency.forget()
        self._sdo.reset()
        self._consumer.reset()
        self._pending.clear()
        self._watchdogs.clear()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.rebuild()
        if node:
            self.power.reset()
            configure_all(self.dictionary, self._axis)
        else:
            self.power.release()
        self._outbox = [self.nmt.boot()]

    def _flush(self) -> list[bytes]:
        if not self._outbox and not self.emergency.frames:
            return []
        sent = self._outbox
        if self.emergency.frames:
            if self.nmt.state is not NmtState.STOPPED:
                sent += self.emergency.frames
            self.emergency.frames.clear()
        self._outbox = []
        return sent

    # ---- what SDO writes do

    def _set_by_sdo(self, key: int) -> None:
        if key == K_TORQUE and self.power.state is OPERATION_ENABLED:
            self._watchdogs.command_ns = self._now_ns
        self._act((key,))
        self._latch()

    def _route(self) -> None:
        self._sync_id = self._values[K_SYNC_COB_ID] & CAN_ID_BITS
        self._rpdo_of = {rpdo.can_id: rpdo for rpdo in self._rpdos if rpdo.valid}
        self._valid_tpdos = tuple(tpdo for tpdo in self._tpdos if tpdo.valid)
        self.revision += 1
