"""A simulated CiA 402 drive on CANopen: what its node says on the bus, given what it hears and the time.

Pure: frames and times [ns] come in, frames of 16 bytes go out. Choices where the standards leave room:

- An RPDO of any wrong length is dropped with EMCY 0x8210; the next right one takes the error back.
- Event-driven TPDOs (types 254, 255) go out with the answer to the SYNC, or at a tick while no SYNC is running.
- Watchdogs: `0x2004` × `0x1006` without SYNC (EMCY 0x8100) or without RPDO (EMCY 0x8250), once one was seen in
  OPERATIONAL, make the drive hold by its own means (`Power.lose_command`). A torque written by SDO arms them too; with
  0x1006 = 0 a torque grows stale after 100 ms.
- Leaving OPERATIONAL, or losing the heartbeat of 0x1016 (EMCY 0x8130), acts by option 0x6007: 0 hold as above, 1 fault,
  2 disable voltage, 3 quick stop. A fault cannot be reset while the heartbeat is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from hal.profile import frames, identifiers, objects
from hal.profile.cia402 import AbortConnectionOption, EmergencyCode, StatusBit
from plant_service.axis import Axis, AxisGains
from plant_service.emergency import Emergency
from plant_service.nmt import HeartbeatConsumer, HeartbeatProducer, NmtReset, NmtSlave, NmtState
from plant_service.object_dictionary import AbortCode, DeviceDictionary, key_of
from plant_service.pdo import CAN_ID_BITS, Rpdo, Tpdo
from plant_service.power import (
    CST,
    K_CONTROLWORD,
    K_MAX_TORQUE,
    K_MODE,
    K_POSITION,
    K_TORQUE,
    K_TORQUE_ACTUAL,
    OPERATION_ENABLED,
    Power,
)
from plant_service.sdo_server import SdoServer
from schemas.messages import DriveState

SYNC_TIMEOUT: Final = 0x8100
"""Error code of a missing SYNC: communication, generic."""
STALE_TORQUE_NS: Final = 100_000_000
RPDO_COUNT: Final = 2
TPDO_COUNT: Final = 2

K_STATUSWORD = key_of(objects.STATUSWORD)
K_POSITION_ACTUAL = key_of(objects.POSITION_ACTUAL)
K_TORQUE_DEMAND = key_of(objects.TORQUE_DEMAND)
K_SYNC_COB_ID = key_of(objects.SYNC_COB_ID)
K_SYNC_PERIOD = key_of(objects.SYNC_PERIOD_US)
K_WATCHDOG = key_of(objects.WATCHDOG_CYCLES)
K_SUPPORTED = key_of(objects.SUPPORTED_DRIVE_MODES)
K_COUNTER = key_of(objects.SYNC_COUNTER)
GAIN_FIELDS: Final = {
    key_of(objects.POSITION_GAIN): ("position_gain", 1e-3),
    key_of(objects.VELOCITY_GAIN): ("velocity_gain", 1e-3),
    key_of(objects.HOLD_RAMP_MS): ("hold_ramp_s", 1e-3),
    key_of(objects.JOINT_TORQUE_LIMIT): ("torque_limit", 1e-3),
    key_of(objects.RATED_TORQUE_MNM): ("rated_motor_torque", 1e-3),
}
"""Firmware parameters: object → field of `AxisGains` and its unit in SI."""
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
        self._rpdo_of: dict[int, Rpdo] = {}
        self._rpdos: tuple[Rpdo, ...] = ()
        self._rpdos = tuple(Rpdo(self.dictionary, number, self._route) for number in range(RPDO_COUNT))
        self._tpdos = tuple(Tpdo(self.dictionary, number, self._route) for number in range(TPDO_COUNT))
        self._route()
        self._pending: dict[Rpdo, bytes] = {}
        self._now_ns = 0
        self._sync_ns: int | None = None
        self._command_ns: int | None = None
        self._hook()
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
            if not self._outbox and not self.emergency.frames:
                return []
        elif can_id == self._sync_id:
            return self.sync(now_ns, data)
        elif can_id == identifiers.SDO_RX + self.node_id:
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
        self._sync_ns = now_ns
        values, axis, power = self._values, self._axis, self.power
        values[K_POSITION_ACTUAL] = axis.position_counts()
        values[K_TORQUE_ACTUAL] = axis.torque_per_mille()
        if self._pending:
            for rpdo, raw in self._pending.items():
                self._apply(rpdo, raw)
            self._pending.clear()
        self._latch()
        values[K_TORQUE_DEMAND] = values[K_TORQUE] if power.following and power.mode == CST else 0
        values[K_STATUSWORD] = power.statusword() | REMOTE
        if self.emergency.active:
            self._recover()
        sent = self._flush() if self._outbox or self.emergency.frames else []
        for tpdo in self._tpdos:
            if tpdo.valid:
                frame = tpdo.pack()
                if tpdo.type == 1 or tpdo.due_at_sync(frame, now_ns):
                    tpdo.last = frame
                    tpdo.sent_ns = now_ns
                    sent.append(frame)
        return sent

    def tick(self, now_ns: int) -> list[bytes]:
        """Time has passed: watchdogs, heartbeats, ramps, event-driven TPDOs without SYNC."""
        self._now_ns = now_ns
        self.power.tick(now_ns)
        self._watch(now_ns)
        if self._consumer.tick(now_ns):
            self.emergency.appear(EmergencyCode.HEARTBEAT_LOST)
            self._abort_connection(EmergencyCode.HEARTBEAT_LOST)
        heartbeat = self._producer.tick(now_ns)
        sent = self._flush()
        if self._sync_ns is None and self.nmt.state is OPERATIONAL:
            self._sample()
            for tpdo in self._tpdos:
                frame = tpdo.pack() if tpdo.valid else b""
                if frame and tpdo.due_by_event(frame, now_ns):
                    tpdo.last = frame
                    tpdo.sent_ns = now_ns
                    sent.append(frame)
        if heartbeat:
            sent.append(heartbeat)
        return sent

    def fault(self, code: int) -> None:
        """Inject a fault: EMCY, fault reaction, FAULT; a fault reset takes it back."""
        self.emergency.appear(code)
        self.power.fault()

    # ---- what arrives

    def _receive_rpdo(self, rpdo: Rpdo, data: bytes) -> None:
        if len(data) != rpdo.codec.size:
            self.emergency.appear(EmergencyCode.PDO_LENGTH)
            return
        self._command_ns = rpdo.received_ns = self._now_ns
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
        if self.power.receive(keys, can_reset=not self._consumer.lost):
            kept = (EmergencyCode.PDO_LENGTH, EmergencyCode.SYNC_LENGTH)
            self.emergency.vanish(*(code for code in self.emergency.active if code not in kept))

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
            self._sync_ns = self._command_ns = None
            self._pending.clear()
            self._abort_connection(SYNC_TIMEOUT)
        elif self.nmt.state is NmtState.OPERATIONAL and before is not NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                tpdo.last = None

    # ---- what the device does by itself

    def _sample(self) -> None:
        values, axis = self._values, self._axis
        values[K_POSITION_ACTUAL] = axis.position_counts()
        values[K_TORQUE_ACTUAL] = axis.torque_per_mille()
        power = self.power
        values[K_TORQUE_DEMAND] = values[K_TORQUE] if power.mode == CST and power.following else 0
        status = power.statusword()
        values[K_STATUSWORD] = status | REMOTE if self.nmt.state is NmtState.OPERATIONAL else status

    def _watch(self, now_ns: int) -> None:
        cycles = self._values[K_WATCHDOG]
        if self.power.state is not OPERATION_ENABLED or not cycles:
            return
        timeout_ns = cycles * self._values[K_SYNC_PERIOD] * 1000
        if timeout_ns and self._sync_ns is not None and now_ns - self._sync_ns >= timeout_ns:
            self._sync_ns = None
            self._lose_command(SYNC_TIMEOUT)
        if self._command_ns is None:
            return
        if not timeout_ns and self.power.mode == CST:
            timeout_ns = STALE_TORQUE_NS
        if timeout_ns and now_ns - self._command_ns >= timeout_ns:
            self._command_ns = None
            self._lose_command(EmergencyCode.RPDO_TIMEOUT)
        for rpdo in self._rpdo_of.values():
            deadline_ns = rpdo.event_timer_ns
            if deadline_ns and rpdo.received_ns is not None and now_ns - rpdo.received_ns >= deadline_ns:
                rpdo.received_ns = None
                self._lose_command(EmergencyCode.RPDO_TIMEOUT)

    def _lose_command(self, code: int) -> None:
        self.emergency.appear(code)
        self.power.lose_command()

    def _recover(self) -> None:
        """Take back the errors whose cause is gone: PDOs of the right length, a fresh start after a hold."""
        gone = [EmergencyCode.PDO_LENGTH, EmergencyCode.SYNC_LENGTH] if self._command_ns == self._now_ns else []
        if not self.power.left_alone and self.power.state is OPERATION_ENABLED:
            self.emergency.vanish(SYNC_TIMEOUT, EmergencyCode.RPDO_TIMEOUT)
        self.emergency.vanish(*gone)

    def _abort_connection(self, code: int) -> None:
        option = self._values[key_of(objects.ABORT_CONNECTION_OPTION)]
        if option == AbortConnectionOption.FAULT_SIGNAL:
            self.fault(code)
        elif option == AbortConnectionOption.DISABLE_VOLTAGE:
            self.power.disable_voltage()
        elif option == AbortConnectionOption.QUICK_STOP:
            self.power.quick_stop(self._now_ns)
        else:
            self.power.lose_command()

    def _reset(self, *, node: bool) -> None:
        self.dictionary.reset(last=0xFFFF if node else 0x1FFF)
        self._values.update(self._fixed)
        self.emergency.forget()
        self._sdo.reset()
        self._consumer.reset()
        self._pending.clear()
        self._sync_ns = self._command_ns = None
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.rebuild()
        if node:
            self.power.reset()
            for key in GAIN_FIELDS:
                self._configure(key, self._values[key])
        else:
            self.power.release()
        self._outbox = [self.nmt.boot()]

    def _flush(self) -> list[bytes]:
        sent = self._outbox
        if self.emergency.frames:
            if self.nmt.state is not NmtState.STOPPED:
                sent += self.emergency.frames
            self.emergency.frames.clear()
        if sent:
            self._outbox = []
            return sent
        return []

    # ---- what SDO writes do

    def _hook(self) -> None:
        written, check = self.dictionary.written, self.dictionary.on_write
        for key in (K_CONTROLWORD, K_MODE, K_POSITION, K_TORQUE, K_MAX_TORQUE):
            written[key] = partial(self._set_by_sdo, key)
        for key in GAIN_FIELDS:
            written[key] = partial(self._configure, key)
        check[K_MODE] = self._check_mode
        check[K_SYNC_COB_ID] = self._check_sync
        check[K_COUNTER] = self._check_counter
        written[K_SYNC_COB_ID] = lambda _: self._route()
        consumer = written[key_of(objects.CONSUMER_HEARTBEAT, 1)]

        def watch(value: int) -> None:
            consumer(value)
            self._route()

        written[key_of(objects.CONSUMER_HEARTBEAT, 1)] = watch

    def _set_by_sdo(self, key: int, _: int) -> None:
        if key == K_TORQUE:
            self._command_ns = self._now_ns
        self._act((key,))
        self._latch()

    def _configure(self, key: int, value: int) -> None:
        field, unit = GAIN_FIELDS[key]
        if value:  # 0 is "as the maker left it"
            self._axis.configure(AxisGains(**{field: value * unit}))

    def _check_mode(self, mode: int) -> None:
        if not self.power.supports(mode):
            raise self.dictionary.entries[K_MODE].abort(AbortCode.VALUE_INVALID)

    def _check_sync(self, value: int) -> None:
        if value & ~CAN_ID_BITS or not value & CAN_ID_BITS:  # bit 30 would make it a producer
            raise self.dictionary.entries[K_SYNC_COB_ID].abort(AbortCode.VALUE_INVALID)

    def _check_counter(self, value: int) -> None:
        if value:
            raise self.dictionary.entries[K_COUNTER].abort(AbortCode.VALUE_INVALID)

    def _route(self) -> None:
        self._sync_id = self._values[K_SYNC_COB_ID] & CAN_ID_BITS
        self._rpdo_of = {rpdo.can_id: rpdo for rpdo in self._rpdos if rpdo.valid}
        self.revision += 1
