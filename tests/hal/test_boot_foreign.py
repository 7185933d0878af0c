"""Drives of other makers with all their habits: booted, enabled and moved by the HAL, or refused with the reason."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from hal.boot import boot_network
from hal.errors import BootError
from hal.profile.frames import pack
from tests.hal.foreign_device import ENABLED, FAULT, ForeignSlave
from tests.hal.foreign_objects import GENERAL, NO_OBJECT, READ_ONLY, UNSUPPORTED, VALUE, Habits, Item, lely_like
from tests.hal.foreign_robot import NODES, Wire, boot, foreign_robot, wire

LELY = {"vendor_id": 0x360, "product_code": 1}
USUAL = Habits()
NOT_0_OR_1 = frozenset(range(2, 241)) | {254, 255}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short patience: nothing here is slow but what is told to be."""
    monkeypatch.setattr("hal.enable.PATIENCE_S", 0.01)
    monkeypatch.setattr("hal.enable.FAULT_PATIENCE_S", 0.1)
    monkeypatch.setattr("hal.enable.FAULT_RESET_S", 0.01)
    monkeypatch.setattr("hal.boot.HEARTBEAT_WAIT_S", 1.0)
    monkeypatch.setattr("hal.find.ASK_S", 0.1)


def assert_off(bus: Wire) -> None:
    assert not any(slave.power == ENABLED for slave in bus.slaves)


@pytest.mark.parametrize("kind", ["position_pd", "servo"])
def test_other_kinds_are_moved(kind: str) -> None:
    bus = wire(lely_like(lacks=frozenset({0x1006, 0x60C2}), supported_modes=0x80))
    boot(bus, kind, **LELY)
    assert bus.slaves[0].power == ENABLED
    assert bus.slaves[0].objects[0x1600, 0] == 3


@pytest.mark.parametrize(
    "habits",
    [
        Habits(obeys="sync"),
        Habits(obeys="pdo"),
        Habits(mode_when="enabled"),
        Habits(mode_when="sync"),
        Habits(lag=5),
        Habits(power=0x00, obeys="pdo"),
        Habits(power=0x07),
        Habits(faults=1),
        Habits(faults=3, lag=3),
        Habits(types=NOT_0_OR_1 | {1}),
        Habits(reset_s=0.3),
        Habits(answer_s=0.005),
        Habits(boots=False),
        Habits(pdo_records=2),
        Habits(objects={(0x1005, 0): Item(4, 0x40000080), (0x1007, 0): Item(4, 1000), (0x1014, 0): Item(4, 1 << 31)}),
        Habits(objects={(0x6076, 0): Item(4, 500, "ro"), (0x6007, 0): Item(2, 1, "ro", signed=True)}),
        Habits(refused={(0x6007, 0): VALUE, (0x1006, 0): GENERAL}),
        Habits(objects={(0x1016, number): Item(4) for number in range(1, 9)}),
    ],
    ids=lambda habits: ", ".join(
        field for field in Habits.__slots__ if getattr(habits, field) != getattr(USUAL, field)
    ),
)
def test_habits_that_do_no_harm(habits: Habits) -> None:
    bus = wire(habits, Habits())
    report = boot(bus, timeout_s=5.0 if habits.boots else 1.0)
    assert [slave.power for slave in bus.slaves] == [ENABLED, ENABLED]
    assert [drive.mode for drive in report.drives] == [8, 8]
    slave = bus.slaves[0]
    assert slave.objects[0x1800, 1] & 0x800007FF == 0x181
    assert slave.objects.pdo(0x1400) == (0x201, 1, [(0x6040, 0), (0x6060, 0), (0x607A, 0)])
    assert slave.objects[0x1005, 0] == 0x80
    assert slave.objects.items.get((0x1007, 0), Item(4)).value == 0
    assert slave.objects.items.get((0x1014, 0), Item(4, 0x81)).value == 0x81
    assert not any(slave.objects.pdo(record) for record in (0x1402, 0x1403, 0x1802, 0x1803))


