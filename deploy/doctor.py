"""What `cosim doctor` finds out about a robot description: bus load, timing of a cycle, limits in the drives' terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from schemas.bus_load import BusLoad, bus_loads
from schemas.robot import Joint, RobotDescription

DEGREES = 57.29577951308232


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Loads and the time a cycle takes at worst: slowest reports, computing, slowest commands."""

    robot: RobotDescription
    loads: tuple[BusLoad, ...]

    @property
    def report_time_s(self) -> float:
        """SYNC and reports on the slowest bus."""
        return max(load.report_time_s for load in self.loads)

    @property
    def command_time_s(self) -> float:
        """Commands on the slowest bus."""
        return max(load.command_time_s for load in self.loads)

    @property
    def needed_s(self) -> float:
        """From SYNC to the end of the last command frame."""
        return self.report_time_s + self.robot.compute_budget_s + self.command_time_s

    @property
    def available_s(self) -> float:
        """From SYNC to the SYNC that latches the command."""
        return self.robot.command_delay_cycles * self.robot.period_s

    @property
    def fits(self) -> bool:
        """Commands arrive before the SYNC that latches them, and no bus is over 100 %."""
        return self.needed_s <= self.available_s and all(load.fraction <= 1.0 for load in self.loads)

    def timing(self) -> str:
        """Spell out the arithmetic in one line."""
        relation = "≤" if self.needed_s <= self.available_s else ">"
        return (
            f"reports {_ms(self.report_time_s)} + compute {_ms(self.robot.compute_budget_s)}"
            f" + commands {_ms(self.command_time_s)} = {_ms(self.needed_s)} {relation} {_ms(self.available_s)}"
            f" = {self.robot.command_delay_cycles} × {_ms(self.robot.period_s)}"
        )

    def as_json(self) -> dict[str, Any]:
        """Everything as plain values, SI units in the names."""
        robot = self.robot
        return {
            "robot": robot.name,
            "rate_hz": robot.rate_hz,
            "command_delay_cycles": robot.command_delay_cycles,
            "fits": self.fits,
            "timing": {
                "report_time_s": self.report_time_s,
                "compute_budget_s": robot.compute_budget_s,
                "command_time_s": self.command_time_s,
                "needed_s": self.needed_s,
                "available_s": self.available_s,
            },
            "buses": [
                {
                    "name": load.bus,
                    "bitrate": load.bitrate,
                    "worst_case_bits": load.bits,
                    "worst_case_load": load.fraction,
                    "report_time_s": load.report_time_s,
                    "command_time_s": load.command_time_s,
                    "arithmetic": load.explain(),
                }
                for load in self.loads
            ],
            "joints": [
                joint.model_dump(mode="json") | {"torque_limit_per_mille": per_mille(joint)} for joint in robot.joints
            ],
            "force_torque_sensors": [sensor.model_dump(mode="json") for sensor in robot.force_torque_sensors],
            "imus": [imu.model_dump(mode="json") for imu in robot.imus],
            "safety": robot.safety.model_dump(mode="json"),
        }


def examine(robot: RobotDescription) -> Diagnosis:
    """Compute loads and timing."""
    return Diagnosis(robot, bus_loads(robot))


def per_mille(joint: Joint) -> float:
    """Give the torque limit in the drive's unit: ‰ of the rated torque (object 0x6072)."""
    return 1000.0 * joint.torque_limit / (joint.drive.rated_motor_torque * joint.gear_ratio)


