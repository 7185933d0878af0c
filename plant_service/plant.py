"""The whole simulated robot on its buses: bodies, drives and sensors, one SYNC after the other.

The order of a cycle is `deliver` (commands, then SYNC, on every bus) → `truth` → `advance`; see docs/architecture.md.
"""

from __future__ import annotations

from functools import partial
from typing import Protocol

from hal.profile import frames, objects
from hal.profile.cia402 import SUPPORTED_MODES
from hal.profile.identifiers import SYNC
from plant_service.device import DriveDevice
from plant_service.errors import PlantError
from plant_service.object_dictionary import key_of
from plant_service.sensor_device import ForceTorqueDevice, ImuDevice, Motion, Wrench
from plant_service.simulation import Simulation
from schemas.load import Run
from schemas.messages import PlantTruth
from schemas.robot import Joint

SENSORS_LAST = 128
"""After every node id."""


class Device(Protocol):
    """A node of a bus: pure, frames of 16 bytes out."""

    @property
    def revision(self) -> int:
        """Grows when `can_ids` changes."""
        ...

    @property
    def can_ids(self) -> frozenset[int]:
        """Identifiers that it listens to."""
        ...

    def receive(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Hear one frame."""
        ...

    def sync(self, now_ns: int) -> list[bytes]:
        """Answer a SYNC without data."""
        ...

    def tick(self, now_ns: int) -> list[bytes]:
        """Act on the time."""
        ...


class SyncOrderError(PlantError):
    """A bus had its second SYNC before another had its first: the buses are not driven by one clock."""


class BusNodes:
    """The nodes of one bus and the way of frames to them."""

    def __init__(self, devices: list[Device]) -> None:
        self.devices = devices
        self.waiting: list[bytes] = []
        """Frames that arose while nobody listened (heartbeats, watchdog EMCY): sent with the next answer."""
        self._routes: dict[int, list[Device]] = {}
        self._revision = -1

    def deliver(self, can_id: int, data: bytes, now_ns: int) -> list[bytes]:
        """Give a frame to the nodes that listen; their answers."""
        listeners = self._routes.get(can_id)
        if listeners is None:
            listeners = self._routes[can_id] = [device for device in self.devices if can_id in device.can_ids]
        answers: list[bytes] = []
        for device in listeners:
            answers += device.receive(can_id, data, now_ns)
        if answers:  # every service that can change what a node listens to is answered
            revision = sum(device.revision for device in self.devices)
            if revision != self._revision:
                self._routes.clear()
                self._revision = revision
        return answers

    def sync(self, now_ns: int) -> list[bytes]:
        """Give a SYNC to all; their answers in the order of arbitration: lowest identifier first."""
        answers: list[bytes] = []
        for device in self.devices:
            answers += device.sync(now_ns)
        return answers

    def tick(self, now_ns: int) -> None:
        """Let the time act on all; what they say waits."""
        for device in self.devices:
            self.waiting += device.tick(now_ns)

    def collect(self, answers: list[bytes]) -> bytes:
        """Answers and waiting frames in the order of arbitration (a node's own frames keep their order)."""
        if self.waiting:
            answers = self.waiting + answers
            self.waiting = []
        answers = sorted(answers, key=frame_identifier)
        return b"".join(answers)


def frame_identifier(frame: bytes) -> int:
    """Read the identifier of a packed 11-bit frame."""
    return frame[1] << 8 | frame[0]


class Plant:
    """Simulation and devices of a run. Time 0 is the first SYNC.

    With `free`, time passes by `advance` alone and masters send SYNC when and on which bus they like: the order of a
    cycle is then `advance` → `deliver`, as soon as the first SYNC of a sequence arrives.
    """

    def __init__(self, run: Run, *, free: bool = False) -> None:
        self._robot = run.robot.description
        self.simulation = Simulation(run.robot, run.scenario.plant, run.scenario.seed)
        self.drives = tuple(
            DriveDevice(joint.drive.node_id, axis, drive_defaults(joint))
            for joint, axis in zip(self._robot.joints, self.simulation.axes, strict=True)
        )
        self._buses = [BusNodes(self._devices_of(bus.name)) for bus in self._robot.buses]
        self._synced = [False] * len(self._buses)
        self._now_ns = self.simulation.time_ns
        self._free = free
        self._origin_ns = 0
        self.sequence = -1
        """Of the SYNC that came last on any bus, with `free` the periods since the first; −1 before the first."""

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._now_ns

    @property
    def sync_complete(self) -> bool:
        """Every bus has had the SYNC of the present sequence: the interval may be integrated."""
        return all(self._synced)

    def deliver(self, bus_index: int, packet: bytes) -> bytes:
        """Give frames of a bus to its nodes; all their answers, those to a SYNC in the order of arbitration.

        Raises:
            ProfileError: the packet is not a whole number of frames.
            SyncOrderError: a second SYNC before the other buses' first.

        """
        bus = self._buses[bus_index]
        now_ns = self._now_ns
        answers: list[bytes] = []
        for can_id, data in frames.unpack(packet):
            if can_id == SYNC and not data:
                self._count_sync(bus_index)
                answers.append(bus.collect(bus.sync(now_ns)))
            else:
                answers += bus.deliver(can_id, data, now_ns)
        return b"".join(answers)

    def truth(self) -> PlantTruth:
        """Report the robot as it really is at the present SYNC."""
        truth = self.simulation.truth(max(self.sequence, 0), tuple(drive.state for drive in self.drives))
        if self._origin_ns:
            return truth.model_copy(update={"time_ns": truth.time_ns - self._origin_ns})
        return truth

    def advance(self) -> None:
        """Integrate one period, then let the time act on the devices; the next SYNC may come."""
        self.simulation.advance()
        self._now_ns = now_ns = self.simulation.time_ns
        for bus in self._buses:
            bus.tick(now_ns)
        self._synced = [False] * len(self._buses)
        if self._free and self.sequence >= 0:
            self.sequence += 1

    def skip(self, periods: int) -> None:
        """Leave out periods that there was no time to simulate (`free`): what follows keeps its place in time."""
        if self.sequence >= 0:
            self.sequence += periods
            self._origin_ns -= periods * self._robot.period_ns

    def free_run(self) -> tuple[bytes, ...]:
        """Integrate one period without SYNC; what the nodes of each bus say on their own, to be sent at once."""
        self.advance()
        return self.collect()

    def collect(self) -> tuple[bytes, ...]:
        """Take what the nodes of each bus said on their own since their last answer."""
        return tuple(bus.collect([]) for bus in self._buses)

    def _count_sync(self, bus_index: int) -> None:
        if self._free:
            if self.sequence < 0:
                self.sequence, self._origin_ns = 0, self._now_ns
            return
        if self._synced[bus_index]:
            missing = [bus.name for bus, synced in zip(self._robot.buses, self._synced, strict=True) if not synced] or [
                "none: the plant was not advanced"
            ]
            raise SyncOrderError(
                f"bus {self._robot.buses[bus_index].name}: second SYNC of sequence {self.sequence}; "
                f"still without it: {', '.join(missing)}"
            )
        if not any(self._synced):
            self.sequence += 1
        self._synced[bus_index] = True

    def _devices_of(self, bus: str) -> list[Device]:
        robot = self._robot
        pairs = zip(robot.joints, self.drives, strict=True)
        devices: list[Device] = [drive for joint, drive in pairs if joint.drive.bus == bus]
        devices += [
            ForceTorqueDevice(sensor, partial(_wrench, self.simulation, sensor.name))
            for sensor in robot.force_torque_sensors
            if sensor.bus == bus
        ]
        devices += [ImuDevice(imu, partial(_motion, self.simulation, imu.name)) for imu in robot.imus if imu.bus == bus]
        return sorted(devices, key=lambda device: getattr(device, "node_id", SENSORS_LAST))


def drive_defaults(joint: Joint) -> dict[int, int]:
    """Values of a joint's drive before any master wrote to it, by `key_of`: the maker's data of the description."""
    drive = joint.drive
    rated = drive.rated_motor_torque
    return {
        key_of(objects.IDENTITY, 1): drive.vendor_id,
        key_of(objects.IDENTITY, 2): drive.product_code,
        key_of(objects.SUPPORTED_DRIVE_MODES): SUPPORTED_MODES[drive.kind],
        key_of(objects.RATED_TORQUE_MNM): round(1000.0 * rated),
        key_of(objects.MAX_TORQUE): min(65535, round(1000.0 * joint.torque_limit / (rated * joint.gear_ratio))),
        key_of(objects.JOINT_TORQUE_LIMIT): round(1000.0 * joint.torque_limit),
        key_of(objects.POSITION_GAIN): round(1000.0 * drive.position_gain),
        key_of(objects.VELOCITY_GAIN): round(1000.0 * drive.velocity_gain),
        key_of(objects.ENCODER_RESOLUTION, 1): joint.encoder_counts,
    }


def _wrench(simulation: Simulation, name: str) -> Wrench:
    fx, fy, fz, mx, my, mz = simulation.sensors.wrenches[name].tolist()
    return (fx, fy, fz), (mx, my, mz)


def _motion(simulation: Simulation, name: str) -> Motion:
    reading = simulation.sensors.imus[name]
    return (
        tuple(reading.angular_velocity.tolist()),
        tuple(reading.acceleration.tolist()),
        tuple(reading.orientation_to_world.tolist()),
    )
