"""CiA 301 section 7.2.7 and objects 0x1001, 0x1003, 0x1014; CiA 402-2 object 0x603F: always in step."""

from __future__ import annotations

import pytest

CODES = {
    0x1000: ("00 10", "01"),
    0x2310: ("10 23", "03"),
    0x3210: ("10 32", "05"),
    0x4310: ("10 43", "09"),
    0x5400: ("00 54", "01"),
    0x6320: ("20 63", "01"),
    0x7305: ("05 73", "21"),
    0x8110: ("10 81", "11"),
    0x8611: ("11 86", "21"),
    0xFF00: ("00 ff", "81"),
}
"""Error code → its bytes, error register: generic and the bit of the code's class (0x5xxx, 0x6xxx have none)."""
RESET = "085 00 00 00 00 00 00 00 00"


def objects(wire) -> tuple[str, str, str]:
    """0x603F, 0x1001 and the count of 0x1003."""
    return (
        wire.sdo("40 3f 60 00 00 00 00 00")[12:17],
        wire.sdo("40 01 10 00 00 00 00 00")[12:14],
        wire.sdo("40 03 10 00 00 00 00 00")[12:14],
    )


@pytest.mark.parametrize("code", CODES, ids=hex)
def test_frame_register_code_and_history(wire, code):
    wire.bench.device.fault(code)
    coded, register = CODES[code]
    assert wire.wait(1) == [f"085 {coded} {register} 00 00 00 00 00"]
    assert objects(wire) == (coded, register, "01")
    assert wire.sdo("40 03 10 01 00 00 00 00") == f"43 03 10 01 {coded} 00 00"


def test_an_error_is_reported_once(wire):
    wire.bench.device.fault(0x2310)
    wire.bench.device.fault(0x2310)
    assert wire.wait(50) == ["085 10 23 03 00 00 00 00 00"]


def test_two_errors_the_register_holds_both_and_the_code_the_last(wire):
    wire.bench.device.fault(0x2310)
    wire.bench.device.fault(0x7305)
    assert wire.wait(1) == ["085 10 23 03 00 00 00 00 00", "085 05 73 23 00 00 00 00 00"]
    assert objects(wire) == ("05 73", "23", "02")


def test_fault_reset_takes_them_back_with_one_message(wire):
    wire.bench.device.fault(0x2310)
    wire.bench.device.fault(0x7305)
    wire.wait(1)
    assert wire.send("605 2b 40 60 00 80 00 00 00") == ["585 60 40 60 00 00 00 00 00", RESET]
    assert objects(wire) == ("00 00", "00", "02")  # the history stays


def test_one_of_two_errors_goes_the_register_tells_what_is_left(wire):
    wire.set("23 16 10 01 1e 00 7f 00")
    wire.send("77f 05", "000 01 05")
    wire.wait(40)
    assert wire.send("080 01") == ["085 40 82 11 00 00 00 00 00"]
    assert wire.send("77f 05") == ["085 00 00 11 00 00 00 00 00"]
    assert objects(wire) == ("40 82", "11", "02")


