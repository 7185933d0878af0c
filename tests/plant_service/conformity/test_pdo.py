"""CiA 301 sections 7.2.2 and 7.5.2.35 to 38: how PDOs are changed, sent and received."""

from __future__ import annotations

import pytest

OFF, ON = "23 00 18 01 85 01 00 c0", "23 00 18 01 85 01 00 40"
"""TPDO1 invalid (bit 31) and valid; bit 30: no RTR."""
EMPTY = "2f 00 1a 00 00 00 00 00"
COUNT = "2f 00 1a 00 {:02x} 00 00 00"
POSITION, TORQUE, STATUS, DISPLAY = "20 00 64 60", "10 00 77 60", "10 00 41 60", "08 00 61 60"
"""Mapping entries as they travel: 0x60640020, 0x60770010, 0x60410010, 0x60610008."""
LOCKED, NO_OBJECT, UNMAPPABLE, TOO_LONG = "22 00 00 08", "00 00 02 06", "41 00 04 06", "42 00 04 06"
INVALID = "30 00 09 06"


def remap(wire, *entries: str, kind: str = "01") -> None:
    wire.set(OFF, f"2f 00 18 02 {kind} 00 00 00", EMPTY)
    wire.set(*(f"23 00 1a {sub:02x} {entry}" for sub, entry in enumerate(entries, 1)))
    wire.set(COUNT.format(len(entries)), ON)


class TestDefaults:
    """The predefined connection set, as far as the drive has PDOs: two of each direction."""

    @pytest.mark.parametrize(
        ("request_", "answer"),
        [
            ("40 00 14 01", "43 00 14 01 05 02 00 00"),
            ("40 01 14 01", "43 01 14 01 05 03 00 80"),
            ("40 00 18 01", "43 00 18 01 85 01 00 40"),
            ("40 01 18 01", "43 01 18 01 85 02 00 40"),
            ("40 00 14 00", "4f 00 14 00 05 00 00 00"),
            ("40 00 18 00", "4f 00 18 00 06 00 00 00"),
            ("40 00 16 00", "4f 00 16 00 03 00 00 00"),
            ("40 00 16 01", "43 00 16 01 10 00 40 60"),
            ("40 00 16 02", "43 00 16 02 08 00 60 60"),
            ("40 00 16 03", "43 00 16 03 20 00 7a 60"),
            ("40 00 1a 00", "4f 00 1a 00 03 00 00 00"),
            ("40 00 1a 01", "43 00 1a 01 10 00 41 60"),
            ("40 02 18 01", "80 02 18 01 00 00 02 06"),
        ],
    )
    def test_record(self, wire, request_, answer):
        assert wire.sdo(f"{request_} 00 00 00 00") == answer