def test_a_drive_without_an_error_code_reports_its_mode_alone() -> None:
    bus = wire(Habits(lacks=frozenset({0x603F})))
    report = boot(bus)
    assert bus.slaves[0].objects.pdo(0x1801) == (0x281, 1, [(0x6061, 0)])
    assert "0x603F:0" in report.notes[0]


def test_remapping_follows_the_standard() -> None:
    bus = wire(Habits(objects={(0x1400, 1): Item(4, 0x00000301)}))  # a preset identifier of its own
    boot(bus)
    written = [data for can_id, data in bus.sent if can_id == 0x601 and data[0] & 0xE0 == 0x20]
    rpdo1 = [data.hex(" ") for data in written if data[1:3] in (b"\x00\x14", b"\x00\x16")]
    assert rpdo1 == [
        "23 00 14 01 01 03 00 80",  # invalid, its identifier kept
        "2f 00 16 00 00 00 00 00",
        "23 00 16 01 10 00 40 60",
        "23 00 16 02 08 00 60 60",
        "23 00 16 03 20 00 7a 60",
        "2f 00 16 00 03 00 00 00",
        "2f 00 14 02 01 00 00 00",
        "23 00 14 01 01 02 00 00",  # valid, with the identifier of the predefined connection set
    ]


def test_what_a_drive_does_not_take_is_noted() -> None:
    report = boot(wire(lely_like(refused={(0x1006, 0): GENERAL}, lacks=frozenset({0x60C2, 0x1016}))), **LELY)
    where = "joint joint1 (node 1 on bus right): "
    assert report.notes == (
        where + "the drive works without optional objects: 0x1016:1, 0x60C2:1, 0x60C2:2",
        where + "SDO write of 0x1388 at 0x1006:0 refused: Code 0x08000000, General error",
    )


def mapped(*entries: int) -> dict[tuple[int, int], Item]:
    """A mapping of TPDO1 that nobody can change."""
    items = {(0x1A00, 0): Item(1, len(entries), "ro")}
    return items | {(0x1A00, number): Item(4, entry, "ro") for number, entry in enumerate(entries, 1)}


RIGHT = (0x60410010, 0x60640020, 0x60770010)


