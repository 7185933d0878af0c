"""CiA 301 sections 7.2.8 (heartbeat), 7.2.5 (SYNC) and objects 0x1005, 0x1006, 0x1016, 0x1017, 0x1019, 0x1029."""

from __future__ import annotations

from itertools import pairwise

import pytest

LOST, GONE = "085 30 81 11 00 00 00 00 00", "085 00 00 00 00 00 00 00 00"
WATCH = "23 16 10 01 1e 00 7f 00"
"""0x1016:1: node 127, 30 ms."""
SYNC_EVERY_MS, NO_WATCHDOG = "23 06 10 00 e8 03 00 00", "2b 04 20 00 00 00 00 00"


class TestHeartbeatProducer:
    @pytest.mark.parametrize(
        ("command", "state"),
        [("01", "05"), ("02", "04"), ("80", "7f")],
        ids=["operational", "stopped", "pre-operational"],
    )
    def test_state_byte(self, wire, command, state):
        wire.set("2b 17 10 00 0a 00 00 00")
        wire.send(f"000 {command} 05")
        beats = [frame for frame in wire.wait(41) if frame.startswith("705")]
        assert beats == [f"705 {state}"] * 4

    def test_off_by_default_and_by_0(self, wire):
        assert wire.wait(50) == []
        wire.set("2b 17 10 00 0a 00 00 00")
        wire.wait(20)
        wire.set("2b 17 10 00 00 00 00 00")
        assert wire.wait(50) == []

    def test_a_state_change_keeps_the_beat(self, wire):
        wire.set("2b 17 10 00 0a 00 00 00")
        wire.wait(5)
        wire.send("000 02 05")
        times = [ms for ms in range(30) if "705 04" in wire.wait(1)]
        assert [later - earlier for earlier, later in pairwise(times)] == [10, 10]