class TestRemapping:
    """Destroy, empty, map, count, create."""

    def test_in_the_order_of_the_standard(self, wire):
        remap(wire, TORQUE, POSITION, DISPLAY)
        wire.axis.position = 3.0
        wire.send("000 01 05")
        assert wire.sync()[0] == "185 00 00 03 00 00 00 00"

    def test_rpdo(self, wire):
        wire.set("23 00 14 01 05 02 00 80", "2f 00 16 00 00 00 00 00", "23 00 16 01 20 00 7a 60")
        wire.set("23 00 16 02 10 00 40 60", "2f 00 16 00 02 00 00 00", "23 00 14 01 05 02 00 00")
        wire.enable()
        wire.send("205 64 00 00 00 0f 00", "080")
        assert (wire.axis.motion, wire.axis.target) == ("position", 100)

    @pytest.mark.parametrize("request_", [EMPTY, COUNT.format(2), f"23 00 1a 01 {TORQUE}"])
    def test_not_while_the_pdo_is_valid(self, wire, request_):
        assert wire.sdo(request_) == f"80 {request_[3:11]} {LOCKED}"

    def test_not_while_the_count_is_not_0(self, wire):
        wire.set(OFF)
        assert wire.sdo(f"23 00 1a 01 {TORQUE}") == f"80 00 1a 01 {LOCKED}"

    @pytest.mark.parametrize(
        ("entry", "abort"),
        [
            ("10 00 00 30", NO_OBJECT),
            ("10 01 41 60", NO_OBJECT),
            ("10 00 17 10", UNMAPPABLE),
            ("10 00 40 60", UNMAPPABLE),
            ("10 00 64 60", UNMAPPABLE),
            ("08 00 41 60", UNMAPPABLE),
            ("00 00 64 60", UNMAPPABLE),
            ("08 00 05 00", NO_OBJECT),
        ],
        ids=[
            "no object",
            "no sub-index",
            "not mappable",
            "for RPDOs only",
            "16 of 32 bits",
            "8 of 16 bits",
            "0 bits",
            "dummy in a TPDO",
        ],
    )
    def test_entry_of_a_tpdo(self, wire, entry, abort):
        wire.set(OFF, EMPTY)
        assert wire.sdo(f"23 00 1a 01 {entry}") == f"80 00 1a 01 {abort}"

    @pytest.mark.parametrize(
        ("entry", "abort"),
        [("10 00 41 60", UNMAPPABLE), ("20 01 18 10", UNMAPPABLE), ("10 00 05 20", UNMAPPABLE)],
        ids=["read-only", "identity", "not mappable"],
    )
    def test_entry_of_an_rpdo(self, wire, entry, abort):
        wire.set("23 00 14 01 05 02 00 80", "2f 00 16 00 00 00 00 00")
        assert wire.sdo(f"23 00 16 01 {entry}") == f"80 00 16 01 {abort}"

    def test_more_than_8_bytes(self, wire):
        wire.set(OFF, EMPTY, *(f"23 00 1a {sub:02x} {POSITION}" for sub in (1, 2, 3)))
        assert wire.sdo(COUNT.format(3)) == f"80 00 1a 00 {TOO_LONG}"
        assert wire.sdo(COUNT.format(9)) == f"80 00 1a 00 {TOO_LONG}"
        wire.set(COUNT.format(2))

    def test_a_count_beyond_the_entries(self, wire):
        wire.set(OFF, EMPTY, f"23 00 1a 01 {POSITION}", "23 00 1a 02 00 00 00 00")
        assert wire.sdo(COUNT.format(2)) == f"80 00 1a 00 {NO_OBJECT}"

    def test_a_pdo_without_entries_is_not_sent(self, wire):
        wire.set(OFF, EMPTY, ON)
        wire.send("000 01 05")
        assert [frame[:3] for frame in wire.sync()] == ["285"]


class TestCobId:
    @pytest.mark.parametrize(
        "cob_id",
        ["86 01 00 40", "85 01 00 60", "00 00 00 40", "80 01 00 40", "85 05 00 40", "05 06 00 40", "05 07 00 40"],
        ids=["changed while valid", "29 bit", "NMT", "restricted 180h", "SDO 585h", "SDO 605h", "heartbeat"],
    )
    def test_refused(self, wire, cob_id):
        assert wire.sdo(f"23 00 18 01 {cob_id}") == f"80 00 18 01 {INVALID}"

    @pytest.mark.parametrize("cob_id", ["00 00 00 80", "86 01 00 c0"], ids=["identifier 0", "another identifier"])
    def test_made_invalid_with_any_identifier(self, wire, cob_id):
        """Read so: an identifier that is not used cannot be wrong, and may change as the PDO becomes invalid."""
        wire.set(f"23 00 18 01 {cob_id}")
        wire.send("000 01 05")
        assert [frame[:3] for frame in wire.sync()] == ["285"]

    def test_identifier_0_cannot_be_made_valid(self, wire):
        wire.set("23 00 18 01 00 00 00 80")
        assert wire.sdo("23 00 18 01 00 00 00 40") == f"80 00 18 01 {INVALID}"

    def test_changed_while_invalid(self, wire):
        wire.set(OFF, "23 00 18 01 a5 01 00 40")
        wire.send("000 01 05")
        assert wire.sync()[0] == "1a5 50 02 00 00 00 00 00 00"

    def test_rpdo_moved_to_another_identifier(self, wire):
        wire.set("23 00 14 01 05 02 00 80", "23 00 14 01 25 02 00 00")
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "080")
        assert wire.axis.motion == "hold"
        wire.send("225 0f 00 08 64 00 00 00", "080")
        assert wire.axis.motion == "position"

    def test_invalid_rpdo_is_not_received(self, wire):
        wire.enable()
        wire.set("23 00 14 01 05 02 00 80")
        wire.send("205 02 00 08 00 00 00 00", "080")
        assert wire.statusword() & 0x6F == 0x27


