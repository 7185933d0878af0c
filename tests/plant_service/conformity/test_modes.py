"""CiA 402-2, objects 0x6060, 0x6061 and 0x6502: modes of operation."""

from __future__ import annotations

import pytest

SUPPORTED, DISPLAY, MODE = "40 02 65 00 00 00 00 00", "40 61 60 00 00 00 00 00", "40 60 60 00 00 00 00 00"
UNSUPPORTED = {
    "profile position": "01",
    "velocity": "02",
    "profile velocity": "03",
    "profile torque": "04",
    "reserved 5": "05",
    "homing": "06",
    "interpolated position": "07",
    "cyclic synchronous velocity": "09",
    "cyclic synchronous torque with commutation angle": "0b",
    "reserved": "0c",
    "reserved 127": "7f",
    "manufacturer's -1": "ff",
    "manufacturer's -128": "80",
}


def test_supported_drive_modes(wire):
    assert wire.sdo(SUPPORTED) == "43 02 65 00 80 02 00 00"  # bit 7 mode 8, bit 9 mode 10


def test_no_mode_after_power_on(wire):
    assert wire.sdo(MODE) == "4f 60 60 00 00 00 00 00"
    assert wire.sdo(DISPLAY) == "4f 61 60 00 00 00 00 00"


@pytest.mark.parametrize("mode", ["08", "0a"])
@pytest.mark.parametrize("enabled", [False, True], ids=["disabled", "enabled"])
def test_supported_mode_by_sdo(wire, mode, enabled):
    if enabled:
        wire.enable(18 - int(mode, 16))
    wire.set(f"2f 60 60 00 {mode} 00 00 00")
    assert wire.sdo(DISPLAY) == f"4f 61 60 00 {mode} 00 00 00"
    assert wire.statusword() & 0x6F == (0x27 if enabled else 0x40)


@pytest.mark.parametrize("mode", UNSUPPORTED.values(), ids=list(UNSUPPORTED))
@pytest.mark.parametrize("enabled", [False, True], ids=["disabled", "enabled"])
def test_unsupported_mode_by_sdo_is_refused(wire, mode, enabled):
    before = "00"
    if enabled:
        wire.enable(8)
        before = "08"
    assert wire.sdo(f"2f 60 60 00 {mode} 00 00 00") == "80 60 60 00 30 00 09 06"
    assert wire.sdo(MODE) == f"4f 60 60 00 {before} 00 00 00"
    assert wire.sdo(DISPLAY) == f"4f 61 60 00 {before} 00 00 00"


@pytest.mark.parametrize("mode", UNSUPPORTED.values(), ids=list(UNSUPPORTED))
def test_unsupported_mode_by_pdo_is_ignored(wire, mode):
    """The standard has no answer to it but the display, which keeps the mode in effect."""
    wire.enable(8)
    wire.send("205 0f 00 08 64 00 00 00", "080")
    answers = wire.send(f"205 0f 00 {mode} 65 00 00 00", "080")
    assert answers == ["185 37 12 00 00 00 00 00 00"]
    assert wire.sdo(DISPLAY) == "4f 61 60 00 08 00 00 00"
    assert (wire.axis.motion, wire.axis.target) == ("position", 101)


def test_mode_0_changes_nothing(wire):
    wire.enable(10)
    wire.set("2f 60 60 00 00 00 00 00")
    assert wire.sdo(DISPLAY) == "4f 61 60 00 0a 00 00 00"
    wire.send("305 0f 00 00 05 00", "080")
    assert wire.sdo(DISPLAY) == "4f 61 60 00 0a 00 00 00"


def test_enabled_without_a_mode_the_axis_holds_whatever_it_is_told(wire):
    wire.axis.position = 5000.0
    wire.enable(0)
    for frame in ("205 0f 00 00 64 00 00 00", "305 0f 00 00 05 00"):
        answers = wire.send(frame, "080")
        assert answers[0].startswith("185 37 02 ")
        assert wire.axis.motion == "hold"


@pytest.mark.parametrize("word", ["06", "07"], ids=["Ready To Switch On", "Switched On"])
def test_mode_by_pdo_while_disabled(wire, word):
    wire.send("000 01 05", "205 06 00 08 00 00 00 00", "080")
    assert wire.sdo(DISPLAY) == "4f 61 60 00 08 00 00 00"
    wire.send(f"205 {word} 00 0a 00 00 00 00", "080")
    assert wire.sdo(DISPLAY) == "4f 61 60 00 0a 00 00 00"


def test_mode_and_its_first_target_in_one_pdo(wire):
    wire.enable(8)
    wire.send("205 0f 00 08 64 00 00 00", "080")
    assert wire.send("305 0f 00 0a 05 00", "080") == ["185 37 12 00 00 00 00 00 00", "285 0a 00 00"]
    assert (wire.axis.motion, wire.axis.target) == ("torque", 5)
    assert wire.send("205 0f 00 08 64 00 00 00", "080") == ["185 37 12 00 00 00 00 00 00", "285 08 00 00"]
    assert (wire.axis.motion, wire.axis.target) == ("position", 100)


def test_mode_alone_while_enabled_holds_until_a_target_of_that_mode_comes(wire):
    """How the axis moves between the modes is the maker's: no jump, whatever stale target is stored."""
    wire.enable(8)
    wire.send("205 0f 00 08 64 00 00 00", "080")
    wire.set("2b 71 60 00 90 01 00 00")  # stale target torque of 400 ‰
    wire.set("2f 60 60 00 0a 00 00 00")
    wire.sync()
    assert wire.axis.motion == "hold"
    wire.send("305 0f 00 0a 05 00", "080")
    assert (wire.axis.motion, wire.axis.target) == ("torque", 5)


def test_the_display_is_read_only(wire):
    assert wire.sdo("2f 61 60 00 08 00 00 00") == "80 61 60 00 02 00 01 06"
