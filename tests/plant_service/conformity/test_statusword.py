"""CiA 402-2, object 0x6041: every bit beside those of the state, in cyclic synchronous position and torque mode.

| bit | meaning | here |
|---|---|---|
| 4 | voltage enabled | always: the supply of the simulated drive does not fail |
| 5 | quick stop, active low | 1 but in Quick Stop Active (and in states that do not define it) |
| 7 | warning | the drive holds by itself because commands failed to come |
| 8, 14, 15 | manufacturer | 0 |
| 9 | remote | always: the controlword is obeyed in every NMT state that lets it through |
| 10 | target reached | the axis stands after halt, or after a quick stop that stays (0x605A 5 to 8); else reserved, 0 |
| 11 | internal limit active | the set-point is limited by 0x6072 or 0x607D, or the torque is at its limit |
| 12 | drive follows the command value | a set-point acts |
| 13 | following error (mode 8), reserved (mode 10) | from the following error on until the fault is reset |
"""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ((), 0x0250),
        ((0x06,), 0x0231),
        ((0x06, 0x07), 0x0233),
        ((0x06, 0x07, 0x0F), 0x0237),
        ((0x06, 0x07, 0x0F, 0x02), 0x0617),
    ],
    ids=["Switch On Disabled", "Ready To Switch On", "Switched On", "Operation Enabled", "Quick Stop Active"],
)
@pytest.mark.parametrize("mode", [8, 10])
@pytest.mark.parametrize("start", ["000 80 05", "000 01 05"], ids=["pre-operational", "operational"])
def test_the_whole_word_of_a_drive_at_rest(wire, words, status, mode, start):
    wire.send(start)
    wire.set(f"2f 60 60 00 {mode:02x} 00 00 00")
    wire.control(*words)
    assert wire.statusword() == status


def test_the_whole_word_in_fault(wire):
    wire.enable()
    wire.move()
    wire.bench.device.fault(0x2310)
    assert wire.statusword() == 0x021F
    wire.wait(200)
    assert wire.statusword() == 0x0218


@pytest.mark.parametrize(
    ("mode", "frame"), [(8, "205 0f 00 08 64 00 00 00"), (10, "305 0f 00 0a 05 00")], ids=["position", "torque"]
)
class TestDriveFollowsTheCommandValue:
    """Bit 12: 0 target ignored, 1 target is the input of the control loop."""

    def test_from_the_sync_that_latches_a_target(self, wire, mode, frame):
        wire.enable(mode)
        assert wire.sync()[0].startswith("185 37 02 ")
        assert wire.send(frame) == []
        assert wire.sync()[0].startswith("185 37 12 ")

    def test_a_target_sent_before_enabling_does_not_count(self, wire, mode, frame):
        wire.set("23 01 14 01 05 03 00 00")
        wire.send("000 01 05")
        wire.send(frame.replace("0f", "06", 1), "080")
        wire.send(frame.replace("0f", "07", 1), "080")
        wire.control(0x0F)
        assert wire.sync()[0].startswith("185 37 02 ")

    def test_not_in_another_mode_before_its_own_target_came(self, wire, mode, frame):
        wire.enable(mode)
        wire.send(frame, "080")
        wire.set(f"2f 60 60 00 {18 - mode:02x} 00 00 00")
        assert wire.sync()[0].startswith("185 37 02 ")

    def test_not_while_halted(self, wire, mode, frame):
        wire.enable(mode)
        wire.send(frame, "080")
        wire.move()
        assert wire.send(frame.replace("0f 00", "0f 01", 1), "080")[0].startswith("185 37 02 ")

    def test_not_in_quick_stop(self, wire, mode, frame):
        wire.enable(mode)
        wire.send(frame, "080")
        wire.move()
        assert wire.send(frame.replace("0f", "02", 1), "080")[0].startswith("185 17 02 ")


@pytest.mark.parametrize("mode", [8, 10], ids=["position", "torque"])
class TestTargetReached:
    """Bit 10 after halt and quick stop."""

    def test_halt(self, wire, mode):
        wire.enable(mode)
        wire.move()
        wire.control(0x010F)
        assert wire.statusword() == 0x0237
        wire.wait(200)
        assert wire.statusword() == 0x0637
        wire.control(0x000F)
        assert wire.statusword() == 0x0237

    def test_quick_stop_that_stays(self, wire, mode):
        wire.enable(mode)
        wire.move()
        wire.control(0x0002)
        assert wire.statusword() == 0x0217
        wire.wait(200)
        assert wire.statusword() == 0x0617
        wire.control(0x000F)
        assert wire.statusword() == 0x0237

    def test_halt_bit_of_a_drive_that_is_not_enabled(self, wire, mode):
        wire.control(0x0106, 0x0107)
        assert wire.statusword() == 0x0233


class TestInternalLimit:
    def test_target_torque_over_max_torque(self, wire):
        wire.set("2b 72 60 00 2c 01 00 00")  # 300 ‰
        wire.enable(10)
        assert wire.send("305 0f 00 0a 2c 01", "080")[0].startswith("185 37 12 ")
        assert wire.send("305 0f 00 0a 2d 01", "080")[0].startswith("185 37 1a ")
        assert wire.send("305 0f 00 0a d3 fe", "080")[0].startswith("185 37 1a ")  # −301 ‰
        assert wire.send("305 0f 00 0a d4 fe", "080")[0].startswith("185 37 12 ")  # −300 ‰

    def test_target_position_out_of_the_software_limits(self, wire):
        wire.set("23 7d 60 01 ce ff ff ff", "23 7d 60 02 32 00 00 00")  # −50 to 50 counts
        wire.enable(8)
        assert wire.send("205 0f 00 08 32 00 00 00", "080")[0].startswith("185 37 12 ")
        assert wire.send("205 0f 00 08 33 00 00 00", "080")[0].startswith("185 37 1a ")
        assert wire.send("205 0f 00 08 cd ff ff ff", "080")[0].startswith("185 37 1a ")


class TestFollowingError:
    """Bit 13. The standard leaves the reaction to the maker: here a fault, EMCY 0x8611, without 0x6066's delay."""

    def test_in_position_mode(self, wire):
        wire.set("23 65 60 00 f4 01 00 00")  # 500 counts
        wire.enable(8)
        assert wire.send("205 0f 00 08 0a 00 00 00", "080")[0].startswith("185 37 12 ")
        assert wire.send("205 0f 00 08 58 02 00 00", "080")[:2] == [
            "085 11 86 21 00 00 00 00 00",
            "185 1f 22 00 00 00 00 00 00",
        ]
        wire.wait(50)
        assert wire.statusword() == 0x2218
        wire.control(0x00, 0x80)
        assert wire.statusword() == 0x0250

    def test_torque_mode_has_none(self, wire):
        wire.set("23 65 60 00 01 00 00 00")
        wire.enable(10)
        wire.move()
        assert wire.send("305 0f 00 0a 05 00", "080", "305 0f 00 0a 05 00", "080")[-1].startswith("185 37 12 ")


def test_warning_while_the_drive_holds_by_itself(wire):
    wire.set("23 06 10 00 e8 03 00 00", "2b 04 20 00 05 00 00 00")  # SYNC every 1000 µs, watchdog of 5
    wire.enable(8)
    wire.send("205 0f 00 08 00 00 00 00", "080")
    wire.wait(5)
    assert wire.statusword() == 0x02B7
    wire.control(0x06)
    assert wire.statusword() == 0x0231