def test_a_fixed_mapping_may_be_the_right_one() -> None:
    bus = wire(Habits(objects=mapped(*RIGHT)))
    boot(bus)
    assert bus.slaves[0].power == ENABLED


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vendor_id": 0x99}, r"vendor_id is 0x00000099, the robot description says 0x00001234"),
        ({"product_code": 9}, r"product_code is 0x00000009"),
        ({"device_type": 0x00020191}, r"device type 0x1000 is 0x00020191, profile CiA 401; a drive has CiA 402"),
        ({"supported_modes": 0x80}, r"object 0x6502 is 0x00000080, a torque drive needs 0x00000280"),
        ({"lacks": frozenset({0x6502})}, r"has no object 0x6502:0, which the HAL needs"),
        ({"lacks": frozenset({0x1017})}, r"0x1017:0 refused: .*does not exist"),
        ({"lacks": frozenset({0x6077})}, r"has no object 0x6077:0, which the HAL needs"),
        ({"refused": {(0x1A00, 3): NO_OBJECT}}, r"TPDO1 maps 0 bytes \(no entries\), must be 8 .*0x1A00:3.*not exist"),
        (
            {"objects": mapped(0x60410010, 0x60640020)},
            r"TPDO1 maps 6 bytes \(0x60410010, 0x60640020\), must be 8 \(0x60410010, 0x60640020, 0x60770010\)",
        ),
        ({"ignored": frozenset({0x1A00})}, r"TPDO1 maps 2 bytes \(0x60410010\), must be 8"),
        ({"ignored": frozenset({0x1600})}, r"RPDO1 maps 2 bytes \(0x60400010\), must be 7"),
        ({"ignored": frozenset({0x1801})}, r"TPDO2 .*0x1A01"),
        ({"types": frozenset({255})}, r"TPDO1 has transmission type 255, must be 1; .*0x1800:2 refused"),
        ({"pdo_records": 1}, r"has no TPDO2 \(object 0x1801\), which the HAL needs"),
        ({"objects": {(0x6064, 0): Item(2, 0, "ro", signed=True, mappable=True)}}, r"0x60640020.*cannot be mapped"),
        ({"objects": {(0x6061, 0): Item(1, 0, "ro", signed=True)}}, r"TPDO2 maps .*0x60610008.*cannot be mapped"),
        ({"objects": {(0x603F, 0): Item(4, 0, "ro", mappable=True)}}, r"object 0x603F:0 has 4 bytes, must have 2"),
        ({"objects": {(0x6041, 0): Item(4, 0x40, "ro", mappable=True)}}, r"object 0x6041:0 has 4 bytes, must have 2"),
        ({"objects": {(0x6502, 0): Item(2, 0x280, "ro")}}, r"object 0x6502:0 has 2 bytes, must have 4"),
        ({"objects": {(0x6076, 0): Item(4, 900, "ro")}}, r"0x6076:0 is fixed at 900, must be 500"),
        ({"refused": {(0x60C2, 1): VALUE}}, r"SDO write of 0x5 at 0x60C2:1 refused: .*Value range"),
        ({"refused": {(0x1005, 0): UNSUPPORTED}, "objects": {(0x1005, 0): Item(4, 0x90)}}, r"0x1005:0 is fixed at 144"),
        ({"position": 200_000}, r"stands at 3\.0680 rad, its range is \[-1, 2\]"),
        ({"beats": False}, r"no heartbeat within 1 s although object 0x1017 asks for one every 100 ms"),
        ({"power": 0x2B, "obeys": "nothing"}, r"statusword 0x022b is no state of CiA 402; wrong drive, or"),
        ({"faults": -1}, r"stays in FAULT instead of OPERATION_ENABLED, error code 0x7305"),
        ({"mode_when": "never"}, r"reports mode 0 \(object 0x6061\) after mode 8 was set"),
        ({"refused": {(0x6040, 0): READ_ONLY}, "obeys": "nothing"}, r"stays in SWITCH_ON_DISABLED"),
    ],
    ids=str,
)  # fmt: skip
def test_a_wrong_drive_is_refused(changes: dict[str, Any], message: str) -> None:
    bus = wire(Habits(), Habits(**changes))
    with pytest.raises(BootError, match=r"(?s)joint joint2 \(node 2 on bus right\).*" + message) as caught:
        boot(bus, timeout_s=1.0)
    assert "joint1" not in str(caught.value)
    assert_off(bus)
    alone = not {"faults", "mode_when", "obeys"} & set(changes)
    assert not (alone and any(slave.enabled_once for slave in bus.slaves)), "refused before anything is enabled"


@pytest.mark.parametrize("when", [b"\x76\x60", b"\x61\x60"], ids=["configured", "enabled"])
def test_a_drive_that_restarts_during_the_boot_is_refused(when: bytes) -> None:
    bus = wire(Habits(), Habits())

    def deliver(frames: bytes) -> bytes:
        answered = bus.answer(frames)
        if frames[:2] == b"\x02\x06" and frames[9:11] == when:
            bus.slaves[1].reset()
        return answered

    bus.intercept(deliver)
    with pytest.raises(BootError, match=r"joint2 .*was reset during the boot"):
        boot(bus)
    assert_off(bus)


