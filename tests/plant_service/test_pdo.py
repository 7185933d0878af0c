"""CiA 301 section 7.5.2.35-38: how a PDO may be changed, when it is sent, when it acts."""

from __future__ import annotations

import struct

import pytest

DISABLED = 0x8000_0000
POSITION_ENTRY, TORQUE_ENTRY, STATUS_ENTRY = 0x6064_0020, 0x6077_0010, 0x6041_0010


def remap(bench, entries: list[int], can_id: int = 0x185, kind: int = 1) -> None:
    assert bench.write(0x1800, 1, DISABLED | 0x185, 4) == 0
    assert bench.write(0x1800, 2, kind, 1) == 0
    assert bench.write(0x1A00, 0, 0, 1) == 0
    for subindex, entry in enumerate(entries, 1):
        assert bench.write(0x1A00, subindex, entry, 4) == 0
    assert bench.write(0x1A00, 0, len(entries), 1) == 0
    assert bench.write(0x1800, 1, can_id, 4) == 0


def test_default_answer_to_sync(bench):
    bench.send(0x000, b"\x01\x00")
    bench.axis.position = -2.0
    # statusword 0x0250: switch on disabled, voltage enabled, remote; position −2; torque 0; then mode 0, error 0
    assert bench.sync() == [(0x185, bytes.fromhex("5002feffffff0000")), (0x285, bytes.fromhex("000000"))]
    assert [can_id for can_id, _ in bench.sync()] == [0x185]  # type 0: nothing changed


def test_no_answer_unless_operational(bench):
    assert bench.sync() == []


def test_remapped(bench):
    remap(bench, [TORQUE_ENTRY, POSITION_ENTRY], can_id=0x1A5)
    bench.send(0x000, b"\x01\x05")
    bench.axis.position = 3.0
    assert bench.sync()[0] == (0x1A5, bytes.fromhex("000003000000"))


def test_mapping_of_a_valid_pdo_is_locked(bench):
    assert bench.write(0x1A00, 0, 0, 1) == 0x0800_0022
    assert bench.write(0x1A00, 1, POSITION_ENTRY, 4) == 0x0800_0022


def test_entries_are_locked_while_the_count_is_not_zero(bench):
    bench.write(0x1800, 1, DISABLED | 0x185, 4)
    assert bench.write(0x1A00, 1, POSITION_ENTRY, 4) == 0x0800_0022


@pytest.mark.parametrize(
    ("entry", "abort"),
    [
        (0x3000_0010, 0x0602_0000),
        (0x1017_0010, 0x0604_0041),
        (0x6040_0010, 0x0604_0041),
        (0x6064_0010, 0x0604_0041),
    ],
    ids=["no object", "not mappable", "only receivable", "wrong number of bits"],
)
def test_bad_entry(bench, entry, abort):
    bench.write(0x1800, 1, DISABLED | 0x185, 4)
    bench.write(0x1A00, 0, 0, 1)
    assert bench.write(0x1A00, 1, entry, 4) == abort


def test_more_than_64_bits(bench):
    bench.write(0x1800, 1, DISABLED | 0x185, 4)
    bench.write(0x1A00, 0, 0, 1)
    for subindex in (1, 2, 3):
        assert bench.write(0x1A00, subindex, POSITION_ENTRY, 4) == 0
    assert bench.write(0x1A00, 0, 3, 1) == 0x0604_0042
    assert bench.write(0x1A00, 0, 9, 1) == 0x0604_0042
    assert bench.write(0x1A00, 0, 2, 1) == 0


@pytest.mark.parametrize("cob_id", [0x186, 0x2000_0185, 0x605, 0x000], ids=["while valid", "29 bit", "SDO", "NMT"])
def test_refused_cob_id(bench, cob_id):
    assert bench.write(0x1800, 1, cob_id, 4) == 0x0609_0030


@pytest.mark.parametrize("kind", [241, 251, 252, 253])
def test_refused_transmission_type(bench, kind):
    assert bench.write(0x1800, 2, kind, 1) == 0x0609_0030


def test_every_third_sync(bench):
    remap(bench, [STATUS_ENTRY], kind=3)
    bench.send(0x000, b"\x01\x05")
    answers = [sum(can_id == 0x185 for can_id, _ in bench.sync()) for _ in range(6)]
    assert answers == [0, 0, 1, 0, 0, 1]


def test_event_driven_goes_out_with_the_sync_when_it_changed(bench):
    remap(bench, [POSITION_ENTRY], kind=255)
    bench.send(0x000, b"\x01\x05")
    assert (0x185, bytes(4)) in bench.sync()
    assert bench.sync() == []
    bench.axis.position = 1.0
    assert bench.sync() == [(0x185, b"\x01\0\0\0")]


def test_event_driven_without_sync_goes_out_by_itself(bench):
    remap(bench, [POSITION_ENTRY], kind=254)
    bench.send(0x000, b"\x01\x05")
    assert [sent for sent in bench.wait(1) if sent[0] == 0x185] == [(0x185, bytes(4))]
    assert [sent for sent in bench.wait(3) if sent[0] == 0x185] == []


def test_synchronous_rpdo_latches_at_the_sync(bench):
    bench.enable()
    bench.command_position(100)
    assert bench.axis.motion == "hold"
    bench.command_position(200)
    bench.sync()
    assert (bench.axis.motion, bench.axis.target) == ("position", 200)


def test_event_driven_rpdo_acts_at_once(bench):
    bench.enable()
    bench.write(0x1400, 2, 255, 1)
    bench.command_position(100)
    assert (bench.axis.motion, bench.axis.target) == ("position", 100)


@pytest.mark.parametrize(
    ("length", "emcy", "motion"),
    [(6, "1082110000000000", "hold"), (8, "2082110000000000", "position")],
    ids=["short: not processed", "long: its first bytes"],
)
def test_wrong_length(bench, length, emcy, motion):
    bench.enable()
    data = struct.pack("<Hbi", 0x0F, 8, 100).ljust(8, b"\0")[:length]
    assert bench.send(0x205, data) == [(0x085, bytes.fromhex(emcy))]
    bench.sync()
    assert bench.axis.motion == motion
    assert bench.read(0x1001) == 0x11
    bench.command_position(100)
    assert bench.sync()[0] == (0x085, bytes(8))


def test_disabled_rpdo_is_deaf(bench):
    bench.enable()
    bench.write(0x1400, 1, DISABLED | 0x205, 4)
    bench.command_position(100)
    bench.sync()
    assert bench.axis.motion == "hold"