class TestHistory:
    def test_newest_first_and_no_more_than_eight(self, wire):
        for low in range(10):
            wire.bench.device.fault(0x7300 + low)
        assert wire.sdo("40 03 10 00 00 00 00 00") == "4f 03 10 00 08 00 00 00"
        assert [wire.sdo(f"40 03 10 {sub:02x} 00 00 00 00")[12:] for sub in range(1, 9)] == [
            f"{low:02x} 73 00 00" for low in (9, 8, 7, 6, 5, 4, 3, 2)
        ]

    def test_writing_0_clears_it_and_nothing_else(self, wire):
        wire.bench.device.fault(0x2310)
        wire.set("2f 03 10 00 00 00 00 00")
        assert objects(wire) == ("10 23", "03", "00")
        assert wire.sdo("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"
        wire.bench.device.fault(0x7305)
        assert wire.sdo("40 03 10 01 00 00 00 00") == "43 03 10 01 05 73 00 00"
        assert wire.sdo("40 03 10 02 00 00 00 00") == "80 03 10 02 24 00 00 08"

    @pytest.mark.parametrize("value", ["01", "08", "ff"])
    def test_other_values_are_refused(self, wire, value):
        wire.bench.device.fault(0x2310)
        assert wire.sdo(f"2f 03 10 00 {value} 00 00 00") == "80 03 10 00 30 00 09 06"
        assert objects(wire)[2] == "01"

    def test_entries_are_read_only(self, wire):
        assert wire.sdo("23 03 10 01 00 00 00 00") == "80 03 10 01 02 00 01 06"

    def test_the_end_of_an_error_is_no_entry(self, wire):
        wire.bench.device.fault(0x2310)
        wire.control(0x80)
        assert objects(wire) == ("00 00", "00", "01")


class TestIdentifier:
    def test_default(self, wire):
        assert wire.sdo("40 14 10 00 00 00 00 00") == "43 14 10 00 85 00 00 00"

    def test_invalid_means_silent_yet_the_objects_tell(self, wire):
        wire.set("23 14 10 00 85 00 00 80")
        wire.bench.device.fault(0x2310)
        assert wire.wait(2) == []
        assert objects(wire) == ("10 23", "03", "01")

    def test_changed_while_invalid(self, wire):
        assert wire.sdo("23 14 10 00 86 00 00 00") == "80 14 10 00 30 00 09 06"
        wire.set("23 14 10 00 85 00 00 80", "23 14 10 00 86 00 00 00")
        wire.bench.device.fault(0x2310)
        assert wire.wait(1) == ["086 10 23 03 00 00 00 00 00"]

    @pytest.mark.parametrize("cob_id", ["00 00 00 00", "05 06 00 00", "85 00 00 20"], ids=["NMT", "SDO", "29 bit"])
    def test_refused(self, wire, cob_id):
        wire.set("23 14 10 00 85 00 00 80")
        assert wire.sdo(f"23 14 10 00 {cob_id}") == "80 14 10 00 30 00 09 06"


class TestResetCommunication:
    """A drive that stays in Fault keeps 0x603F and 0x1001, and the present errors in 0x1003, through NMT 82h."""

    def test_in_fault(self, wire):
        wire.bench.device.fault(0x2310)
        wire.bench.device.fault(0x7305)
        wire.wait(1)
        assert wire.send("000 82 05") == ["705 00"]
        assert wire.statusword() & 0x4F == 0x08
        assert objects(wire) == ("05 73", "23", "02")
        assert wire.sdo("40 03 10 01 00 00 00 00") == "43 03 10 01 05 73 00 00"
        assert wire.send("605 2b 40 60 00 80 00 00 00") == ["585 60 40 60 00 00 00 00 00", RESET]
        assert objects(wire) == ("00 00", "00", "02")

    def test_during_the_fault_reaction(self, wire):
        wire.enable()
        wire.move()
        wire.bench.device.fault(0x2310)
        wire.wait(1)
        wire.send("000 82 05")
        assert wire.statusword() & 0x4F == 0x0F
        assert objects(wire) == ("10 23", "03", "01")

    def test_without_fault_the_errors_of_the_communication_are_gone(self, wire):
        wire.send("000 01 05", "080 01")
        assert objects(wire) == ("40 82", "11", "01")
        assert wire.send("000 82 05") == ["705 00"]
        assert objects(wire) == ("00 00", "00", "00")

    def test_a_fault_by_the_reset_itself_is_told_after_the_boot_up_message(self, wire):
        wire.set("2b 07 60 00 01 00 00 00", "2b 5e 60 00 00 00 00 00")
        wire.enable()
        assert wire.send("000 82 05") == ["705 00", "085 00 81 11 00 00 00 00 00"]
        assert wire.statusword() & 0x4F == 0x08
        assert objects(wire) == ("00 81", "11", "01")


class TestRecovery:
    def test_rpdo_length(self, wire):
        wire.enable()
        assert wire.send("205 0f 00 08 64 00 00") == ["085 10 82 11 00 00 00 00 00"]
        assert wire.send("205 0f 00 08 64 00 00") == []
        assert RESET not in wire.sync()
        assert RESET not in wire.sync()
        wire.send("205 0f 00 08 64 00 00 00")
        wire.wait(1)  # a real bus takes its time
        assert wire.sync()[0] == RESET
        assert objects(wire) == ("00 00", "00", "01")
