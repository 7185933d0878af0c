"""Worst-case load of each bus and the time of a cycle, from the frames of one cycle.

SYNC, reports and commands are counted in every cycle, each frame with the stuff bits of its worst content.
Heartbeats come once per `safety.heartbeat_s`, of every drive and of the HAL. Their share of the time is part of the
load; the cycle in which all of them fall together is shown apart, since they have the lowest priority and only fill
what the other frames leave free. They delay SYNC, reports and commands no more than any frame of lower priority does:
by the one that is on the bus already (`BLOCKING_BITS`). EMCY and SDO frames are not counted: they come with faults and
with requests.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

from schemas.robot import RobotDescription

SYNC_BYTES: Final = 0
STATE_BYTES: Final = 8
"""TPDO1 {6041, 6064, 6077}."""
MODE_BYTES: Final = 3
"""TPDO2 {6061, 603F}, sent on change: in the worst cycle, a mode switch, by every drive that has two modes of
operation. A drive of mode 8 alone changes nothing but its error, and two do not fail at one SYNC without a common cause
that ends the run: a bus of such drives counts one. That all of them tell their mode at the first SYNC after the boot is
apart (`BusLoad.first_reports`): it happens once, yields to the commands (0x280 after 0x200), and the robot stands."""
COMMAND_BYTES: Final = {"position_pd": 7, "torque": 7, "servo": 8}
"""The longest RPDO of each kind."""
FORCE_TORQUE_BYTES: Final = (8, 8)
IMU_BYTES: Final = (6, 6, 8)
HEARTBEAT_BYTES: Final = 1
ROUNDING: Final = 1e-9
"""Relative slack of the comparisons: a plan that takes its period exactly is one that fits."""


def worst_case_bits(data_bytes: int) -> int:
    """Bits of an 11-bit-identifier frame of n data bytes with worst-case stuffing and 3 bits of interframe space.

    47 + 8n + ⌊(34 + 8n − 1) / 4⌋ (Davis, Burns, Bril, Lukkien 2007).
    """
    return 47 + 8 * data_bytes + (34 + 8 * data_bytes - 1) // 4


HEARTBEAT_BITS: Final = worst_case_bits(HEARTBEAT_BYTES)
BLOCKING_BITS: Final = HEARTBEAT_BITS
"""The longest frame of lower priority that may be on the bus when a SYNC or a command is due (op. cit.)."""

Frames = tuple[tuple[str, int], ...]
"""(name, data bytes) of each frame."""


@dataclass(frozen=True, slots=True)
class BusLoad:
    """The worst cycle of one bus: SYNC, reports, commands; and its heartbeats."""

    bus: str
    bitrate: int
    period_s: float
    reports: Frames
    commands: Frames
    heartbeats: int
    """Nodes that send one, the HAL included."""
    heartbeat_s: float
    first_reports: Frames = ()
    """Beside the worst cycle's, at the first SYNC alone."""

    @property
    def bits(self) -> int:
        """Bits of the worst cycle, its heartbeats apart."""
        return _bits((("SYNC", SYNC_BYTES), *self.reports, *self.commands))

    @property
    def heartbeat_bits(self) -> int:
        """Bits of one heartbeat of every node."""
        return self.heartbeats * HEARTBEAT_BITS

    @property
    def cycle_fraction(self) -> float:
        """Share of a period that SYNC, reports and commands take."""
        return self.bits / (self.bitrate * self.period_s)

    @property
    def heartbeat_fraction(self) -> float:
        """Share of the time that heartbeats take."""
        return self.heartbeat_bits / (self.bitrate * self.heartbeat_s)

    @property
    def fraction(self) -> float:
        """Load over time, every cycle the worst: 1 is full."""
        return self.cycle_fraction + self.heartbeat_fraction

    @property
    def peak_fraction(self) -> float:
        """Load of the worst cycle with all heartbeats and the first reports; over 1 some of these end in the next."""
        return (self.bits + self.heartbeat_bits + _bits(self.first_reports)) / (self.bitrate * self.period_s)

    @property
    def carries(self) -> bool:
        """The load is at most 100 %: nothing starves."""
        return self.fraction <= 1.0 + ROUNDING

    @property
    def report_time_s(self) -> float:
        """From the start of SYNC to the end of the last report [s]."""
        return _bits((("SYNC", SYNC_BYTES), *self.reports)) / self.bitrate

    @property
    def first_report_time_s(self) -> float:
        """What the first reports add at the first SYNC [s]."""
        return _bits(self.first_reports) / self.bitrate

    @property
    def command_time_s(self) -> float:
        """From the start of the first RPDO to the end of the last [s]."""
        return _bits(self.commands) / self.bitrate

    @property
    def blocking_s(self) -> float:
        """What a heartbeat on the bus delays a SYNC, or the first of the commands, by at most [s]."""
        return BLOCKING_BITS / self.bitrate

    def explain(self) -> str:
        """Show the arithmetic in one line."""
        counts = Counter((("SYNC", SYNC_BYTES), *self.reports, *self.commands))
        terms = " + ".join(f"{n}×{name}({worst_case_bits(size)} bit)" for (name, size), n in counts.items())
        return (
            f"{terms} = {self.bits} bit in {self.period_s * 1e3:g} ms at {self.bitrate / 1e6:g} Mbit/s"
            f" = {self.cycle_fraction:.1%}; {self.heartbeats}×heartbeat({HEARTBEAT_BITS} bit) in"
            f" {self.heartbeat_s * 1e3:g} ms = {self.heartbeat_fraction:.1%}; together {self.fraction:.1%}"
        )


