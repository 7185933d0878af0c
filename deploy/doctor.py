"""What `cosim doctor` finds out about a robot description: bus load, timing of a cycle, limits in the drives' terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from deploy.measured import Comparison, comparison_table
from schemas.bus_load import CyclePlan, cycle_plan
from schemas.robot import Bus, Joint, RobotDescription

DEGREES = 57.29577951308232


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A robot, its worst cycle, and what a log says of its buses."""

    robot: RobotDescription
    plan: CyclePlan
    comparisons: tuple[Comparison, ...] = ()

    @property
    def excesses(self) -> tuple[str, ...]:
        """What was measured above the worst case, a line each."""
        return tuple(line for each in self.comparisons for line in each.excesses())

    @property
    def losses(self) -> tuple[str, ...]:
        """What was late or replaced, a line a bus."""
        return tuple(line for each in self.comparisons if (line := each.measured.complaint()))

    @property
    def healthy(self) -> bool:
        """The plan fits, and nothing measured contradicts it."""
        return self.plan.fits and not self.excesses and not self.losses

    def as_json(self) -> dict[str, Any]:
        """Everything as plain values, SI units in the names."""
        robot, plan = self.robot, self.plan
        measured = {each.load.bus: each.as_json() for each in self.comparisons}
        return {
            "robot": robot.name,
            "rate_hz": robot.rate_hz,
            "command_delay_cycles": robot.command_delay_cycles,
            "fits": plan.fits,
            "faults": list(plan.faults()),
            "above_worst_case": list(self.excesses),
            "timing": {
                "report_time_s": plan.report_time_s,
                "compute_budget_s": plan.compute_budget_s,
                "command_time_s": plan.command_time_s,
                "needed_s": plan.needed_s,
                "available_s": plan.available_s,
                "blocking_s": plan.blocking_s,
            },
            "buses": [
                {
                    "name": load.bus,
                    "bitrate": load.bitrate,
                    "worst_case_bits": load.bits,
                    "heartbeat_bits": load.heartbeat_bits,
                    "worst_case_load": load.fraction,
                    "worst_cycle_load": load.peak_fraction,
                    "report_time_s": load.report_time_s,
                    "command_time_s": load.command_time_s,
                    "arithmetic": load.explain(),
                }
                | measured.get(load.bus, {})
                for load in plan.loads
            ],
            "joints": [
                joint.model_dump(mode="json") | {"torque_limit_per_mille": per_mille(joint)} for joint in robot.joints
            ],
            "force_torque_sensors": [sensor.model_dump(mode="json") for sensor in robot.force_torque_sensors],
            "imus": [imu.model_dump(mode="json") for imu in robot.imus],
            "safety": robot.safety.model_dump(mode="json"),
        }


def examine(robot: RobotDescription, comparisons: tuple[Comparison, ...] = ()) -> Diagnosis:
    """Compute loads and timing."""
    return Diagnosis(robot, cycle_plan(robot), comparisons)


def per_mille(joint: Joint) -> float:
    """Give the torque limit in the drive's unit: ‰ of the rated torque (object 0x6072)."""
    return 1000.0 * joint.torque_limit / (joint.drive.rated_motor_torque * joint.gear_ratio)


def show(diagnosis: Diagnosis, console: Console) -> None:
    """Print the tables, the arithmetic and the verdict."""
    robot, plan = diagnosis.robot, diagnosis.plan
    console.print(
        f"[bold]{robot.name}[/]: {len(robot.joints)} joints, {len(robot.buses)} buses, {robot.rate_hz:g} Hz,"
        f" commands take effect at SYNC {robot.command_delay_cycles} after the measured one; hand frame"
        f" {robot.hand_frame or 'none'}"
    )
    console.print(_joint_table(robot))
    console.print(_limit_table(robot))
    console.print(_bus_table(diagnosis))
    for load in plan.loads:
        console.print(f"{load.bus}: {load.explain()}", highlight=False, soft_wrap=True)
    console.print("busiest cycle: all heartbeats, and after the boot the mode of every drive, fall into the worst one")
    if robot.force_torque_sensors or robot.imus:
        console.print(_sensor_table(robot))
    safety = robot.safety
    console.print(
        f"safety: stop after {safety.missed_commands} missed commands (lockstep: {safety.command_timeout_s:g} s),"
        f" drives hold after {safety.sync_timeout_cycles} cycles without SYNC or RPDO,"
        f" hold ramp {safety.hold_ramp_s:g} s, heartbeat {safety.heartbeat_s:g} s",
        soft_wrap=True,
    )
    verdict = "[green]fits[/]" if plan.in_time else "[red]does not fit[/]"
    console.print(f"timing {verdict}: {plan.timing()}", soft_wrap=True)
    if plan.fits and not plan.in_time_if_blocked:
        console.print(
            f"a heartbeat on the bus delays SYNC and commands by up to {plan.blocking_s * 1e3:.3f} ms each: where both"
            " meet one, a worst cycle's commands may be late",
            soft_wrap=True,
        )
    if plan.fits and plan.crowded:
        console.print(
            f"commands follow the next cycle's reports: {plan.report_time_s * 1e3:.3f} ms of reports and"
            f" {plan.command_time_s * 1e3:.3f} ms of commands on another bus share {plan.period_s * 1e3:.3f} ms: in a"
            " worst cycle the last commands are late",
            soft_wrap=True,
        )
    for load in plan.overloaded:
        console.print(f"load [red]does not fit[/]: bus {load.bus} is overloaded, {load.fraction:.1%}", soft_wrap=True)
    if not plan.fits:
        console.print(f"to make it fit: {plan.remedies()}", soft_wrap=True)
    if diagnosis.comparisons:
        console.print(comparison_table(diagnosis.comparisons))
        for line in diagnosis.losses:
            console.print(f"[red]lost[/]: {line}", soft_wrap=True)
        for line in diagnosis.excesses:
            console.print(f"[red]above worst case[/]: {line}", soft_wrap=True)


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
    for header in ("Mbit/s", "nodes", "reports ms", "commands ms", "load", "busiest\ncycle"):
        table.add_column(header, justify="right")
    for bus, load in zip(diagnosis.robot.buses, diagnosis.plan.loads, strict=True):
        nodes = sum(joint.drive.bus == bus.name for joint in diagnosis.robot.joints)
        table.add_row(
            bus.name,
            _opened(bus),
            f"{bus.bitrate / 1e6:g}",
            str(nodes),
            f"{load.report_time_s * 1e3:.3f}",
            f"{load.command_time_s * 1e3:.3f}",
            f"{load.fraction:.1%}",
            f"{load.peak_fraction:.1%}",
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


def _opened(bus: Bus) -> str:
    plant = "" if bus.plant_channel is None else f" (plant {bus.plant_channel})"
    return f"{bus.interface}:{bus.channel}{plant}"
