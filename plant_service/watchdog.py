"""Watchdogs of a drive over its commands: the maker's over SYNC and RPDOs, and the event timer of each RPDO.

`0x2004` × `0x1006` without SYNC or without RPDO, once one was seen in OPERATIONAL, is too long, and so is
`STALE_TORQUE_NS` without a new torque where 0x1006 is 0; 0x2004 = 0 switches these off. They act in Operation Enabled.
The event timer of an RPDO (CiA 301 section 7.5.2.35) is watched in OPERATIONAL. A watchdog that has run out waits for
the next SYNC or RPDO. Times in ns are passed in.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from hal.profile import objects
from hal.profile.cia402 import EmergencyCode
from plant_service.nmt import NEVER_NS
from plant_service.object_dictionary import key_of
from plant_service.pdo import Rpdo

SYNC_TIMEOUT: Final = int(EmergencyCode.COMMUNICATION)
"""Error code of a missing SYNC."""
STALE_TORQUE_NS: Final = 100_000_000

K_SYNC_PERIOD: Final = key_of(objects.SYNC_PERIOD_US)
K_WATCHDOG: Final = key_of(objects.WATCHDOG_CYCLES)


class Watchdogs:
    """The watchdogs of one drive."""

    def __init__(self, values: dict[int, Any]) -> None:
        self._values = values
        self.sync_ns: int | None = None
        """Of the last SYNC in OPERATIONAL; None: none is expected."""
        self.command_ns: int | None = None
        """Of the last command; None: none is expected."""

    def clear(self, rpdos: Iterable[Rpdo]) -> None:
        """Expect neither SYNC nor commands until the next one comes."""
        self.sync_ns = self.command_ns = None
        for rpdo in rpdos:
            rpdo.received_ns = None

    def expired(self, rpdos: Iterable[Rpdo], now_ns: int, *, enabled: bool, torque: bool) -> list[int]:
        """Error codes of the watchdogs that have just run out.

        Args:
            rpdos: those that the drive receives.
            now_ns: time.
            enabled: the drive is in Operation Enabled.
            torque: the drive is in a torque mode.

        """
        codes: list[int] = []
        if enabled:
            sync_timeout_ns, command_timeout_ns = self._timeouts(torque=torque)
            if sync_timeout_ns and self.sync_ns is not None and now_ns - self.sync_ns >= sync_timeout_ns:
                self.sync_ns = None
                codes.append(SYNC_TIMEOUT)
            if command_timeout_ns and self.command_ns is not None and now_ns - self.command_ns >= command_timeout_ns:
                self.command_ns = None
                codes.append(int(EmergencyCode.RPDO_TIMEOUT))
        for rpdo in rpdos:
            if now_ns >= rpdo.deadline_ns:
                rpdo.received_ns = None
                codes.append(int(EmergencyCode.RPDO_TIMEOUT))
        return codes

    def due_ns(self, rpdos: Iterable[Rpdo], *, enabled: bool, torque: bool) -> int:
        """Earliest time at which one can run out if nothing more comes."""
        due_ns = min((rpdo.deadline_ns for rpdo in rpdos), default=NEVER_NS)
        if enabled:
            sync_timeout_ns, command_timeout_ns = self._timeouts(torque=torque)
            if sync_timeout_ns and self.sync_ns is not None:
                due_ns = min(due_ns, self.sync_ns + sync_timeout_ns)
            if command_timeout_ns and self.command_ns is not None:
                due_ns = min(due_ns, self.command_ns + command_timeout_ns)
        return due_ns

    def _timeouts(self, *, torque: bool) -> tuple[int, int]:
        """Longest times without SYNC and without command [ns], 0 is no limit."""
        cycles = self._values[K_WATCHDOG]
        timeout_ns = cycles * self._values[K_SYNC_PERIOD] * 1000
        return timeout_ns, timeout_ns or (STALE_TORQUE_NS if torque and cycles else 0)