@dataclass(frozen=True, slots=True)
class CyclePlan:
    """The worst cycle of a robot over all its buses: slowest reports, computing, slowest commands.

    With a command delay of 2 commands go out after the reports of the next cycle, those of all buses: a bus whose load
    is at most 100 % carries both within that period, unless it waits for the reports of a slower one (`crowded`).
    """

    loads: tuple[BusLoad, ...]
    compute_budget_s: float
    period_s: float
    command_delay_cycles: int

    @property
    def report_time_s(self) -> float:
        """SYNC and reports on the slowest bus [s]."""
        return max(load.report_time_s for load in self.loads)

    @property
    def command_time_s(self) -> float:
        """Commands on the slowest bus [s]."""
        return max(load.command_time_s for load in self.loads)

    @property
    def needed_s(self) -> float:
        """From SYNC to the end of the last command frame [s]."""
        return self.report_time_s + self.compute_budget_s + self.command_time_s

    @property
    def available_s(self) -> float:
        """From SYNC to the SYNC that latches the command [s]."""
        return self.command_delay_cycles * self.period_s

    @property
    def in_time(self) -> bool:
        """Commands arrive before the SYNC that latches them."""
        return self.needed_s <= self.available_s * (1.0 + ROUNDING)

    @property
    def crowded(self) -> bool:
        """Slowest reports and slowest commands, of different buses, do not fit into the period that they share."""
        return self.report_time_s + self.command_time_s > self.period_s * (1.0 + ROUNDING)

    @property
    def blocking_s(self) -> float:
        """What a heartbeat on the slowest bus delays a SYNC, or the first of the commands, by at most [s]."""
        return max(load.blocking_s for load in self.loads)

    @property
    def in_time_if_blocked(self) -> bool:
        """Commands arrive in time even in a worst cycle in which SYNC and commands both wait for a heartbeat."""
        return self.needed_s + 2.0 * self.blocking_s <= self.available_s * (1.0 + ROUNDING)

    @property
    def overloaded(self) -> tuple[BusLoad, ...]:
        """The buses over 100 %."""
        return tuple(load for load in self.loads if not load.carries)

    @property
    def fits(self) -> bool:
        """No bus is over 100 %, and commands are in time."""
        return self.in_time and not self.overloaded

    def timing(self) -> str:
        """Spell out the time of a cycle in one line."""
        return (
            f"reports {_ms(self.report_time_s)} + compute {_ms(self.compute_budget_s)}"
            f" + commands {_ms(self.command_time_s)} = {_ms(self.needed_s)} {'≤' if self.in_time else '>'}"
            f" {_ms(self.available_s)} = {self.command_delay_cycles} × {_ms(self.period_s)}"
        )

    def faults(self) -> tuple[str, ...]:
        """Say, one line a fault, with the arithmetic, why the plan does not fit; empty when it does."""
        faults = []
        if self.overloaded:
            fullest, *others = sorted(self.overloaded, key=lambda load: -load.fraction)
            also = ", ".join(f"{load.bus} ({load.fraction:.1%})" for load in others)
            faults.append(f"bus {fullest.bus} is overloaded: {fullest.explain()}{also and f'; likewise {also}'}")
        if not self.in_time:
            faults.append(f"commands miss their SYNC: {self.timing()}")
        return tuple(faults)

    def remedies(self) -> str:
        """Say what would make it fit; empty when it does."""
        if self.fits:
            return ""
        ways = ["lower rate_hz", "move joints or sensors to another bus"]
        if not self.overloaded:
            ways = ["lower compute_budget_s or rate_hz", "spread joints over buses"]
            if self.needed_s <= 2.0 * self.period_s and self.command_delay_cycles == 1 and not self.crowded:
                ways.append("set command_delay_cycles to 2")
        return ", ".join(ways)


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
        loads.append(
            BusLoad(
                bus=bus.name,
                bitrate=bus.bitrate,
                period_s=robot.period_s,
                reports=tuple(reports),
                commands=commands,
                heartbeats=len(drives) + 1,
                heartbeat_s=robot.safety.heartbeat_s,
                first_reports=tuple(("TPDO2", MODE_BYTES) for _ in drives[len(changing) :]),
            )
        )
    return tuple(loads)


def cycle_plan(robot: RobotDescription) -> CyclePlan:
    """Worst cycle of a robot."""
    return CyclePlan(bus_loads(robot), robot.compute_budget_s, robot.period_s, robot.command_delay_cycles)


def _bits(frames: Frames) -> int:
    return sum(worst_case_bits(size) for _, size in frames)


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3f} ms"