class TestHeartbeatConsumer:
    def test_watches_from_the_first_heartbeat_on(self, wire):
        wire.set(WATCH)
        assert wire.wait(100) == []
        wire.send("77f 05")
        assert wire.wait(30) == []
        assert wire.wait(1) == [LOST]
        assert wire.wait(100) == []

    @pytest.mark.parametrize("state", ["05", "7f", "04"])
    def test_every_state_of_the_producer_keeps_it_alive(self, wire, state):
        wire.set(WATCH)
        for _ in range(5):
            assert wire.send(f"77f {state}") == []
            assert wire.wait(25) == []

    def test_recovery(self, wire):
        wire.set(WATCH)
        wire.send("77f 05")
        wire.wait(40)
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 30 81 00 00"
        assert wire.sdo("40 01 10 00 00 00 00 00") == "4f 01 10 00 11 00 00 00"
        assert wire.send("77f 05") == [GONE]
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 00 00 00 00"
        assert wire.sdo("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"
        assert wire.wait(40) == [LOST]

    @pytest.mark.parametrize(
        "entry", ["00 00 7f 00", "1e 00 00 00", "1e 00 80 00", "1e 00 ff 00"], ids=["0 ms", "node 0", "128", "255"]
    )
    def test_unused_entry(self, wire, entry):
        wire.set(f"23 16 10 01 {entry}")
        for node in ("77f", "700", "77f"):
            wire.send(f"{node} 05")
        assert wire.wait(100) == []

    def test_longest_time(self, wire):
        wire.set("23 16 10 01 ff ff 7f 00")
        wire.send("77f 05")
        assert wire.wait(65535) == []
        assert wire.wait(1) == [LOST]

    def test_another_node_is_not_heard(self, wire):
        wire.set(WATCH)
        wire.send("77f 05")
        wire.wait(20)
        wire.send("77e 05")
        assert wire.wait(11) == [LOST]

    def test_a_fault_by_6007_lasts_until_it_is_reset_and_so_does_its_code(self, wire):
        wire.set(WATCH, "2b 07 60 00 01 00 00 00")
        wire.enable()
        wire.send("77f 05")
        assert LOST in wire.wait(50)
        wire.control(0x00, 0x80)
        assert wire.statusword() & 0x4F == 0x08  # the cause is still there
        assert wire.send("77f 05") == []
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 30 81 00 00"
        wire.control(0x00)
        assert wire.send("605 2b 40 60 00 80 00 00 00") == ["585 60 40 60 00 00 00 00 00", GONE]
        assert wire.statusword() & 0x4F == 0x40


@pytest.mark.parametrize(
    ("behaviour", "operational", "pre_operational"),
    [("00", "7f", "7f"), ("01", "05", "7f"), ("02", "04", "04")],
    ids=["to pre-operational if operational", "no change", "to stopped"],
)
class TestErrorBehaviour:
    """0x1029:1. The standard's default is 0; here it is 1, so that the drive goes on reporting while it holds."""

    def state(self, wire) -> str:
        wire.set("2b 17 10 00 0a 00 00 00")
        return next(frame[4:] for frame in wire.wait(30) if frame.startswith("705"))

    @pytest.mark.parametrize("start", ["01", "80"], ids=["operational", "pre-operational"])
    def test_state_after_a_lost_heartbeat(self, wire, behaviour, operational, pre_operational, start):
        wire.set(f"2f 29 10 01 {behaviour} 00 00 00", WATCH, "2b 17 10 00 0a 00 00 00")
        wire.send(f"000 {start} 05", "77f 05")
        heard = wire.wait(60)
        assert LOST in heard  # said before the node falls silent
        assert [frame for frame in heard if frame.startswith("705")][-1] == (
            f"705 {operational if start == '01' else pre_operational}"
        )


def test_error_behaviour_values(wire):
    assert wire.sdo("40 29 10 00 00 00 00 00") == "4f 29 10 00 01 00 00 00"
    assert wire.sdo("40 29 10 01 00 00 00 00") == "4f 29 10 01 01 00 00 00"
    assert wire.sdo("2f 29 10 01 03 00 00 00") == "80 29 10 01 31 00 09 06"


class TestSync:
    def test_the_identifier_can_be_changed(self, wire):
        wire.set("23 05 10 00 81 00 00 00")
        wire.send("000 01 05")
        assert wire.send("080") == []
        assert [frame[:3] for frame in wire.send("081")] == ["185", "285"]

    @pytest.mark.parametrize(
        "cob_id",
        ["80 00 00 40", "80 00 00 20", "00 00 00 00", "05 06 00 00", "7f 07 00 00"],
        ids=["producer", "29 bit", "NMT", "SDO", "heartbeat"],
    )
    def test_refused_identifier(self, wire, cob_id):
        assert wire.sdo(f"23 05 10 00 {cob_id}") == "80 05 10 00 30 00 09 06"

    def test_lost_sync_is_reported_and_the_axis_held(self, wire):
        """The standard asks for no reaction; the maker's watchdog 0x2004 counts periods of 0x1006. EMCY 0x8100."""
        wire.set(SYNC_EVERY_MS)
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "080")
        for _ in range(4):
            wire.send("205 0f 00 08 64 00 00 00")
            assert wire.wait(1) == []
        wire.send("205 0f 00 08 64 00 00 00")
        assert wire.wait(1)[0] == "085 00 81 11 00 00 00 00 00"
        assert wire.axis.motion == "hold"
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 00 81 00 00"

    def test_it_recovers_by_a_fresh_start(self, wire):
        wire.set(SYNC_EVERY_MS)
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "080")
        wire.wait(20)
        for word in ("06", "07", "0f"):
            heard = wire.send(f"205 {word} 00 08 64 00 00 00", "080")
        assert GONE in heard
        wire.send("205 0f 00 08 64 00 00 00", "080")
        assert (wire.axis.motion, wire.axis.target) == ("position", 100)

    def test_without_a_period_no_sync_is_missed(self, wire):
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "080")
        assert wire.wait(500) == []


