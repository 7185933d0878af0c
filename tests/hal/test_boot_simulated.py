"""The boot of the simulated drives of three buses, in one process and over the virtual bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.boot import boot_network
from hal.bus.hub import BusHub, HubGroup
from hal.bus.ports import CosimPort, DirectPort, RecordingPort
from hal.errors import BootError
from hal.profile import objects
from hal.profile.cia402 import SUPPORTED_MODES
from hal.profile.frames import unpack
from plant_service.axis import AxisGains
from plant_service.device import DriveDevice
from plant_service.object_dictionary import key_of
from schemas.messages import DriveState
from schemas.robot import Bus, Drive, Joint, RobotDescription
from tests.hal.foreign_device import ForeignSlave
from tests.hal.foreign_objects import Habits
from tests.hal.foreign_robot import Wire, foreign_robot

KINDS = ("torque", "position_pd", "servo")


class StandingAxis:
    """A joint that stands where it is put."""

    def __init__(self, counts: int) -> None:
        self.counts = counts
        self.gains: list[AxisGains] = []
        self.holds = 0

    def position_counts(self) -> int:
        return self.counts

    def torque_per_mille(self) -> int:
        return 0

    def power_off(self) -> None: ...

    def follow_position(self, target_counts: int, max_torque_per_mille: int) -> None:
        raise AssertionError("the boot commands no position, the drive holds by itself")

    def follow_torque(self, per_mille: int, max_torque_per_mille: int) -> None:
        raise AssertionError("the boot commands no torque")

    def hold(self) -> None:
        self.holds += 1

    def configure(self, gains: AxisGains) -> None:
        self.gains.append(gains)


class Plant:
    """Three buses with a drive of each kind."""

    def __init__(self) -> None:
        self.axes = [StandingAxis(100 * index) for index in range(9)]
        self.devices: list[list[DriveDevice]] = []
        self.fixed: list[dict[int, int]] = []
        joints = []
        for index, axis in enumerate(self.axes):
            kind = KINDS[index % 3]
            fixed = {
                key_of(objects.IDENTITY, 1): 0x402,
                key_of(objects.IDENTITY, 2): 1,
                key_of(objects.SUPPORTED_DRIVE_MODES): SUPPORTED_MODES[kind],
            }
            self.fixed.append(fixed)
            if index % 3 == 0:
                self.devices.append([])
            self.devices[-1].append(DriveDevice(index + 1, axis, fixed))
            drive = Drive(
                kind=kind,
                bus=f"bus{index // 3}",
                node_id=index + 1,
                rated_motor_torque=0.5,
                position_gain=2000.0,
                velocity_gain=20.0,
            )
            joints.append(
                Joint(
                    name=f"joint{index}",
                    gear_ratio=100.0,
                    rotor_inertia=1e-5,
                    torque_limit=60.0,
                    torque_rate_limit=1000.0,
                    velocity_limit=3.0,
                    position_min=-1.0,
                    position_max=2.0,
                    encoder_counts=4096,
                    drive=drive,
                )
            )
        buses = tuple(Bus(name=f"bus{index}", channel=f"bus{index}") for index in range(3))
        self.robot = RobotDescription(
            name="nine", urdf="nine.urdf", rate_hz=500.0, compute_budget_s=0.001, buses=buses, joints=tuple(joints)
        )

    def answer(self, bus: int, frames: bytes) -> bytes:
        return b"".join(
            reply
            for can_id, data in unpack(frames)
            for device in self.devices[bus]
            if can_id in device.can_ids
            for reply in device.receive(can_id, data, 0)
        )

    def wire(self, bus: int) -> RecordingPort:
        return RecordingPort(DirectPort(f"bus{bus}", lambda frames: self.answer(bus, frames)))


@pytest.fixture
def plant() -> Plant:
    return Plant()


def test_all_kinds_are_enabled_and_hold(plant: Plant) -> None:
    report = boot_network(plant.robot, [plant.wire(bus) for bus in range(3)])
    assert report.position_counts == tuple(100 * index for index in range(9))
    for devices in plant.devices:
        assert [device.state for device in devices] == [DriveState.OPERATION_ENABLED] * 3
    for axis in plant.axes:
        assert axis.holds == 1
        assert {gains.position_gain for gains in axis.gains} >= {2000.0}
        assert {gains.velocity_gain for gains in axis.gains} >= {20.0}
        assert {gains.hold_ramp_s for gains in axis.gains} >= {0.2}
        assert {gains.rated_motor_torque for gains in axis.gains} >= {0.5}
    for devices in plant.devices:
        for device in devices:
            values = device.dictionary.values
            assert values[key_of(objects.WATCHDOG_CYCLES)] == 5
            assert values[key_of(objects.MAX_TORQUE)] == 1200
            assert values[key_of(objects.TARGET_POSITION)] == values[key_of(objects.POSITION_ACTUAL)]


def test_no_sync_is_sent_and_boots_are_alike(plant: Plant) -> None:
    logs = []
    for each in (plant, Plant()):
        ports = [each.wire(bus) for bus in range(3)]
        boot_network(each.robot, ports)
        logs.append([port.take() for port in ports])
    assert logs[0] == logs[1]
    sent = b"".join(sent for sent, _ in logs[0])
    assert 0x080 not in {can_id for can_id, _ in unpack(sent)}


def test_a_second_boot_takes_over_enabled_drives(plant: Plant) -> None:
    ports = [plant.wire(bus) for bus in range(3)]
    boot_network(plant.robot, ports)
    assert boot_network(plant.robot, ports).position_counts[8] == 800
    assert plant.devices[0][0].state is DriveState.OPERATION_ENABLED


def test_missing_nodes_of_all_buses_are_named(plant: Plant) -> None:
    del plant.devices[0][1]
    del plant.devices[2][0]
    with pytest.raises(BootError, match=r"2 of 9 .*joint1 \(node 2 on bus bus0\), joint joint6 \(node 7 on bus bus2\)"):
        boot_network(plant.robot, [plant.wire(bus) for bus in range(3)], timeout_s=0.02)


@pytest.fixture
def served(plant: Plant, tmp_path: Path) -> Iterator[list[CosimPort]]:
    group = HubGroup([BusHub(tmp_path / f"bus{bus}") for bus in range(3)])
    running = True

    def serve() -> None:
        while running:
            for bus, frames in group.wait(None):
                answer = plant.answer(bus, frames)
                if answer:
                    group.hubs[bus].send(answer)

    thread = threading.Thread(target=serve)
    thread.start()
    ports = [CosimPort(f"bus{bus}", tmp_path / f"bus{bus}") for bus in range(3)]
    yield ports
    running = False
    group.interrupt()
    thread.join()
    group.close()
    for port in ports:
        port.close()


def test_nine_drives_boot_quickly_over_the_virtual_bus(plant: Plant, served: list[CosimPort]) -> None:
    start = time.monotonic()
    report = boot_network(plant.robot, served)
    assert time.monotonic() - start < 2.0
    assert [drive.node_id for drive in report.drives] == list(range(1, 10))


def test_a_failed_boot_leaves_no_drive_powered(plant: Plant) -> None:
    devices = [device for of_bus in plant.devices for device in of_bus]
    last = devices[-1]
    powered: set[int] = set()

    def deliver(bus: int, frames: bytes) -> bytes:
        powered.update(
            d.node_id for devices in plant.devices for d in devices if d.state is DriveState.OPERATION_ENABLED
        )
        if last.state is DriveState.SWITCHED_ON:
            last.fault(0x2310)
        return plant.answer(bus, frames)

    ports = [DirectPort(f"bus{bus}", lambda frames, bus=bus: deliver(bus, frames)) for bus in range(3)]
    with pytest.raises(BootError, match=r"joint8 .*0x2310"):
        boot_network(plant.robot, ports)
    assert powered == set(range(1, 9))
    assert [device.state for device in devices] == [DriveState.SWITCH_ON_DISABLED] * 8 + [DriveState.FAULT]


def variant(tmp_path: Path, **changes: str) -> Path:
    """An EDS file of the drive with some defaults of its records changed, and these not writable."""
    lines, section = [], ""
    for line in Path(objects.eds_path()).read_text(encoding="utf-8").splitlines():
        section = line[1:-1] if line.startswith("[") else section
        key, _, value = line.partition("=")
        if section in changes:
            value = {"DefaultValue": changes[section], "AccessType": "const"}.get(key, value)
        lines.append(f"{key}={value}" if "=" in line else line)
    path = tmp_path / "variant.eds"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"1A00sub0": "2"}, r"TPDO1 maps 6 bytes \(0x60410010, 0x60640020\), must be 8 \(.*fixed at 2"),
        ({"1800sub2": "255"}, r"TPDO1 has transmission type 255, must be 1; .*0x1800:2 is fixed at 255"),
        ({"1400sub1": "0x201"}, r"RPDO1 has COB-ID 0x00000201, must be 0x00000204"),
        ({"1000": "0x00020191"}, r"device type 0x1000 is 0x00020191, profile CiA 401"),
    ],
)
def test_a_drive_with_other_fixed_records_is_refused(
    plant: Plant, tmp_path: Path, changes: dict[str, str], message: str
) -> None:
    plant.devices[1][0] = DriveDevice(4, plant.axes[3], plant.fixed[3], variant(tmp_path, **changes))
    with pytest.raises(BootError, match=r"joint3 \(node 4 on bus bus1\).*" + message):
        boot_network(plant.robot, [plant.wire(bus) for bus in range(3)], timeout_s=0.1)
    assert not any(axis.holds for axis in plant.axes), "nothing was enabled"


def test_no_sync_reaches_a_simulated_drive_for_another_ones_sake(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.enable.PATIENCE_S", 0.0)
    wire = Wire([ForeignSlave(1, Habits(obeys="sync"))])
    own = plant.devices[0][1]
    wire.intercept(lambda frames: wire.answer(frames) + plant.answer(0, frames))
    guest = foreign_robot((1,)).joints[0]
    host = plant.robot.joints[1]
    bus = Bus(name="right", channel="right")
    host = host.model_copy(update={"drive": host.drive.model_copy(update={"bus": "right"})})
    robot = plant.robot.model_copy(update={"buses": (bus,), "joints": (host, guest)})
    plant.devices[0] = [own]
    with pytest.raises(BootError, match=r"joint1 \(node 1 on bus right\): stays in SWITCH_ON_DISABLED"):
        boot_network(robot, [wire], timeout_s=0.2)
    assert 0x080 not in {can_id for can_id, _ in wire.sent}
    assert own.state is DriveState.SWITCH_ON_DISABLED