@pytest.mark.parametrize("record", ["00 14", "00 18"], ids=["RPDO", "TPDO"])
class TestTransmissionTypeValues:
    @pytest.mark.parametrize("kind", ["00", "01", "02", "f0", "fe", "ff"])
    def test_taken(self, wire, record, kind):
        wire.set(f"2f {record} 02 {kind} 00 00 00")
        assert wire.sdo(f"40 {record} 02 00 00 00 00") == f"4f {record} 02 {kind} 00 00 00"

    @pytest.mark.parametrize("kind", ["f1", "fb", "fc", "fd"], ids=["241", "251", "252 RTR", "253 RTR"])
    def test_reserved_and_remote_requests_are_refused(self, wire, record, kind):
        assert wire.sdo(f"2f {record} 02 {kind} 00 00 00") == f"80 {record} 02 {INVALID}"


class TestTransmission:
    def sent(self, wire, syncs: int) -> list[int]:
        """Numbers of the SYNCs that TPDO1 answered, from 1."""
        return [n for n in range(1, syncs + 1) if any(frame.startswith("185") for frame in wire.sync())]

    def test_type_0_after_a_sync_before_which_it_changed(self, wire):
        remap(wire, POSITION, kind="00")
        wire.send("000 01 05")
        assert self.sent(wire, 3) == [1]
        wire.axis.position = 1.0
        assert self.sent(wire, 3) == [1]

    def test_type_1_after_every_sync(self, wire):
        wire.send("000 01 05")
        assert self.sent(wire, 5) == [1, 2, 3, 4, 5]

    @pytest.mark.parametrize(
        ("kind", "expected"), [("02", [2, 4]), ("03", [3]), ("f0", [])], ids=["every 2nd", "every 3rd", "every 240th"]
    )
    def test_type_n(self, wire, kind, expected):
        remap(wire, POSITION, kind=kind)
        wire.send("000 01 05")
        assert self.sent(wire, 5) == expected

    def test_type_240(self, wire):
        remap(wire, POSITION, kind="f0")
        wire.send("000 01 05")
        assert self.sent(wire, 481) == [240, 480]

    def test_counting_begins_when_the_node_starts(self, wire):
        remap(wire, POSITION, kind="03")
        wire.send("000 01 05")
        assert self.sent(wire, 2) == []
        wire.send("000 80 05", "000 01 05")
        assert self.sent(wire, 3) == [3]

    @pytest.mark.parametrize("kind", ["fe", "ff"], ids=["254", "255"])
    class TestEventDriven:
        """While SYNCs come, events are noticed at them (maker's choice); else at the next tick."""

        def times(self, wire, ms: int) -> list[int]:
            return [t for t in range(1, ms + 1) if any(frame.startswith("185") for frame in wire.wait(1))]

        def test_once_at_the_start_then_on_change(self, wire, kind):
            remap(wire, POSITION, kind=kind)
            wire.send("000 01 05")
            assert self.times(wire, 10) == [1]
            wire.axis.position = 7.0
            assert self.times(wire, 10) == [1]

        def test_event_timer(self, wire, kind):
            wire.set("2b 00 18 05 14 00 00 00")  # 20 ms
            remap(wire, POSITION, kind=kind)
            wire.send("000 01 05")
            assert self.times(wire, 65) == [1, 21, 41, 61]

        def test_inhibit_time(self, wire, kind):
            wire.set(OFF, "2b 00 18 03 64 00 00 00")  # 10 ms
            remap(wire, POSITION, kind=kind)
            wire.send("000 01 05")
            times = []
            for t in range(1, 33):
                wire.axis.position = float(t)
                times += [t] if any(frame.startswith("185") for frame in wire.wait(1)) else []
            assert times == [1, 11, 21, 31]

        def test_with_sync(self, wire, kind):
            remap(wire, POSITION, kind=kind)
            wire.send("000 01 05")
            assert [frame[:3] for frame in wire.sync()] == ["185", "285"]
            assert wire.sync() == []

    def test_inhibit_time_is_locked_while_the_pdo_is_valid(self, wire):
        assert wire.sdo("2b 00 18 03 64 00 00 00") == f"80 00 18 03 {LOCKED}"

    def test_remote_requests_are_not_answered(self, wire):
        wire.send("000 01 05")
        assert wire.bench.send(0x4000_0185, b"") == []


