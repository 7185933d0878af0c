"""The wire: arbitration, non-preemption, bit times and mailboxes, against a schedule worked out frame by frame."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.profile.bits import frame_bits
from hal.profile.frames import CAN_EFF_FLAG, CAN_RTR_FLAG, pack
from plant_service.wire import QUEUE, Origin, Wire

EVER = 10**12
MBIT = 1_000_000
PERIOD_NS = 2_000_000


def drain(wire: Wire, last_start_ns: int = EVER) -> list[tuple[bytes, int]]:
    sent = []
    while (transmitted := wire.transmit(last_start_ns)) is not None:
        frame, _, _, end_ns = transmitted
        sent.append((frame, end_ns))
    return sent


def duration_ns(frame: bytes) -> int:
    return 1000 * frame_bits(frame)


def frames_of(wire: Wire) -> list[bytes]:
    return [frame for frame, _ in drain(wire)]


def statistics(wire: Wire):
    wire.end(0)
    message = wire.statistics.take("bus", 0, 0)
    assert message is not None
    return message, {each.can_id: each for each in message.frames}


def test_a_frame_takes_its_bits_at_the_bit_rate() -> None:
    frame = pack(0x181, bytes(range(8)))
    for bitrate in (MBIT, 500_000, 125_000):
        wire = Wire(bitrate, PERIOD_NS)
        wire.put(frame, 5000, Origin.NODE)
        assert drain(wire) == [(frame, 5000 + frame_bits(frame) * 1_000_000_000 // bitrate)]


def test_the_lowest_identifier_of_those_ready_goes_first_and_is_not_interrupted() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    high, low, urgent = pack(0x300, b"12345678"), pack(0x200, b"1"), pack(0x080, b"")
    wire.put(high, 0, Origin.NODE)
    wire.put(low, 1, Origin.NODE)
    wire.put(urgent, 2, Origin.OUTSIDE)
    first = duration_ns(high)
    assert drain(wire) == [
        (high, first),
        (urgent, first + duration_ns(urgent)),
        (low, first + duration_ns(urgent) + duration_ns(low)),
    ]


def test_nothing_starts_after_the_limit() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.put(pack(0x181, b"1"), 0, Origin.NODE)
    wire.put(pack(0x182, b"2"), 0, Origin.NODE)
    end = duration_ns(pack(0x181, b"1"))
    assert len(drain(wire, end - 1)) == 1
    assert drain(wire, end - 1) == []
    assert len(drain(wire, end)) == 1


def test_a_newer_frame_takes_the_place_of_an_older_one_that_waits() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.begin(0)
    blocker = pack(0x100, b"12345678")
    wire.put(blocker, 0, Origin.OUTSIDE)
    wire.put(pack(0x201, b"old"), 0, Origin.OUTSIDE)
    wire.put(pack(0x201, b"new"), 10, Origin.OUTSIDE)
    assert frames_of(wire) == [blocker, pack(0x201, b"new")]
    _, by_id = statistics(wire)
    assert (by_id[0x201].frames, by_id[0x201].replaced) == (1, 1)


def test_a_frame_on_the_bus_and_one_that_is_not_ready_are_not_replaced() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.put(pack(0x201, b"a"), 0, Origin.OUTSIDE)
    wire.put(pack(0x201, b"b"), 1, Origin.OUTSIDE)  # the first is on the bus by then
    wire.put(pack(0x201, b"c"), 10**9, Origin.OUTSIDE)
    assert frames_of(wire) == [pack(0x201, b"a"), pack(0x201, b"b"), pack(0x201, b"c")]


def test_two_senders_of_one_identifier_have_a_mailbox_each() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.put(pack(0x201, b"a"), 0, Origin.OUTSIDE)
    wire.put(pack(0x201, b"b"), 0, Origin.NODE)
    assert len(frames_of(wire)) == 2


@pytest.mark.parametrize("can_id", [0x000, 0x081, 0x581, 0x601])
def test_messages_queue_in_their_order(can_id: int) -> None:
    wire = Wire(MBIT, PERIOD_NS)
    frames = [pack(can_id, bytes([number])) for number in range(QUEUE)]
    for frame in frames:
        wire.put(frame, 0, Origin.OUTSIDE)
    assert frames_of(wire) == frames


def test_a_queue_has_an_end() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.begin(0)
    for number in range(3 * QUEUE):
        wire.put(pack(0x601, bytes([number])), 0, Origin.OUTSIDE)
    assert len(frames_of(wire)) == QUEUE
    assert statistics(wire)[1][0x601].replaced == 2 * QUEUE


def test_29_bit_and_remote_frames_contend_by_their_bits() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    data, remote = pack(0x123, b""), pack(0x123 | CAN_RTR_FLAG, b"")
    extended = pack(0x123 << 18 | CAN_EFF_FLAG, b"")
    above = pack(0x124, b"")
    for frame in (above, extended, remote, data):
        wire.put(frame, 0, Origin.OUTSIDE)
    assert frames_of(wire) == [data, remote, extended, above]


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x181, 0x182, 0x1C0, 0x201, 0x202, 0x281]), st.integers(0, 1500), st.binary(max_size=8)
        ),
        max_size=25,
    )
)
def test_schedule_is_that_of_a_bus_simulated_microsecond_by_microsecond(puts: list[tuple[int, int, bytes]]) -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.begin(0)
    for can_id, ready_us, data in puts:
        wire.put(pack(can_id, data), 1000 * ready_us, Origin.NODE)
    expected, replaced = simulate(puts)
    assert drain(wire) == expected
    if puts:
        message, _ = statistics(wire)
        assert sum(each.frames for each in message.frames) == len(expected)
        assert sum(each.replaced for each in message.frames) == replaced


def simulate(puts: list[tuple[int, int, bytes]]) -> tuple[list[tuple[bytes, int]], int]:
    mailboxes: dict[int, bytes] = {}
    sent, replaced, idle_us, now_us = [], 0, 0, 0
    while now_us <= 1500 or mailboxes:
        for can_id, ready_us, data in puts:
            if ready_us == now_us:
                replaced += can_id in mailboxes
                mailboxes[can_id] = pack(can_id, data)
        if mailboxes and now_us >= idle_us:
            frame = mailboxes.pop(min(mailboxes))
            idle_us = now_us + frame_bits(frame)
            sent.append((frame, 1000 * idle_us))
        now_us += 1
    return sent, replaced


def test_statistics_of_a_cycle() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    sync, report, command = pack(0x080, b""), pack(0x181, bytes(8)), pack(0x201, bytes(7))
    for begun in (0, 2_000_000):
        wire.begin(begun)
        wire.put(sync, begun, Origin.OUTSIDE)
        drain(wire)
        wire.put(report, wire.idle_ns, Origin.ANSWER)
        drain(wire)
        wire.put(command, begun + 1_000_000, Origin.OUTSIDE)
        drain(wire)
    message, by_id = statistics(wire)
    busy = sum(map(frame_bits, (sync, report, command)))
    assert message.cycles == 2
    assert message.load_mean == pytest.approx(busy / 2000)
    assert message.load_max == pytest.approx(busy / 2000)
    assert message.report_end_max_s == pytest.approx(1e-6 * (frame_bits(sync) + frame_bits(report)))
    assert message.command_end_max_s == pytest.approx(1e-3 + 1e-6 * frame_bits(command))
    assert {can_id: (each.frames, each.late) for can_id, each in by_id.items()} == {
        0x080: (2, 0),
        0x181: (2, 0),
        0x201: (2, 0),
    }


def test_a_frame_across_a_sync_counts_in_both_cycles_so_none_is_over_full() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    for begun in range(0, 5 * PERIOD_NS, PERIOD_NS):
        wire.begin(begun)
        for number in range(30):
            wire.put(pack(0x181 + number, bytes(range(8))), begun, Origin.NODE)
        drain(wire, begun + PERIOD_NS - 1)
    message, _ = statistics(wire)
    assert wire.idle_ns > 5 * PERIOD_NS
    assert message.load_max <= 1.0
    assert message.load_mean == pytest.approx(1.0, abs=0.03)


def test_a_last_cycle_that_went_on_without_sync_counts_its_whole_time() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.begin(0)
    for begun in range(0, 100 * PERIOD_NS, PERIOD_NS):
        wire.put(pack(0x701, b"\x05"), begun, Origin.NODE)
        drain(wire)
    wire.end(100 * PERIOD_NS)
    message = wire.statistics.take("bus", 0, 0)
    assert message is not None
    assert message.load_max == pytest.approx(frame_bits(pack(0x701, b"\x05")) / 2000)


def test_a_command_that_a_sync_overtook_is_late() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.begin(0)
    wire.put(pack(0x080, b""), 0, Origin.OUTSIDE)
    drain(wire)
    wire.put(pack(0x201, bytes(7)), 2_000_000, Origin.OUTSIDE)
    wire.begin(2_000_000)
    wire.put(pack(0x080, b""), 2_000_000, Origin.OUTSIDE)
    drain(wire)
    message, by_id = statistics(wire)
    assert by_id[0x201].late == 1
    assert by_id[0x080].late == 0
    assert message.command_end_max_s > 0.002


def test_a_bus_that_goes_down_forgets_what_waits() -> None:
    wire = Wire(MBIT, PERIOD_NS)
    wire.put(pack(0x181, b""), 0, Origin.NODE)
    wire.put(pack(0x182, b""), 10**9, Origin.NODE)
    assert wire.busy_ns is not None
    wire.clear()
    assert wire.busy_ns is None
    assert drain(wire) == []