def show(robot: RobotDescription, diagnosis: Diagnosis, console: Console) -> None:
    """Print the tables."""
    console.print(
        f"[bold]{robot.name}[/]: {len(robot.joints)} joints, {len(robot.buses)} buses, {robot.rate_hz:g} Hz,"
        f" commands take effect at SYNC {robot.command_delay_cycles} after the measured one; hand frame"
        f" {robot.hand_frame or 'none'}"
    )
    console.print(_joint_table(robot))
    console.print(_limit_table(robot))
    console.print(_bus_table(diagnosis))
    for load in diagnosis.loads:
        console.print(f"{load.bus}: {load.explain()}", highlight=False, soft_wrap=True)
    if robot.force_torque_sensors or robot.imus:
        console.print(_sensor_table(robot))
    safety = robot.safety
    console.print(
        f"safety: stop after {safety.missed_commands} missed commands (lockstep: {safety.command_timeout_s:g} s),"
        f" drives hold after {safety.sync_timeout_cycles} cycles without SYNC or RPDO,"
        f" hold ramp {safety.hold_ramp_s:g} s, heartbeat {safety.heartbeat_s:g} s",
        soft_wrap=True,
    )
    verdict = "[green]fits[/]" if diagnosis.fits else "[red]does not fit[/]"
    console.print(f"timing {verdict}: {diagnosis.timing()}", soft_wrap=True)
    if not diagnosis.fits:
        console.print("raise command_delay_cycles, lower rate_hz or compute_budget_s, or spread joints over buses")


def _joint_table(robot: RobotDescription) -> Table:
    table = Table(title="joints", title_justify="left")
    for header in ("joint", "bus", "node", "drive"):
        table.add_column(header, no_wrap=True)
    for header in ("gear", "N² J\nkg·m²", "encoder\ncounts", "k_p\nN·m/rad", "k_d\nN·m·s/rad", "dead zone\nN·m"):
        table.add_column(header, justify="right", no_wrap=True)
    for joint in robot.joints:
        drive = joint.drive
        table.add_row(
            joint.name,
            drive.bus,
            str(drive.node_id),
            drive.kind,
            f"{joint.gear_ratio:g}",
            f"{joint.rotor_inertia * joint.gear_ratio**2:.3g}",
            f"{joint.encoder_counts}",
            f"{drive.position_gain:g}",
            f"{drive.velocity_gain:g}",
            f"{drive.dead_zone:g}",
        )
    return table


def _limit_table(robot: RobotDescription) -> Table:
    table = Table(title="limits", title_justify="left")
    table.add_column("joint", no_wrap=True)
    for header in ("range °", "speed °/s", "torque N·m", "torque rate N·m/s", "torque ‰ rated"):
        table.add_column(header, justify="right")
    for joint in robot.joints:
        table.add_row(
            joint.name,
            f"{joint.position_min * DEGREES:.0f} … {joint.position_max * DEGREES:.0f}",
            f"{joint.velocity_limit * DEGREES:.0f}",
            f"{joint.torque_limit:g}",
            f"{joint.torque_rate_limit:g}",
            f"{per_mille(joint):.0f}",
        )
    return table


def _bus_table(diagnosis: Diagnosis) -> Table:
    table = Table(title="buses, worst case", title_justify="left")
    for header in ("bus", "opened as"):
        table.add_column(header, no_wrap=True)
    for header in ("Mbit/s", "nodes", "reports ms", "commands ms", "load"):
        table.add_column(header, justify="right")
    for bus, load in zip(diagnosis.robot.buses, diagnosis.loads, strict=True):
        nodes = sum(joint.drive.bus == bus.name for joint in diagnosis.robot.joints)
        table.add_row(
            bus.name,
            f"{bus.interface}:{bus.channel}",
            f"{bus.bitrate / 1e6:g}",
            str(nodes),
            f"{load.report_time_s * 1e3:.3f}",
            f"{load.command_time_s * 1e3:.3f}",
            f"{load.fraction:.0%}",
        )
    return table


def _sensor_table(robot: RobotDescription) -> Table:
    table = Table(title="sensors", title_justify="left")
    for header in ("sensor", "kind", "frame", "bus", "identifiers", "resolution"):
        table.add_column(header)
    for sensor in robot.force_torque_sensors:
        resolution = f"{sensor.force_resolution:g} N, {sensor.torque_resolution:g} N·m"
        identifiers = f"0x{sensor.can_id:03X}, 0x{sensor.can_id + 1:03X}"
        table.add_row(sensor.name, "force/torque", sensor.frame, sensor.bus, identifiers, resolution)
    for imu in robot.imus:
        identifiers = ", ".join(f"0x{imu.base_id + offset:03X}" for offset in (0x32, 0x34, 0x21))
        table.add_row(imu.name, "IMU", imu.frame, imu.bus, identifiers, "2⁻⁹ rad/s, 2⁻⁸ m/s²")
    return table


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3f} ms"
