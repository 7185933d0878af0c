"""CiA 402-2, option codes 0x605A to 0x605E and 0x6007. The ramps end when the axis stands.

The simulated drive has one way of stopping, within its torque limit; ramps and "current limit" are all this one, and
stopping at the voltage limit is refused. Two defaults differ from the standard's on purpose: 0x605A is 6 instead of 2
and 0x6007 is 0 instead of 1, because a loaded joint is better held than left to its brake.
"""

from __future__ import annotations

import pytest

DEFAULTS = {"5a": 6, "5b": 0, "5c": 1, "5d": 1, "5e": 2, "07": 0}
SUPPORTED = {
    "5a": (0, 1, 2, 3, 5, 6, 7),
    "5b": (0, 1),
    "5c": (0, 1),
    "5d": (1, 2, 3),
    "5e": (0, 1, 2, 3),
    "07": (0, 1, 2, 3),
}
"""Low byte of 0x60xx → values."""
REFUSED = {"5a": (4, 8, 9, -1), "5b": (2, -1), "5c": (2, -1), "5d": (0, 4, 5, -1), "5e": (4, 5, -1), "07": (4, -1)}


def i16(value: int) -> str:
    return {-1: "ff ff"}.get(value, f"{value:02x} 00")


@pytest.mark.parametrize("low", SUPPORTED)
def test_default_and_supported_values(wire, low):
    assert wire.sdo(f"40 {low} 60 00 00 00 00 00") == f"4b {low} 60 00 {i16(DEFAULTS[low])} 00 00"
    for value in SUPPORTED[low]:
        wire.set(f"2b {low} 60 00 {i16(value)} 00 00")
        assert wire.sdo(f"40 {low} 60 00 00 00 00 00") == f"4b {low} 60 00 {i16(value)} 00 00"


@pytest.mark.parametrize(("low", "value"), [(low, value) for low, values in REFUSED.items() for value in values])
def test_other_values_are_refused(wire, low, value):
    assert wire.sdo(f"2b {low} 60 00 {i16(value)} 00 00") == f"80 {low} 60 00 30 00 09 06"
    assert wire.sdo(f"40 {low} 60 00 00 00 00 00") == f"4b {low} 60 00 {i16(DEFAULTS[low])} 00 00"


@pytest.mark.parametrize(
    ("option", "during", "after"),
    [
        (0, 0x0250, 0x0250),
        (1, 0x0217, 0x0250),
        (2, 0x0217, 0x0250),
        (3, 0x0217, 0x0250),
        (5, 0x0217, 0x0617),
        (6, 0x0217, 0x0617),
        (7, 0x0217, 0x0617),
    ],
)
class TestQuickStop:
    """0x605A: 0 drive function off; 1, 2, 3 stop, then transition 12; 5, 6, 7 stop and stay in Quick Stop Active."""

    def test_from_motion_to_rest(self, wire, option, during, after):
        wire.set(f"2b 5a 60 00 {option:02x} 00 00 00")
        wire.enable()
        wire.move()
        wire.control(0x02)
        assert wire.statusword() == during
        assert wire.axis.motion == ("hold" if option else "off")
        wire.wait(200)
        assert wire.statusword() == after
        assert wire.axis.motion == ("hold" if option >= 5 else "off")

    def test_transition_16_exists_only_where_the_drive_stays(self, wire, option, during, after):
        wire.set(f"2b 5a 60 00 {option:02x} 00 00 00")
        wire.enable()
        wire.move()
        wire.control(0x02, 0x0F)
        assert wire.statusword() == (0x0237 if option >= 5 else during)

    def test_transition_12_ends_it_at_once(self, wire, option, during, after):
        wire.set(f"2b 5a 60 00 {option:02x} 00 00 00")
        wire.enable()
        wire.move()
        wire.control(0x02, 0x00)
        assert wire.statusword() == 0x0250
        assert wire.axis.motion == "off"


@pytest.mark.parametrize(
    ("low", "word", "after"), [("5b", 0x06, 0x0231), ("5c", 0x07, 0x0233)], ids=["shutdown", "disable operation"]
)
class TestShutdownAndDisableOperation:
    """0x605B for transition 8, 0x605C for transition 5: 0 drive function off, 1 slow down first."""

    def test_drive_function_off(self, wire, low, word, after):
        wire.set(f"2b {low} 60 00 00 00 00 00")
        wire.enable()
        wire.move()
        wire.control(word)
        assert wire.statusword() == after
        assert wire.axis.motion == "off"

    def test_slow_down(self, wire, low, word, after):
        wire.set(f"2b {low} 60 00 01 00 00 00")
        wire.enable()
        wire.move()
        wire.control(word)
        assert wire.statusword() == 0x0237
        assert wire.axis.motion == "hold"
        wire.wait(200)
        assert wire.statusword() == after
        assert wire.axis.motion == "off"

    def test_disable_voltage_ends_the_ramp(self, wire, low, word, after):
        wire.set(f"2b {low} 60 00 01 00 00 00")
        wire.enable()
        wire.move()
        wire.control(word, 0x00)
        assert wire.statusword() == 0x0250
        assert wire.axis.motion == "off"


