"""Worst-case load of each bus, from the frames of one cycle."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from schemas.robot import RobotDescription

SYNC_BYTES = 0
STATE_BYTES = 8
"""TPDO1 {6041, 6064, 6077}."""
MODE_BYTES = 3
"""TPDO2 {6061, 603F}, sent on change: in the worst cycle, a mode switch, by every drive that has two modes of
operation; on a bus whose drives have mode 8 alone, by the one whose error changes."""
COMMAND_BYTES = {"position_pd": 7, "torque": 7, "servo": 8}
"""The longest RPDO of each kind."""
FORCE_TORQUE_BYTES = (8, 8)
IMU_BYTES = (6, 6, 8)


def worst_case_bits(data_bytes: int) -> int:
    """Bits of an 11-bit-identifier frame of n data bytes with worst-case stuffing and 3 bits of interframe space.

    47 + 8n + ⌊(34 + 8n − 1) / 4⌋ (Davis, Burns, Bril, Lukkien 2007).
    """
    return 47 + 8 * data_bytes + (34 + 8 * data_bytes - 1) // 4


Frames = tuple[tuple[str, int], ...]
"""(name, data bytes) of each frame."""


@dataclass(frozen=True, slots=True)
class BusLoad:
    """The worst cycle of one bus: SYNC, reports, commands. Heartbeat, EMCY and SDO frames are not counted."""

    bus: str
    bitrate: int
    period_s: float
    reports: Frames
    commands: Frames

    @property
    def bits(self) -> int:
        """Bits of the worst cycle."""
        return _bits((("SYNC", SYNC_BYTES), *self.reports, *self.commands))

    @property
    def fraction(self) -> float:
        """Load: 1 is full."""
        return self.bits / (self.bitrate * self.period_s)

    @property
    def report_time_s(self) -> float:
        """From the start of SYNC to the end of the last report [s]."""
        return _bits((("SYNC", SYNC_BYTES), *self.reports)) / self.bitrate

    @property
    def command_time_s(self) -> float:
        """From the start of the first RPDO to the end of the last [s]."""
        return _bits(self.commands) / self.bitrate

    def explain(self) -> str:
        """Show the arithmetic in one line."""
        counts = Counter((("SYNC", SYNC_BYTES), *self.reports, *self.commands))
        terms = " + ".join(f"{n}×{name}({worst_case_bits(size)} bit)" for (name, size), n in counts.items())
        return (
            f"{terms} = {self.bits} bit in {self.period_s * 1e3:g} ms at {self.bitrate / 1e6:g} Mbit/s"
            f" = {self.fraction:.0%}"
        )


def bus_loads(robot: RobotDescription) -> tuple[BusLoad, ...]:
    """Worst-case load of each bus of a robot, in the order of its buses."""
    loads = []
    for bus in robot.buses:
        drives = [joint.drive for joint in robot.joints if joint.drive.bus == bus.name]
        changing = [drive for drive in drives if drive.kind == "torque"] or drives[:1]
        reports = [("TPDO1", STATE_BYTES) for _ in drives] + [("TPDO2", MODE_BYTES) for _ in changing]
        for sensor in robot.force_torque_sensors:
            if sensor.bus == bus.name:
                reports += [("F/T", size) for size in FORCE_TORQUE_BYTES]
        for imu in robot.imus:
            if imu.bus == bus.name:
                reports += [("IMU", size) for size in IMU_BYTES]
        commands = tuple(("RPDO", COMMAND_BYTES[drive.kind]) for drive in drives)
        loads.append(BusLoad(bus.name, bus.bitrate, robot.period_s, tuple(reports), commands))
    return tuple(loads)


def _bits(frames: Frames) -> int:
    return sum(worst_case_bits(size) for _, size in frames)
