"""A bus's trouble from its onset to its end."""

from __future__ import annotations

import pytest

from hal.bus.error_frames import ErrorReport, Trouble, decode_error
from hal.bus_watch import BusState, BusWatch
from hal.profile.frames import pack

PATIENCE = 5


def watch() -> BusWatch:
    return BusWatch("left", PATIENCE)


def reports(*troubles: Trouble) -> list[ErrorReport]:
    return [ErrorReport(troubles)] if troubles else []


def kinds(bus: BusWatch, *troubles: Trouble, heard: bool = True, down: str | None = None) -> list[tuple[str, bool]]:
    return [(notice.kind, notice.stops) for notice in bus.review(reports(*troubles), heard, down)]


@pytest.mark.parametrize(
    ("trouble", "kind", "state"),
    [
        (Trouble.BUS_OFF, "bus_off", BusState.OFF),
        (Trouble.ERROR_PASSIVE, "bus_error_passive", BusState.PASSIVE),
    ],
)
@pytest.mark.parametrize("again", [Trouble.RESTARTED, Trouble.ERROR_ACTIVE, Trouble.ERROR_WARNING])
def test_a_controllers_trouble_stops_once_and_ends_by_its_word(
    trouble: Trouble, kind: str, state: BusState, again: Trouble
) -> None:
    bus = watch()
    assert kinds(bus, trouble) == [(kind, True)]
    assert kinds(bus, trouble) == []
    assert (bus.state, bus.troubled) == (state, True)
    assert bus.silent == (state is BusState.OFF)
    kinds(bus, again)
    assert bus.state is BusState.ACTIVE
    assert bus.troubled, "its drives have not reported yet"
    assert bus.recovered().kind == "bus_recovered"
    assert not bus.troubled
    assert kinds(bus, trouble) == [(kind, True)], "the next onset is told again"


def test_one_counter_past_its_warning_does_not_make_up_for_the_other_past_the_passive_level() -> None:
    bus = watch()
    report = decode_error(pack(0x20000004, bytes.fromhex("0024000000000000")))  # transmit passive, receive warning
    assert next(notice.kind for notice in bus.review([report], True, None)) == "bus_error_passive"
    assert bus.state is BusState.PASSIVE


@pytest.mark.parametrize("trouble", [Trouble.BUS_OFF, Trouble.ERROR_PASSIVE])
def test_frames_without_errors_end_a_trouble_as_well(trouble: Trouble) -> None:
    bus = watch()
    kinds(bus, trouble)
    for _ in range(3 * PATIENCE):
        kinds(bus, heard=False)
    for _ in range(PATIENCE - 1):
        kinds(bus)
    kinds(bus, Trouble.BUS_ERROR)
    for _ in range(PATIENCE - 1):
        kinds(bus)
        assert bus.state is not BusState.ACTIVE
    kinds(bus)
    assert bus.state is BusState.ACTIVE
    assert bus.recovering


def test_an_interface_is_down_until_it_is_up() -> None:
    bus = watch()
    assert kinds(bus, down="bus left: interface can0 is down") == [("bus_down", True)]
    for _ in range(3 * PATIENCE):
        assert kinds(bus, heard=False, down="bus left: interface can0 is down") == []
        assert bus.silent
    assert kinds(bus, heard=False) == []
    assert (bus.state, bus.recovering, bus.silent) == (BusState.ACTIVE, True, False)


def test_the_worse_trouble_is_told() -> None:
    bus = watch()
    assert kinds(bus, Trouble.ERROR_PASSIVE) == [("bus_error_passive", True)]
    assert kinds(bus, Trouble.BUS_OFF) == [("bus_off", True)]
    assert kinds(bus, Trouble.ERROR_PASSIVE) == []
    assert kinds(bus, down="gone") == [("bus_down", True)]
    assert bus.state is BusState.DOWN
    kinds(bus, Trouble.RESTARTED, down="gone")
    assert bus.state is BusState.DOWN


def test_warnings_do_not_stop_and_are_told_once_an_onset() -> None:
    bus = watch()
    assert kinds(bus, Trouble.ERROR_WARNING) == [("bus_warning", False)]
    assert kinds(bus, Trouble.ERROR_WARNING) == []
    assert kinds(bus, Trouble.NO_ACKNOWLEDGE) == [("bus_warning", False)]
    assert kinds(bus, Trouble.RECEIVE_OVERFLOW) == [("frames_dropped", False)]
    for _ in range(PATIENCE):
        assert kinds(bus) == []
    assert kinds(bus, Trouble.ERROR_WARNING) == [("bus_warning", False)]
    assert not bus.troubled


def test_lost_arbitration_is_no_fault() -> None:
    bus = watch()
    kinds(bus, Trouble.ERROR_PASSIVE)
    for _ in range(PATIENCE):
        assert kinds(bus, Trouble.LOST_ARBITRATION) == []
    assert bus.state is BusState.ACTIVE