@pytest.mark.parametrize("delay_s", [0.0, 0.003])
def test_two_drives_with_one_node_id_are_refused(delay_s: float) -> None:
    bus = Wire([ForeignSlave(1, Habits()), ForeignSlave(1, Habits(position=500, answer_s=delay_s))])
    with pytest.raises(BootError, match=r"answered twice; give each device a node id of its own"):
        boot_network(foreign_robot((1,)), [bus], 1.0)
    assert not any(slave.enabled_once for slave in bus.slaves)


@pytest.mark.parametrize("asked", [b"\x40\x64\x60\x00", b"\x40\x18\x10\x01", b"\x40\x77\x77\x00"], ids=bytes.hex)
def test_answers_to_somebody_else_do_no_harm(asked: bytes) -> None:
    """Another SDO client asks the drive now and then: for its position, its vendor, an object that it does not have."""
    bus, requests = wire(Habits(), Habits()), 0

    def deliver(frames: bytes) -> bytes:
        nonlocal requests
        requests += 1
        another = bus.answer(pack(0x601, asked.ljust(8, b"\0"))) if requests % 5 == 0 else b""
        return another + bus.answer(frames)

    bus.intercept(deliver)
    boot(bus)
    assert [slave.power for slave in bus.slaves] == [ENABLED, ENABLED]


def test_a_joint_that_sags_during_the_boot_is_held_where_it_is() -> None:
    bus = wire(Habits(position=1000))

    def deliver(frames: bytes) -> bytes:
        slave = bus.slaves[0]
        slave.objects[0x6064, 0] -= 3 if slave.power != ENABLED else 0
        return bus.answer(frames)

    bus.intercept(deliver)
    report = boot(bus)
    slave = bus.slaves[0]
    assert slave.objects[0x607A, 0] == report.position_counts[0] < 1000 - 100
    assert abs(slave.objects[0x607A, 0] - slave.objects[0x6064, 0]) <= 9


def test_an_enabled_joint_that_moves_is_held_where_it_is_then() -> None:
    bus = wire(Habits(position=1000))
    boot(bus)
    slave = bus.slaves[0]
    slave.objects[0x6060, 0] = slave.objects[0x6061, 0] = 10  # left in torque mode by a HAL that died

    start = bus.now

    def deliver(frames: bytes) -> bytes:
        if slave.objects[0x6061, 0] == 10:
            slave.objects[0x6064, 0] = 1000 - round(2000 * (bus.now - start))
        return bus.answer(frames)

    bus.intercept(deliver)
    report = boot(bus)
    assert slave.objects[0x607A, 0] == report.position_counts[0] < 1000 - 200, "it moves until its mode is set"
    assert abs(slave.objects[0x607A, 0] - slave.objects[0x6064, 0]) <= 30


def test_an_enabled_drive_does_not_follow_an_old_target() -> None:
    bus = wire(Habits(position=1000))
    boot(bus)
    slave = bus.slaves[0]
    slave.objects[0x607A, 0] = -50_000
    slave.commands.clear()
    boot(bus)
    assert slave.power == ENABLED
    assert slave.commands == []
    assert slave.objects[0x607A, 0] == slave.objects[0x6064, 0] == 1000


def test_a_drive_that_lost_the_hal_is_reset_by_the_next_boot() -> None:
    bus = wire(Habits())
    robot = foreign_robot(NODES[:1])
    boot_network(robot, [bus], 1.0)
    slave = bus.slaves[0]
    bus.send(pack(0x77F, b"\x05"))
    silent_since = bus.now
    while slave.power != FAULT:
        assert bus.now < silent_since + 5.0
        bus.receive(0.0)
    assert bus.now - silent_since == pytest.approx(3 * robot.safety.heartbeat_s, abs=2 * bus.STEP_S)
    for word in (0x00, 0x80):
        bus.send(pack(0x601, struct.pack("<BHBI", 0x2B, 0x6040, 0, word)))
    assert slave.power == FAULT, "CiA 301: the communication is to be reset first"
    boot_network(robot, [bus], 1.0)
    assert slave.power == ENABLED