class TestSyncCounter:
    """0x1019, and sub 6 of the TPDOs: the SYNC start value."""

    @pytest.mark.parametrize(
        ("value", "abort"),
        [("01", "30 00 09 06"), ("f1", "31 00 09 06"), ("ff", "31 00 09 06")],
        ids=["1 is reserved", "241", "255"],
    )
    def test_refused_value(self, wire, value, abort):
        assert wire.sdo(f"2f 19 10 00 {value} 00 00 00") == f"80 19 10 00 {abort}"

    def test_locked_while_there_is_a_period(self, wire):
        wire.set(SYNC_EVERY_MS)
        assert wire.sdo("2f 19 10 00 0a 00 00 00") == "80 19 10 00 22 00 00 08"

    def test_start_value_is_locked_while_the_pdo_is_valid(self, wire):
        assert wire.sdo("2f 00 18 06 03 00 00 00") == "80 00 18 06 22 00 00 08"

    @pytest.mark.parametrize("state", ["80", "01"], ids=["pre-operational", "operational"])
    @pytest.mark.parametrize(("overflow", "sync"), [("00", "080 01"), ("0a", "080"), ("0a", "080 01 00")])
    def test_wrong_length(self, wire, overflow, sync, state):
        wire.set(f"2f 19 10 00 {overflow} 00 00 00")
        wire.send(f"000 {state} 05")
        assert wire.send(sync) == ["085 40 82 11 00 00 00 00 00"]
        assert wire.send(sync) == []

    def test_wrong_length_in_stopped_is_no_error(self, wire):
        wire.send("000 02 05", "080 01", "000 80 05")
        assert wire.sdo("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"

    def start_at_3(self, wire, kind: str) -> None:
        wire.set(
            "2f 19 10 00 04 00 00 00",  # counts 1 2 3 4 1 2 …
            "23 00 18 01 85 01 00 c0",
            f"2f 00 18 02 {kind} 00 00 00",
            "2f 00 18 06 03 00 00 00",
            "23 00 18 01 85 01 00 40",
        )
        wire.send("000 01 05")

    def answered(self, wire, counters: list[int]) -> list[int]:
        heard = [(counter, wire.send(f"080 {counter:02x}")) for counter in counters]
        return [counter for counter, frames in heard if any(frame.startswith("185") for frame in frames)]

    def test_the_sync_with_the_start_value_is_the_first(self, wire):
        self.start_at_3(wire, "01")
        assert self.answered(wire, [1, 2, 3, 4, 1, 2]) == [3, 4, 1, 2]

    def test_every_second_sync_from_the_start_value_on(self, wire):
        """The SYNC with the start value counts as the first of two."""
        self.start_at_3(wire, "02")
        assert self.answered(wire, [2, 3, 4, 1, 2, 3, 4]) == [4, 2, 4]

    def test_it_waits_again_after_every_start_of_the_node(self, wire):
        self.start_at_3(wire, "01")
        assert self.answered(wire, [3]) == [3]
        wire.send("000 80 05", "000 01 05")
        assert self.answered(wire, [4, 1, 2, 3]) == [3]

    def test_without_a_counter_the_start_value_means_nothing(self, wire):
        self.start_at_3(wire, "01")
        wire.set("2f 19 10 00 00 00 00 00")
        assert any(frame.startswith("185") for frame in wire.sync())

    def test_rpdos_act_at_the_counted_sync(self, wire):
        wire.set("2f 19 10 00 04 00 00 00")
        wire.enable()
        wire.send("205 0f 00 08 64 00 00 00", "080 01")
        assert (wire.axis.motion, wire.axis.target) == ("position", 100)


@pytest.mark.parametrize("index", ["0c", "0d"])
def test_node_guarding_is_left_out(wire, index):
    assert wire.sdo(f"40 {index} 10 00 00 00 00 00") == f"80 {index} 10 00 00 00 02 06"
