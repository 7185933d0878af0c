"""One drive on its way to OPERATION ENABLED in position mode, holding where it stands.

Controlwords go by SDO, so that no SYNC is needed and no simulated time passes. Another maker's drive that does not move
by that alone gets them by RPDO and SYNC as well: some obey PDOs only, some act at a SYNC only.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from hal.boot_objects import torque_limit_per_mille
from hal.bus.errors import BusError
from hal.errors import BootError
from hal.node_link import NodeLink
from hal.profile import identifiers, objects
from hal.profile.cia402 import (
    Controlword,
    OperationMode,
    UndefinedStatuswordError,
    decode_state,
    next_controlword,
)
from hal.profile.frames import pack
from schemas.messages import DriveState
from schemas.robot import Joint

POLL_S: Final = 0.001
"""Pause before a drive that is on its way is asked again."""
PATIENCE_S: Final = 1.0
"""Time without progress after which RPDO and SYNC are tried beside SDO."""
FAULT_PATIENCE_S: Final = 1.0
"""Time in which a fault has to be gone once its reset was commanded."""
FAULT_RESET_S: Final = 0.2
"""Pause before the reset is commanded again: causes may have piled up, each with a reset of its own."""


@dataclass(slots=True)
class PowerUp:
    """Leads one drive to OPERATION ENABLED, mode 8."""

    link: NodeLink
    joint: Joint
    counts: int
    """Where it stands [counts]: its first target."""
    timeout_s: float
    period_s: float
    foreign: bool
    """The drive is another maker's."""
    may_sync: bool
    """All drives of its bus are of other makers, so that a SYNC during the boot does no harm."""
    by_pdo: bool = False
    """RPDO and SYNC had to be used."""

    def prepare(self) -> None:
        """Set position mode and targets that keep the joint where it stands.

        The profile's drive that is enabled already holds by its own means, and a target would be a command. Another
        maker's has an old target, which it must not follow in the new mode.
        """
        link, foreign = self.link, self.foreign
        if foreign:
            self.counts = link.read(objects.POSITION_ACTUAL)  # one that is enabled already may have moved meanwhile
            link.write(objects.TARGET_POSITION, 0, self.counts)
        link.write(objects.MODE, 0, OperationMode.CSP)
        if self._state() is not DriveState.OPERATION_ENABLED:
            if not foreign:
                link.write(objects.TARGET_POSITION, 0, self.counts)
            if self.joint.drive.kind == "torque":
                link.write(objects.TARGET_TORQUE, 0, 0)

    def run(self) -> OperationMode:
        """Enable the drive, reading a fresh statusword before each step; its mode then.

        Raises:
            BootError: it does not get there in time, its fault stays, or it reports another mode.
            BusLostError: the bus is gone.

        """
        deadline = time.monotonic() + self.timeout_s
        self._climb(deadline)
        return self._check_mode(deadline)

    def _climb(self, deadline: float) -> None:
        before: DriveState | None = None
        since = reset_at = faulty_until = 0.0
        while (state := self._state()) is not DriveState.OPERATION_ENABLED:
            now = time.monotonic()
            command = next_controlword(state, DriveState.OPERATION_ENABLED)
            if state is DriveState.NOT_READY_TO_SWITCH_ON and self.may_sync:
                command = Controlword.SHUTDOWN  # does nothing by the standard, but some wait for it with statusword 0
            if state is before:
                self._wait(since, now, command)
            else:
                since, before = now, state
                if command == Controlword.ENABLE_OPERATION and self.foreign:
                    self._follow()
                if state is DriveState.FAULT:
                    if faulty_until:
                        raise self._stuck(state)  # the fault is back
                    faulty_until = now + FAULT_PATIENCE_S
            if now > deadline or (state is DriveState.FAULT and now > faulty_until):
                raise self._stuck(state)
            if state is not DriveState.FAULT:
                self._command(command)
            elif now > reset_at + FAULT_RESET_S:
                reset_at = now
                self._command(Controlword.DISABLE_VOLTAGE)  # the reset acts on the edge of bit 7
                self._command(command)

    def _stuck(self, state: DriveState) -> BootError:
        code = self.link.read_optional(objects.ERROR_CODE) or 0
        return BootError(
            f"{self.link.where}: stays in {state.name} instead of OPERATION_ENABLED, error code 0x{code:04X};"
            " remove the cause and start again"
        )

    def _follow(self) -> None:
        """Take the place where the joint stands now as its target: without a brake it may have sagged meanwhile."""
        self.counts = self.link.read(objects.POSITION_ACTUAL)
        self.link.try_write(objects.TARGET_POSITION, 0, self.counts)  # if refused, the target is the one before

    def _check_mode(self, deadline: float) -> OperationMode:
        """Await the report of mode 8: some drives take a mode only now, or at a SYNC."""
        since = time.monotonic()
        while (mode := self.link.read(objects.MODE_DISPLAY)) != OperationMode.CSP:
            now = time.monotonic()
            if now > deadline:
                raise BootError(
                    f"{self.link.where}: reports mode {mode} (object 0x6061) after mode {OperationMode.CSP:d} was set"
                )
            self._wait(since, now, Controlword.ENABLE_OPERATION)
            self.link.write(objects.MODE, 0, OperationMode.CSP)
        return OperationMode.CSP

    def _command(self, controlword: int) -> None:
        refusal = self.link.try_write(objects.CONTROLWORD, 0, controlword)
        if refusal is not None:
            if not self.may_sync:
                raise BootError(refusal.text)
            self.by_pdo = True
        if self.by_pdo:
            self._exchange(controlword)

    def _wait(self, since: float, now: float, controlword: int) -> None:
        if self.by_pdo or (self.may_sync and now - since > PATIENCE_S):
            self.by_pdo = True
            self._exchange(controlword)
            time.sleep(self.period_s)
        else:
            time.sleep(POLL_S)

    def _exchange(self, controlword: int) -> None:
        """Send RPDO1 with a controlword and the place where the drive stands, then SYNC."""
        if self.joint.drive.kind == "servo":
            data = objects.SERVO_STRUCT.pack(controlword, self.counts, torque_limit_per_mille(self.joint))
        else:
            data = objects.POSITION_STRUCT.pack(controlword, OperationMode.CSP, self.counts)
        command = pack(identifiers.RPDO1 + self.link.node_id, data)
        self.link.network.port.send(command + pack(identifiers.SYNC, b""))

    def give_up(self) -> None:
        """Disable a drive that may obey PDOs only; the others hear it by SDO."""
        if self.by_pdo:
            with suppress(BusError):  # the failure that led here is the one to tell of
                self._exchange(Controlword.DISABLE_VOLTAGE)

    def _state(self) -> DriveState:
        word = self.link.read(objects.STATUSWORD)
        try:
            return decode_state(word)
        except UndefinedStatuswordError as error:
            raise BootError(f"{self.link.where}: {error}; wrong drive, or check its firmware") from error