class TestReception:
    @pytest.mark.parametrize("kind", ["00", "01", "f0"], ids=["0", "1", "240"])
    def test_synchronous_at_the_next_sync(self, wire, kind):
        wire.set(f"2f 00 14 02 {kind} 00 00 00")
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "205 0f 00 08 c8 00 00 00")
        assert wire.axis.motion == "hold"
        wire.sync()
        assert (wire.axis.motion, wire.axis.target) == ("position", 200)

    @pytest.mark.parametrize("kind", ["fe", "ff"], ids=["254", "255"])
    def test_event_driven_at_once(self, wire, kind):
        wire.set(f"2f 00 14 02 {kind} 00 00 00")
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00")
        assert (wire.axis.motion, wire.axis.target) == ("position", 100)

    @pytest.mark.parametrize("data", ["", "0f", "0f 00 08 64 00 00"], ids=["empty", "1 byte", "6 of 7 bytes"])
    def test_too_short_is_not_processed(self, wire, data):
        wire.enable()
        assert wire.send(f"205 {data}") == ["085 10 82 11 00 00 00 00 00"]
        wire.sync()
        assert wire.axis.motion == "hold"

    def test_too_long_the_mapped_bytes_are_used(self, wire):
        wire.enable()
        assert wire.send("205 0f 00 08 64 00 00 00 ff") == ["085 20 82 11 00 00 00 00 00"]
        wire.sync()
        assert (wire.axis.motion, wire.axis.target) == ("position", 100)

    def test_deadline_by_the_event_timer(self, wire):
        """From the first reception on; the watchdog of the maker, 0x2004, does not matter."""
        wire.set("2b 00 14 05 14 00 00 00", "2b 04 20 00 00 00 00 00")
        wire.enable()
        wire.sync()
        assert not any(frame.startswith("085") for frame in wire.wait(100))
        wire.send("205 0f 00 08 64 00 00 00", "080")
        assert wire.wait(19) == []
        assert wire.wait(1) == ["085 50 82 11 00 00 00 00 00"]
        assert wire.axis.motion == "hold"

    def test_deadline_of_a_drive_that_is_not_enabled(self, wire):
        wire.set("2b 00 14 05 14 00 00 00")
        wire.send("000 01 05", "205 00 00 08 00 00 00 00", "080")
        assert wire.wait(20) == ["085 50 82 11 00 00 00 00 00"]
        assert wire.send("205 00 00 08 00 00 00 00", "080")[0] == "085 00 00 00 00 00 00 00 00"

    def test_no_deadline_outside_operational(self, wire):
        wire.set("2b 00 14 05 14 00 00 00")
        wire.send("000 01 05", "205 00 00 08 00 00 00 00", "080", "000 80 05")
        assert wire.wait(100) == []
        wire.send("000 01 05")
        assert not any(frame.startswith("085") for frame in wire.wait(100))
