"""The cycle of docs/architecture.md: SYNC on every bus, one interval, what waits and what is said in which order."""

from __future__ import annotations

import struct

import pytest

from hal.profile.frames import pack, unpack
from plant_service.plant import Plant, SyncOrderError
from schemas.load import load_run
from schemas.messages import DriveState

SYNC = pack(0x080, b"")


@pytest.fixture(scope="module")
def run():
    return load_run("arm9-transition")


@pytest.fixture
def plant(run) -> Plant:
    plant = Plant(run)
    for bus, nodes in enumerate(nodes_of(run)):
        for node in nodes:
            write(plant, bus, node, 0x1401, 1, 0x300 + node, 4)
            write(plant, bus, node, 0x1006, 0, run.robot.description.period_ns // 1000, 4)
            write(plant, bus, node, 0x6060, 0, 8, 1)
            for word in (0x06, 0x07, 0x0F):
                write(plant, bus, node, 0x6040, 0, word, 2)
        plant.deliver(bus, pack(0x000, b"\x01\x00"))
    return plant


def nodes_of(run) -> list[list[int]]:
    robot = run.robot.description
    return [[joint.drive.node_id for joint in robot.joints if joint.drive.bus == bus.name] for bus in robot.buses]


def write(plant: Plant, bus: int, node: int, index: int, subindex: int, value: int, size: int) -> None:
    request = struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, subindex, value)
    answers = dict(unpack(plant.deliver(bus, pack(0x600 + node, request))))
    assert answers[0x580 + node][0] == 0x60, answers


def sync_all(plant: Plant) -> list[list[tuple[int, bytes]]]:
    return [list(unpack(plant.deliver(bus, SYNC))) for bus in range(3)]


def test_boot_takes_no_time(run, plant):
    assert (plant.time_ns, plant.sequence) == (0, -1)
    assert {drive.state for drive in plant.drives} == {DriveState.OPERATION_ENABLED}


def test_sync_is_complete_when_all_buses_had_it(run, plant):
    last = len(run.robot.description.buses) - 1
    for bus in range(last + 1):
        assert not plant.sync_complete
        plant.deliver(bus, SYNC)
    assert plant.sync_complete
    assert (plant.sequence, plant.truth().sequence) == (0, 0)
    plant.advance()
    assert not plant.sync_complete
    assert plant.time_ns == run.robot.description.period_ns


def test_answers_come_in_the_order_of_arbitration(plant):
    for answers in sync_all(plant):
        identifiers = [can_id for can_id, _ in answers if can_id < 0x700]
        assert identifiers == sorted(identifiers)
        assert sum(can_id >> 7 == 0x180 >> 7 for can_id in identifiers) == 3
        assert sum(can_id >> 7 == 0x280 >> 7 for can_id in identifiers) == 3


def test_second_sync_of_one_bus(plant):
    plant.deliver(0, SYNC)
    with pytest.raises(SyncOrderError, match="second SYNC of sequence 0"):
        plant.deliver(0, SYNC)


def test_held_joints_stay(run, plant):
    start = plant.truth().position
    for _ in range(50):
        sync_all(plant)
        plant.advance()
    assert plant.truth().position == pytest.approx(start, abs=0.02)


def test_commands_and_sync_in_one_packet(run, plant):
    nodes = nodes_of(run)[0]
    torque = b"".join(pack(0x300 + node, struct.pack("<Hbh", 0x0F, 10, 0)) for node in nodes)
    answers = dict(unpack(plant.deliver(0, torque + SYNC)))
    assert [answers[0x280 + node] for node in nodes] == [b"\x0a\0\0"] * 3


def test_silence_of_the_bus_makes_drives_hold(run, plant):
    for _ in range(3):
        for bus, nodes in enumerate(nodes_of(run)):
            torque = b"".join(pack(0x300 + node, struct.pack("<Hbh", 0x0F, 10, 0)) for node in nodes)
            plant.deliver(bus, torque + SYNC)
        plant.advance()
    said = [plant.free_run() for _ in range(5)]
    errors = {
        can_id - 0x080 for frames in said for bus in frames for can_id, _ in unpack(bus) if 0x080 < can_id < 0x100
    }
    assert errors == {node for nodes in nodes_of(run) for node in nodes}
    assert {drive.power.left_alone for drive in plant.drives} == {True}
    plant.free_run()
    assert set(plant.truth().mode) == {8}


def test_force_torque_sensor_speaks_after_its_start_command(run, plant):
    sensor = run.robot.description.force_torque_sensors[0]
    bus = run.robot.description.bus_index(sensor.bus)
    pair = {sensor.can_id, sensor.can_id + 1}
    assert not pair & {can_id for can_id, _ in unpack(plant.deliver(bus, SYNC))}
    for other in range(len(run.robot.description.buses)):
        if other != bus:
            plant.deliver(other, SYNC)
    plant.advance()
    plant.deliver(bus, pack(sensor.command_id, b"\x0b" + bytes(7)))
    answers = dict(unpack(plant.deliver(bus, SYNC)))
    assert pair <= set(answers)
    assert answers[sensor.can_id][0] == 0x0B


def test_heartbeats_wait_for_the_next_answer(run, plant):
    write(plant, 0, nodes_of(run)[0][0], 0x1017, 0, 2, 2)
    beats = []
    for _ in range(3):
        beats.append([can_id for can_id, _ in sync_all(plant)[0] if can_id > 0x700])
        plant.advance()
    assert beats[2] == [0x700 + nodes_of(run)[0][0]]


def test_same_calls_same_bytes(run):
    def record() -> bytes:
        plant = Plant(run)
        said = b""
        for _ in range(5):
            said += b"".join(plant.deliver(bus, SYNC) for bus in range(3))
            plant.advance()
        return said

    assert record() == record()


def test_a_sync_with_data_is_an_error_and_no_sync(run, plant):
    sync_all(plant)
    plant.advance()
    sequence = plant.sequence
    answers = list(unpack(plant.deliver(0, pack(0x080, b"\x01"))))
    assert [(can_id, data[:2]) for can_id, data in answers] == [
        (0x080 + node, b"\x40\x82") for node in sorted(nodes_of(run)[0])
    ]
    assert plant.sequence == sequence
    assert not plant.sync_complete
    reports = {can_id for can_id, _ in unpack(plant.deliver(0, SYNC))}
    assert {0x180 + node for node in nodes_of(run)[0]} <= reports
