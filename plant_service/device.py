"""A simulated CiA 402 drive on CANopen: what its node says on the bus, given what it hears and the time.

Pure: frames and times [ns] come in, frames of 16 bytes go out. Choices where the standards leave room:

- A short RPDO is dropped with EMCY 0x8210, of a long one the mapped bytes are taken with EMCY 0x8220; an RPDO of the
  right length takes the error back at its SYNC.
- Event-driven TPDOs (types 254, 255) go out with the answer to the SYNC, or at a tick while no SYNC is running.
- Watchdogs (`Watchdogs`) over SYNC (EMCY 0x8100) and RPDOs (EMCY 0x8250) make the drive hold by its own means
  (`Power.lose_command`). A torque written by SDO counts as a command.
- Leaving OPERATIONAL, or losing the heartbeat of 0x1016 (EMCY 0x8130), acts by option 0x6007: 0 hold as above, 1 fault,
  2 disable voltage, 3 quick stop; then by 0x1029 a lost heartbeat changes the NMT state. A fault cannot be reset while
  the heartbeat is missing, and what caused it stays in 0x1001 and 0x603F until then.
- NMT reset communication leaves the power state alone (but for 0x6007): a drive in FAULT stays there with its errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from hal.profile import identifiers, objects
from hal.profile.cia402 import EmergencyCode
from plant_service.axis import Axis
from plant_service.drive_objects import K_ABORT_OPTION, abort_connection, configure_all, install_hooks
from plant_service.nmt import NmtReset
from plant_service.node import OPERATIONAL, CanopenNode
from plant_service.object_dictionary import key_of
from plant_service.pdo import Rpdo
from plant_service.power import CST, K_TORQUE, K_TORQUE_ACTUAL, OPERATION_ENABLED, Power
from plant_service.watchdog import K_WATCHDOG, SYNC_TIMEOUT, Watchdogs
from schemas.messages import DriveState

K_STATUSWORD = key_of(objects.STATUSWORD)
K_POSITION_ACTUAL = key_of(objects.POSITION_ACTUAL)
K_TORQUE_DEMAND = key_of(objects.TORQUE_DEMAND)
K_TIME_BASE = key_of(objects.TIME_BASE)
K_SUPPORTED = key_of(objects.SUPPORTED_DRIVE_MODES)
K_ERROR_BEHAVIOUR = key_of(objects.ERROR_BEHAVIOUR, 1)
LENGTH_ERRORS: Final = (EmergencyCode.PDO_LENGTH, EmergencyCode.PDO_LENGTH_EXCEEDED, EmergencyCode.SYNC_LENGTH)
"""Errors of the communication alone, which end by themselves."""
FAULTY: Final = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)


class DriveDevice(CanopenNode):
    """One drive."""

    def __init__(
        self, node_id: int, axis: Axis, fixed: Mapping[int, int] | None = None, eds: Path | None = None
    ) -> None:
        super().__init__(node_id, {K_TIME_BASE: objects.TimeBase.SIMULATION} | dict(fixed or {}), eds)
        self._axis = axis
        self.power = Power(self._values, axis, self._values[K_SUPPORTED])
        self._watchdogs = Watchdogs(self._values)
        self._pending: dict[Rpdo, bytes] = {}
        """What the next SYNC latches, in the order of arrival."""
        self._commanded = False
        """An RPDO was taken since errors were last looked through."""
        self._now_ns = 0
        self._due_ns = 0
        """Before this time a tick has nothing to do but to measure the speed; 0: see at the next tick."""
        install_hooks(self.dictionary, axis, self.power.supports, self._set_by_sdo)

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
            self._sample()
            self._answer(data)
        elif can_id == identifiers.NMT:
            self._command(data)
        elif can_id == self._consumer.can_id and self._consumer.hear(now_ns) and self.power.state not in FAULTY:
            self.emergency.vanish(EmergencyCode.HEARTBEAT_LOST)
        return self._flush()

    def sync(self, now_ns: int, data: bytes = b"") -> list[bytes]:
        """Latch what came since the last SYNC, sample, and answer: EMCY, then the TPDOs that are due."""
        self._now_ns = now_ns
        if (data or self._sync_length) and not self._count(data):
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
        for tpdo in self._active_tpdos:
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
            self._lose_heartbeat()
        heartbeat = self._producer.tick(now_ns)
        sent = self._flush()
        without_sync = self._watchdogs.sync_ns is None and self.nmt.state is OPERATIONAL
        if without_sync:
            self._sample()
            for tpdo in self._active_tpdos:
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
        size = rpdo.codec.size
        if len(data) != size:
            self._misfit = True
            if len(data) < size:
                self.emergency.appear(EmergencyCode.PDO_LENGTH)
                return
            self.emergency.appear(EmergencyCode.PDO_LENGTH_EXCEEDED)
            data = data[:size]
        if self._watchdogs.command_ns is None or rpdo.received_ns is None:
            self._due_ns = 0
        self._watchdogs.command_ns = rpdo.received_ns = self._now_ns
        self._commanded = True
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
            self.emergency.vanish(*(code for code in self.emergency.active if code not in LENGTH_ERRORS))
        if power.state is not state or power.mode != mode:
            self._due_ns = 0

    def _latch(self) -> None:
        if self.power.latch():
            self.fault(EmergencyCode.FOLLOWING_ERROR)

    def _command(self, data: bytes) -> None:
        before = self.nmt.state
        reset = self.nmt.command(data)
        leaves = before is OPERATIONAL and (reset is not None or self.nmt.state is not OPERATIONAL)
        if leaves:
            self._silence()
            if reset is not NmtReset.NODE:
                self._abort_connection(SYNC_TIMEOUT)
        if reset is not None:
            self._reset(node=reset is NmtReset.NODE)
        elif before is not OPERATIONAL and self.nmt.state is OPERATIONAL:
            self._start_tpdos()

    def _silence(self) -> None:
        """Leave OPERATIONAL: expect no more PDOs and SYNCs."""
        self._watchdogs.clear(self._rpdos)
        self._pending.clear()

    def _lose_heartbeat(self) -> None:
        self.emergency.appear(EmergencyCode.HEARTBEAT_LOST)
        self._abort_connection(EmergencyCode.HEARTBEAT_LOST)
        self._outbox = self._flush()
        state = self.nmt.lose_heartbeat(self._values[K_ERROR_BEHAVIOUR])
        if state is not OPERATIONAL:
            self._silence()

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
        values[K_STATUSWORD] = power.statusword()

    def _watch(self, now_ns: int) -> None:
        enabled, torque = self.power.state is OPERATION_ENABLED, self.power.mode == CST
        for code in self._watchdogs.expired(self._rpdo_of.values(), now_ns, enabled=enabled, torque=torque):
            self._commanded = False
            self.emergency.appear(code)
            self.power.lose_command()

    def _next_due_ns(self) -> int:
        enabled, torque = self.power.state is OPERATION_ENABLED, self.power.mode == CST
        due_ns = self._watchdogs.due_ns(self._rpdo_of.values(), enabled=enabled, torque=torque)
        return min(due_ns, self._consumer.due_ns, self._producer.due_ns)

    def _recover(self) -> None:
        """Take back the errors whose cause is gone: PDOs of the right length, a fresh start after a hold."""
        gone: list[int] = []
        commanded = self._commanded
        if commanded and not self._misfit:
            gone += LENGTH_ERRORS
        self._misfit = self._commanded = False
        if not self.power.left_alone:
            if self.power.state is OPERATION_ENABLED:
                gone += (SYNC_TIMEOUT, EmergencyCode.RPDO_TIMEOUT)
            elif commanded:
                gone.append(EmergencyCode.RPDO_TIMEOUT)
        self.emergency.vanish(*gone)

    def _abort_connection(self, code: int) -> None:
        watched = bool(self._values[K_WATCHDOG])
        if abort_connection(self.power, self._values[K_ABORT_OPTION], self._now_ns, watched=watched):
            self.fault(code)

    def _reset(self, *, node: bool) -> None:
        self._reset_objects(node=node, faulty=not node and self.power.state in FAULTY)
        if node:
            self.power.reset()
            configure_all(self.dictionary, self._axis)
        else:
            self.power.release()

    # ---- what SDO writes do

    def _set_by_sdo(self, key: int) -> None:
        if key == K_TORQUE and self.power.state is OPERATION_ENABLED:
            self._watchdogs.command_ns = self._now_ns
        self._act((key,))
        self._latch()