@pytest.mark.parametrize("option", [1, 2, 3])
@pytest.mark.parametrize(
    ("mode", "run", "halt"),
    [
        (8, "205 0f 00 08 64 00 00 00", "205 0f 01 08 65 00 00 00"),
        (10, "305 0f 00 0a 05 00", "305 0f 01 0a 06 00"),
    ],
    ids=["position", "torque"],
)
def test_halt(wire, option, mode, run, halt):
    """0x605D: stop and stay in Operation Enabled. That halt works in modes 8 and 10 too is the maker's choice."""
    wire.set(f"2b 5d 60 00 {option:02x} 00 00 00", "2b 04 20 00 00 00 00 00")  # the maker's watchdog is off
    wire.enable(mode)
    wire.send(run, "080")
    wire.move()
    assert wire.send(halt, "080")[0].startswith("185 37 02 ")
    assert wire.axis.motion == "hold"
    wire.wait(300)
    assert wire.axis.velocity == pytest.approx(0.0, abs=1.0)
    assert wire.statusword() == 0x0637
    assert wire.send(run, "080")[0].startswith("185 37 12 ")
    assert wire.axis.motion == ("position" if mode == 8 else "torque")


def test_enabled_with_the_halt_bit_set(wire):
    wire.send("000 01 05")
    wire.set("2f 60 60 00 08 00 00 00")
    wire.control(0x106, 0x107, 0x10F)
    assert wire.send("205 0f 01 08 64 00 00 00", "080")[0].startswith("185 37 06 ")
    assert wire.axis.motion == "hold"


@pytest.mark.parametrize(("option", "during"), [(0, 0x0218), (1, 0x021F), (2, 0x021F), (3, 0x021F)])
def test_fault_reaction(wire, option, during):
    """0x605E: 0 drive function off, 1, 2, 3 stop first."""
    wire.set(f"2b 5e 60 00 {option:02x} 00 00 00")
    wire.enable()
    wire.move()
    wire.bench.device.fault(0x7320)
    assert wire.statusword() == during
    assert wire.axis.motion == ("hold" if option else "off")
    wire.wait(200)
    assert wire.statusword() == 0x0218
    assert wire.axis.motion == "off"


NMT_EVENTS = {"stopped": "000 02 05", "pre-operational": "000 80 05", "reset communication": "000 82 05"}
ABORTED = {0: (0x0237, "hold"), 1: (0x0218, "off"), 2: (0x0250, "off"), 3: (0x0617, "hold")}
"""0x6007 → statusword and axis once all is at rest: no action, fault, disable voltage, quick stop (which stays)."""


class TestAbortConnection:
    """0x6007. That entering PRE-OPERATIONAL is one of its events is the maker's reading; STOPPED is in the list."""

    @pytest.mark.parametrize("event", NMT_EVENTS)
    @pytest.mark.parametrize("option", ABORTED)
    def test_nmt(self, wire, option, event):
        status, motion = ABORTED[option]
        wire.set(f"2b 07 60 00 {option:02x} 00 00 00")
        wire.enable()
        wire.send("205 0f 00 08 00 00 00 00", "080")
        wire.send(NMT_EVENTS[event])
        wire.wait(200)
        wire.send("000 80 05")
        assert wire.statusword() & ~0x80 == status
        assert wire.axis.motion == motion

    @pytest.mark.parametrize("option", ABORTED)
    def test_heartbeat(self, wire, option):
        status, motion = ABORTED[option]
        wire.set(f"2b 07 60 00 {option:02x} 00 00 00", "23 16 10 01 1e 00 7f 00")  # node 127, 30 ms
        wire.enable()
        wire.send("205 0f 00 08 00 00 00 00", "080", "77f 05")
        wire.wait(200)
        assert wire.statusword() & ~0x80 == status
        assert wire.axis.motion == motion

    def test_no_action_with_the_makers_watchdog_off_is_no_action(self, wire):
        wire.set("2b 04 20 00 00 00 00 00", "23 16 10 01 1e 00 7f 00")
        wire.enable(10)
        wire.send("305 0f 00 0a 05 00", "080", "77f 05")
        assert wire.wait(200)[0] == "085 30 81 11 00 00 00 00 00"
        assert wire.axis.motion == "torque"

    def test_a_drive_without_power_is_left_alone(self, wire):
        wire.set("2b 07 60 00 03 00 00 00", "23 16 10 01 1e 00 7f 00")
        wire.control(0x06, 0x07)
        wire.send("77f 05")
        wire.wait(50)
        assert wire.statusword() == 0x0233
