"""The HAL's boot of devices of another maker's stack (`durand`) on the virtual bus, then motion by PDOs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hal.boot import BootReport, boot_network
from hal.bus.hub import serve_in_thread
from hal.bus.ports import FramePort, RecordingPort, open_port
from hal.errors import BootError
from hal.profile import objects
from hal.profile.cia402 import SUPPORTED_MODES, OperationMode
from hal.profile.frames import pack, unpack
from hal.profile.units import DriveUnits
from schemas.messages import DriveState
from schemas.robot import Bus, Drive, ForceTorqueSensor, Joint, RobotDescription
from tests.hal.durand_drive import DurandDrive

NODES = (3, 5)
SYNC = pack(0x080, b"")


def robot(channel: str, kind: str = "torque", nodes: tuple[int, ...] = NODES, **changes: Any) -> RobotDescription:
    joints = [
        Joint(
            name=f"joint{node}",
            gear_ratio=100.0,
            rotor_inertia=1e-5,
            torque_limit=60.0,
            torque_rate_limit=1000.0,
            velocity_limit=3.0,
            position_min=-1.0,
            position_max=2.0,
            encoder_counts=4096,
            direction=-1,
            zero_offset=0.5,
            drive=Drive(
                kind=kind,
                bus="right",
                node_id=node,
                rated_motor_torque=0.5,
                position_gain=2000.0,
                velocity_gain=20.0,
                vendor_id=0x1234,
                product_code=7,
            ),
        )
        for node in nodes
    ]
    return RobotDescription(
        name="pair",
        urdf="pair.urdf",
        rate_hz=500.0,
        compute_budget_s=0.001,
        buses=(Bus(name="right", channel=channel),),
        joints=tuple(joints),
        **changes,
    )


Make = Callable[..., DurandDrive]


@pytest.fixture
def channel(tmp_path: Path) -> Iterator[str]:
    path = str(tmp_path / "bus")
    with serve_in_thread(path):
        yield path


@pytest.fixture
def make(channel: str) -> Iterator[Make]:
    made: list[tuple[DurandDrive, can.BusABC]] = []

    def drive(node_id: int, **options: Any) -> DurandDrive:
        bus = can.Bus(interface="cosim", channel=channel)
        made.append((DurandDrive(bus, node_id, **options), bus))
        return made[-1][0]

    yield drive
    for device, bus in made:
        device.stop()
        bus.shutdown()


@pytest.fixture
def port(channel: str) -> Iterator[RecordingPort]:
    opened = RecordingPort(open_port(Bus(name="right", channel=channel)))
    yield opened
    opened.close()


def boot(description: RobotDescription, port: FramePort, timeout_s: float = 5.0) -> BootReport:
    return boot_network(description, [port], timeout_s)


def frames_of(buffer: bytes) -> list[tuple[int, bytes]]:
    return list(unpack(buffer))


def receive_from(port: FramePort, *identifiers: int) -> dict[int, bytes]:
    """Frames with these identifiers, once all have come."""
    found: dict[int, bytes] = {}
    deadline = time.monotonic() + 5.0
    while set(found) != set(identifiers):
        assert time.monotonic() < deadline, f"only {found} came"
        found.update({can_id: data for can_id, data in unpack(port.receive(0.1)) if can_id in identifiers})
    return found


def test_boots_and_moves(channel: str, make: Make, port: RecordingPort) -> None:
    drives = [make(node, position=1000 * node) for node in NODES]
    description = robot(channel)

    start = time.monotonic()
    report = boot(description, port)
    assert time.monotonic() - start < 5.0

    units = DriveUnits.of(description)
    assert report.position_counts == (3000, 5000)
    np.testing.assert_allclose(report.position_measured, 0.5 - 2 * np.pi * np.array([3000, 5000]) / 409600.0)
    for drive, result in zip(drives, report.drives, strict=True):
        assert drive.state is DriveState.OPERATION_ENABLED
        assert drive.controlwords == [0x06, 0x07, 0x0F]
        assert drive.read(objects.MODE_DISPLAY) == 8
        assert drive.read(objects.TARGET_POSITION) == result.position_counts
        assert (result.vendor_id, result.product_code, result.mode) == (0x1234, 7, OperationMode.CSP)
    sent = frames_of(port.take()[0])
    assert SYNC[:4] not in {can_id.to_bytes(4, "little") for can_id, _ in sent}

    targets = units.counts_from_position(np.array([0.7, -0.3]))
    answers = [base + node for base in (0x180, 0x280) for node in NODES]
    for _ in range(2):
        for node, target in zip(NODES, targets.tolist(), strict=True):
            port.send(pack(0x200 + node, objects.POSITION_STRUCT.pack(0x0F, OperationMode.CSP, target)))
        port.send(SYNC)
        reported = receive_from(port, *answers)
    words = [objects.STATE_STRUCT.unpack(reported[0x180 + node]) for node in NODES]
    assert [word[1] for word in words] == targets.tolist()
    assert {word[0] & 0x6F for word in words} == {0x27}

    for _ in range(2):
        for node in NODES:
            port.send(pack(0x300 + node, objects.TORQUE_STRUCT.pack(0x0F, OperationMode.CST, 10 * node)))
        port.send(SYNC)
        reported = receive_from(port, *answers)
    for node in NODES:
        assert objects.STATE_STRUCT.unpack(reported[0x180 + node])[2] == 10 * node
        assert objects.MODE_STRUCT.unpack(reported[0x280 + node]) == (10, 0)


def test_writes_what_the_description_says(channel: str, make: Make, port: RecordingPort) -> None:
    drive = make(3)
    boot(robot(channel, nodes=(3,)), port)
    assert drive.read(objects.PRODUCER_HEARTBEAT_MS) == 100
    assert drive.read(objects.CONSUMER_HEARTBEAT, 1) == 127 << 16 | 300
    assert drive.read(objects.SYNC_PERIOD_US) == 2000
    assert drive.read(objects.RATED_TORQUE_MNM) == 500
    assert drive.read(objects.MAX_TORQUE) == 1200
    assert [drive.read(0x1A00, sub) for sub in range(4)] == [3, 0x60410010, 0x60640020, 0x60770010]
    assert [drive.read(0x1601, sub) for sub in range(4)] == [3, 0x60400010, 0x60600008, 0x60710010]
    assert drive.read(0x1800, 1) == 0x40000183
    assert drive.read(0x1401, 1) == 0x303
    assert drive.read(0x1802, 1) >> 31
    assert drive.read(0x1403, 1) >> 31


def test_two_boots_send_the_same_frames(channel: str, make: Make, port: RecordingPort) -> None:
    drives = [make(node, position=77) for node in NODES]
    boot(robot(channel), port)
    first = port.take()[0]
    for drive in drives:
        drive.stop()
    for node in NODES:
        make(node, position=77)
    boot(robot(channel), port)
    assert port.take()[0] == first


def test_a_recoverable_fault_is_reset(channel: str, make: Make, port: RecordingPort) -> None:
    drive = make(3, fault=True)
    boot(robot(channel, nodes=(3,)), port)
    assert drive.state is DriveState.OPERATION_ENABLED
    assert drive.controlwords[:2] == [0x80, 0x06]


def test_all_missing_nodes_are_named(channel: str, make: Make, port: RecordingPort) -> None:
    make(5)
    with pytest.raises(BootError, match=r"2 of 3 drives .*joint3 \(node 3 on bus right\), joint joint9 \(node 9"):
        boot(robot(channel, nodes=(3, 5, 9)), port, timeout_s=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vendor_id": 0x99}, r"joint3 .*vendor_id is 0x00000099, the robot description says 0x00001234"),
        ({"product_code": 8}, r"joint3 .*product_code is 0x00000008"),
        ({"supported_modes": SUPPORTED_MODES["position_pd"]}, r"object 0x6502 is 0x00000080, a torque drive needs"),
        ({"position": 200_000}, r"stands at -2\.5680 rad, its range is \[-1, 2\]"),
        ({"fault": True, "fault_stays": True}, r"stays in FAULT instead of OPERATION_ENABLED, error code 0x7320"),
    ],
)
def test_a_wrong_drive_is_refused(
    channel: str, make: Make, port: RecordingPort, options: dict[str, Any], message: str
) -> None:
    drive = make(3, **options)
    with pytest.raises(BootError, match=message):
        boot(robot(channel, nodes=(3,)), port)
    assert drive.state is not DriveState.OPERATION_ENABLED


def test_a_vendor_id_alone_makes_no_simulated_drive(channel: str, make: Make, port: RecordingPort) -> None:
    drive = make(3, vendor_id=0x402, product_code=1)
    description = robot(channel, nodes=(3,))
    joint = description.joints[0]
    own = joint.drive.model_copy(update={"vendor_id": 0x402, "product_code": 1})
    description = description.model_copy(update={"joints": (joint.model_copy(update={"drive": own}),)})
    assert any(
        "has the simulated drives' vendor id, but object 0x2006" in note for note in boot(description, port).notes
    )
    assert drive.state is DriveState.OPERATION_ENABLED


def test_a_silent_sdo_server_is_a_boot_error(
    channel: str, make: Make, port: RecordingPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hal.sdo_client.SDO_TIMEOUT_S", 0.05)
    drive = make(3)
    drive.network.subscriptions.pop(0x603)
    with pytest.raises(BootError, match=r"joint3 .*SDO read of 0x1000:0 failed .*check the drive's power"):
        boot(robot(channel, nodes=(3,)), port)


def test_sensors_are_started_last(channel: str, make: Make, port: RecordingPort) -> None:
    make(3)
    sensor = ForceTorqueSensor(name="wrist", frame="hand", bus="right", can_id=0x400, command_id=0x402)
    boot(robot(channel, nodes=(3,), force_torque_sensors=(sensor,)), port)
    assert frames_of(port.take()[0])[-1] == (0x402, b"\x0b" + bytes(7))


def test_one_port_a_bus(channel: str, port: RecordingPort) -> None:
    with pytest.raises(BootError, match="has 1 buses, 2 ports"):
        boot_network(robot(channel), [port, port])
