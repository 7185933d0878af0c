"""Watchdogs of a drive: what runs out when, and that the time foretold is the time it happens."""

from __future__ import annotations

import pytest

from hal.profile import objects
from plant_service.nmt import NEVER_NS
from plant_service.object_dictionary import DeviceDictionary
from plant_service.pdo import Rpdo
from plant_service.watchdog import K_SYNC_PERIOD, K_WATCHDOG, STALE_TORQUE_NS, SYNC_TIMEOUT, Watchdogs

MS = 1_000_000
RPDO_TIMEOUT = 0x8250


def unit(*, cycles: int = 5, period_us: int = 1000) -> Watchdogs:
    return Watchdogs({K_WATCHDOG: cycles, K_SYNC_PERIOD: period_us})


def deadline(milliseconds: int, received_ns: int) -> Rpdo:
    """An RPDO with an event timer, received at a time."""
    rpdo = Rpdo(DeviceDictionary(objects.eds_path(), 5), 0, lambda: None)
    rpdo.event_timer_ns, rpdo.received_ns = milliseconds * MS, received_ns
    return rpdo


@pytest.mark.parametrize(
    ("watchdogs", "sync_ns", "command_ns", "timer", "torque", "due_ns", "codes"),
    [
        (unit(), 7, None, None, False, 7 + 5 * MS, [SYNC_TIMEOUT]),
        (unit(), 7, 3, None, False, 3 + 5 * MS, [RPDO_TIMEOUT]),
        (unit(), 3, 3, None, True, 3 + 5 * MS, [SYNC_TIMEOUT, RPDO_TIMEOUT]),
        (unit(period_us=0), 3, 4, None, True, 4 + STALE_TORQUE_NS, [RPDO_TIMEOUT]),
        (unit(), 3, 4, 2, True, 4 + 2 * MS, [RPDO_TIMEOUT]),
        (unit(period_us=0), 3, 4, None, False, NEVER_NS, []),
        (unit(cycles=0), 3, 4, None, True, NEVER_NS, []),
        (unit(cycles=0), 3, 4, 2, True, 4 + 2 * MS, [RPDO_TIMEOUT]),
        (unit(), None, None, None, True, NEVER_NS, []),
    ],
)
def test_what_runs_out_first_does_so_when_foretold(watchdogs, sync_ns, command_ns, timer, torque, due_ns, codes):
    watchdogs.sync_ns, watchdogs.command_ns = sync_ns, command_ns
    rpdos = [] if timer is None else [deadline(timer, command_ns)]
    assert watchdogs.due_ns(rpdos, enabled=True, torque=torque) == due_ns
    assert watchdogs.expired(rpdos, due_ns - 1, enabled=True, torque=torque) == []
    assert watchdogs.expired(rpdos, due_ns, enabled=True, torque=torque) == codes
    assert watchdogs.expired(rpdos, due_ns, enabled=True, torque=torque) == []


def test_a_drive_that_is_not_enabled_watches_the_event_timers_alone():
    watchdogs = unit()
    watchdogs.sync_ns = watchdogs.command_ns = 3
    assert watchdogs.due_ns([], enabled=False, torque=False) == NEVER_NS
    rpdos = [deadline(2, 4)]
    assert watchdogs.due_ns(rpdos, enabled=False, torque=False) == 4 + 2 * MS
    assert watchdogs.expired(rpdos, 10 * MS, enabled=False, torque=False) == [RPDO_TIMEOUT]


def test_cleared_it_expects_nothing():
    watchdogs, rpdos = unit(), [deadline(2, 4)]
    watchdogs.sync_ns = watchdogs.command_ns = 3
    watchdogs.clear(rpdos)
    assert watchdogs.due_ns(rpdos, enabled=True, torque=True) == NEVER_NS
