"""The whole simulated robot on its buses: bodies, drives and sensors, one SYNC after the other.

The order of a cycle is `deliver` (commands, then SYNC, on every bus) → `truth` → `advance`; see docs/architecture.md.
"""

from __future__ import annotations

from functools import partial
from typing import Final

from hal.profile import objects
from hal.profile.cia402 import SUPPORTED_MODES
from hal.profile.frames import split
from plant_service.bus_nodes import BusNodes, Device, TimedBus, UntimedBus, is_process_data, is_sync
from plant_service.device import DriveDevice
from plant_service.errors import PlantError
from plant_service.object_dictionary import key_of
from plant_service.sensor_device import ForceTorqueDevice, ImuDevice, Motion, Wrench
from plant_service.simulation import Simulation
from plant_service.wire import Wire
from schemas.load import Run
from schemas.messages import BusStatistics, PlantTruth
from schemas.robot import Joint

SENSORS_LAST = 128
"""After every node id."""
VIRTUAL: Final = "cosim"
"""Interface of the buses that the plant hosts."""
STATISTICS_NS: Final = 1_000_000_000


class SyncOrderError(PlantError):
    """A bus had its second SYNC before another had its first: the buses are not driven by one clock."""


class Plant:
    """Simulation and devices of a run. Time 0 is the first SYNC.

    In lockstep the frames of every bus take their time on a simulated wire (`TimedBus`), whatever carries them between
    the processes: a SYNC is ready at the present time, commands when the slowest bus has answered and the compute
    budget of the description has passed (of which a `command_delay_cycles` of 2 hides a period). What could not be on
    the bus before the next SYNC is heard after it. Before a bus's first SYNC its frames take no time, as in the boot.

    With `free`, time passes by `advance` alone and masters send when they like, at wall-clock times that the caller
    gives as `after_ns`; the order of a cycle is then `advance` → `deliver`, as soon as the first SYNC of a sequence
    arrives. Only virtual buses are timed then: a real one takes its own time.
    """

    def __init__(self, run: Run, *, free: bool = False) -> None:
        self._robot = run.robot.description
        self.simulation = Simulation(run.robot, run.scenario.plant, run.scenario.seed)
        self.drives = tuple(
            DriveDevice(joint.drive.node_id, axis, drive_defaults(joint))
            for joint, axis in zip(self._robot.joints, self.simulation.axes, strict=True)
        )
        nodes = [BusNodes(self._devices_of(bus.name)) for bus in self._robot.buses]
        self._boot = [UntimedBus(each) for each in nodes]
        """Each bus while its frames take no time."""
        self._wires = [
            TimedBus(each, Wire(bus.bitrate, self._robot.period_ns)) if not free or bus.interface == VIRTUAL else None
            for each, bus in zip(nodes, self._robot.buses, strict=True)
        ]
        self._started = [False] * len(nodes)
        """Each bus has had its first SYNC (lockstep)."""
        self._synced = [False] * len(nodes)
        self._down = [False] * len(nodes)
        self._now_ns = self.simulation.time_ns
        self._free = free
        if free:
            self.simulation.count_events_from(None)  # the masters' first SYNC is time 0
        self._origin_ns = 0
        self._looked_ns = [self._now_ns] * len(nodes)
        """Until when the frames of each bus have been looked at (`free`)."""
        self._behind = [False] * len(nodes)
        """Periods have been left out since the last frames of each bus (`free`)."""
        self._sync_ns = 0
        """Time of the present SYNC (lockstep)."""
        self._last_command_ns = 0
        """When the commands of the cycle before `advance` were ready (lockstep)."""
        self._compute_ns = max(
            0,
            round(self._robot.compute_budget_s * 1e9) - (self._robot.command_delay_cycles - 1) * self._robot.period_ns,
        )
        """From the last report to the first RPDO."""
        self._statistics_due_ns = STATISTICS_NS
        self.sequence = -1
        """Of the SYNC that came last on any bus, with `free` the periods since the first; −1 before the first."""

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._now_ns

    @property
    def sync_complete(self) -> bool:
        """Every bus that is up has had the SYNC of the present sequence: the interval may be integrated."""
        return any(self._synced) and all(synced or down for synced, down in zip(self._synced, self._down, strict=True))

    @property
    def busy_ns(self) -> int | None:
        """With `free`: the time until which frames wait on a simulated wire; None when none does."""
        times = [wire.wire.busy_ns for wire in self._wires if wire is not None]
        return max((time for time in times if time is not None), default=None)

    def set_bus_down(self, index: int, down: bool) -> None:
        """Take a bus away or bring it back: one that is down carries nothing and is not waited for."""
        self._down[index] = down
        wire = self._wires[index]
        if down:
            self._boot[index].clear()
            if wire is not None:
                wire.clear()
        elif wire is not None:
            wire.wire.resume(self._now_ns)

    def deliver(self, bus_index: int, packet: bytes, after_ns: int = 0) -> bytes:
        """Give frames of a bus to it; the frames of its nodes that were on the bus meanwhile.

        Args:
            bus_index: of the description's buses.
            packet: n × 16 bytes.
            after_ns: wall time since `time_ns` (`free` only). What comes before a SYNC in the packet was sent before
                it, at a time that nobody saw: it counts from the last look at the bus.

        Raises:
            ProfileError: the packet is not a whole number of frames.
            SyncOrderError: a second SYNC before the other buses' first (lockstep); nothing has been delivered.

        """
        wire = self._wires[bus_index]
        frames = split(packet)
        syncs = sum(map(is_sync, frames))
        if self._free:
            return self._deliver_free(bus_index, packet, frames, syncs, after_ns)
        assert wire is not None  # lockstep: all are timed
        if syncs:
            self._check_order(bus_index, syncs)
        answers = []
        asked = False
        for frame in frames:
            if is_sync(frame):
                answers.append(self._sync(bus_index, wire, frame))
            elif not self._started[bus_index]:
                answers.append(self._boot[bus_index].exchange(frame, self._now_ns))
            else:
                wire.put(frame, self._command_ns if self._synced[bus_index] else self._last_command_ns)
                asked = asked or not is_process_data(frame)
        # Process data waits for the rest of its cycle, so that it contends with all of it, however packets are cut.
        if asked:
            answers.append(wire.run(self._next_sync_ns(bus_index) - 1, self._now_ns))
        return b"".join(answers)

    def pump(self, after_ns: int) -> tuple[bytes, ...]:
        """With `free`: the nodes' frames that the buses have carried by now, bus by bus."""
        limits_ns = self._looked_ns = [max(self._now_ns + after_ns, looked) for looked in self._looked_ns]
        return tuple(
            b"" if wire is None else wire.run(limit_ns, self._now_ns)
            for wire, limit_ns in zip(self._wires, limits_ns, strict=True)
        )

    def truth(self) -> PlantTruth:
        """Report the robot as it really is at the present SYNC."""
        truth = self.simulation.truth(max(self.sequence, 0), tuple(drive.state for drive in self.drives))
        if self._origin_ns:
            return truth.model_copy(update={"time_ns": truth.time_ns - self._origin_ns})
        return truth

    def advance(self) -> None:
        """Integrate one period, then let the time act on the devices; the next SYNC may come."""
        if not self._free:
            self._last_command_ns = self._command_ns
        self.simulation.advance()
        self._now_ns = now_ns = self.simulation.time_ns
        for boot, wire in zip(self._boot, self._wires, strict=True):
            (boot if wire is None else wire).tick(now_ns)
        self._synced = [False] * len(self._synced)
        if self._free and self.sequence >= 0:
            self.sequence += 1

    def skip(self, periods: int) -> None:
        """Leave out periods that there was no time to simulate (`free`): what follows keeps its place in time."""
        self._behind = [True] * len(self._behind)
        if self.sequence >= 0:
            self.sequence += periods
            self._origin_ns -= periods * self._robot.period_ns
            self.simulation.count_events_from(self._origin_ns)

    def free_run(self) -> tuple[bytes, ...]:
        """Integrate one period without SYNC; what the nodes of each bus say on their own, to be sent at once."""
        self.advance()
        return self.collect()

    def collect(self) -> tuple[bytes, ...]:
        """Take what the nodes of each bus said on their own since their last answer."""
        return tuple(
            boot.collect() if wire is None else wire.run(self._now_ns, self._now_ns)
            for boot, wire in zip(self._boot, self._wires, strict=True)
        )

    def statistics(self, *, final: bool = False) -> tuple[BusStatistics, ...]:
        """Tell what came of the frames since the last time, a message a timed bus; empty before a second is over."""
        now_ns = self._now_ns
        if now_ns < self._statistics_due_ns and not final:
            return ()
        self._statistics_due_ns = now_ns + STATISTICS_NS
        sequence, time_ns = max(self.sequence, 0), now_ns - self._origin_ns
        messages = []
        for index, (bus, wire) in enumerate(zip(self._robot.buses, self._wires, strict=True)):
            if wire is None:
                continue
            if final:
                if not self._free:
                    wire.run(self._next_sync_ns(index) - 1, now_ns)
                wire.wire.end(now_ns)
            messages.append(wire.wire.statistics.take(bus.name, sequence, time_ns))
        return tuple(message for message in messages if message is not None)

    @property
    def _command_ns(self) -> int:
        """When the commands that answer the present SYNC's reports are ready (lockstep)."""
        return max(wire.answered_ns for wire in self._wires if wire is not None) + self._compute_ns

    def _next_sync_ns(self, bus_index: int) -> int:
        """When the next SYNC of a bus is due (lockstep), if it was not before; other buses may have had theirs."""
        if any(self._synced) and not self._synced[bus_index]:
            return self._sync_ns
        return max(self._sync_ns + self._robot.period_ns, self._now_ns)

    def _deliver_free(self, bus_index: int, packet: bytes, frames: list[bytes], syncs: int, after_ns: int) -> bytes:
        if syncs and self.sequence < 0:
            self.sequence, self._origin_ns = 0, self._now_ns
            self.simulation.count_events_from(self._origin_ns)
        wire = self._wires[bus_index]
        if wire is None:
            return self._boot[bus_index].exchange(packet, self._now_ns)
        looked_ns = self._looked_ns[bus_index]
        ready_ns = self._looked_ns[bus_index] = max(self._now_ns + after_ns, looked_ns)
        if syncs > 1 or self._behind[bus_index]:
            # Read too late to tell when it was sent: charged as if it had come just now, it would not fit.
            self._behind[bus_index] = False
            return wire.run(ready_ns, self._now_ns) + self._boot[bus_index].exchange(packet, self._now_ns)
        for frame in frames:
            if is_sync(frame):
                wire.begin(frame, ready_ns)
                syncs -= 1
            else:
                wire.put(frame, looked_ns if syncs else ready_ns)
        return wire.run(ready_ns, self._now_ns)

    def _sync(self, bus_index: int, wire: TimedBus, frame: bytes) -> bytes:
        """Let a bus finish what came before a SYNC, then the SYNC, the answers, and what fits until the commands."""
        if not any(self._synced):
            self.sequence += 1
            self._sync_ns = self._now_ns
        self._synced[bus_index] = self._started[bus_index] = True
        now_ns = self._now_ns
        last_ns = self._sync_ns + self._robot.period_ns - 1
        before = wire.run(self._sync_ns - 1, now_ns)
        answers = wire.sync(frame, self._sync_ns, last_ns, now_ns)
        return before + answers + wire.run(min(wire.answered_ns + self._compute_ns, last_ns), now_ns)

    def _check_order(self, bus_index: int, syncs: int) -> None:
        if not self._synced[bus_index] and syncs == 1:
            return
        missing = [bus.name for bus, synced in zip(self._robot.buses, self._synced, strict=True) if not synced]
        raise SyncOrderError(
            f"bus {self._robot.buses[bus_index].name}: second SYNC of sequence {max(self.sequence, 0)}; "
            f"still without it: {', '.join(missing) or 'none: the plant was not advanced'}"
        )

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
