"""What a log says of each bus beside its worst case: `cosim doctor --log`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from deploy.errors import ReportError, UsageError
from deploy.loads import BusMetrics, bus_metrics
from schemas.base import Clock
from schemas.bus_load import BusLoad, CyclePlan, cycle_plan
from schemas.log import LogReader
from schemas.messages import BusStatistics
from schemas.robot import RobotDescription
from schemas.topics import LOAD_PREFIX, decode

ROUNDING_S: Final = 1e-8
"""Of times that the statistics give as sums of whole nanoseconds."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One bus: worst case, as the description has it, and measured.

    Beside the plan's times the worst completions count what is seldom, and left out there: a SYNC may find a heartbeat
    on the bus, and so may the first command (`BusLoad.blocking_s`); at the first SYNC every drive tells its
    mode; and with a command delay of 2 commands and the next cycle's reports may share the bus.
    """

    load: BusLoad
    plan: CyclePlan
    measured: BusMetrics
    realtime: bool = False
    """The run's clock: delays of the machine are in the measured times."""

    @property
    def report_end_s(self) -> float:
        """Latest end of a report after the time of its SYNC [s], at worst."""
        load = self.load
        return load.blocking_s + load.report_time_s + load.first_report_time_s + self._shared * load.command_time_s

    @property
    def command_end_s(self) -> float:
        """Latest end of a command after the time of the SYNC that it answers [s], at worst."""
        load, plan = self.load, self.plan
        ready = max(each.blocking_s + each.report_time_s + each.first_report_time_s for each in plan.loads)
        ready += plan.compute_budget_s
        return ready + load.blocking_s + load.command_time_s + self._shared * load.report_time_s

    @property
    def _shared(self) -> bool:
        return self.plan.command_delay_cycles > 1

    def excesses(self) -> tuple[str, ...]:
        """Name what was measured above the worst case, a line each; of a plan that does not fit nothing is bounded."""
        if not self.plan.fits:
            return ()
        measured, load = self.measured, self.load
        pairs = (
            ("mean load", measured.load_mean, load.fraction, "{:.1%}", 0.0),
            ("load of the busiest cycle", measured.load_max, load.peak_fraction, "{:.1%}", 0.0),
            ("last report", measured.report_end_max_s * 1e3, self.report_end_s * 1e3, "{:.3f} ms", 1e3 * ROUNDING_S),
            ("last command", measured.command_end_max_s * 1e3, self.command_end_s * 1e3, "{:.3f} ms", 1e3 * ROUNDING_S),
        )
        reason = "the arithmetic or the log is wrong"
        if measured.unplanned:
            reason = f"{measured.unplanned} EMCY, SDO, NMT or foreign frames, which it leaves out, were on the bus"
        if self.realtime:
            reason = "on the realtime clock it leaves out the boot and what the machine was late"
        return tuple(
            f"bus {load.bus}: {what} {form.format(value)} is above its worst case of {form.format(bound)}; {reason}"
            for what, value, bound, form, slack in pairs
            if value > bound + slack
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "worst_case_report_end_s": self.report_end_s,
            "worst_case_command_end_s": self.command_end_s,
            "measured": asdict(self.measured),
        }


def compare(log: Path, robot: RobotDescription | None = None) -> tuple[RobotDescription, tuple[Comparison, ...]]:
    """Read the statistics of a log's buses; returns the log's robot, and a comparison of each bus.

    Raises:
        LogError: the file is no log.
        UsageError: the log is of another robot than `robot`, or of another plan.
        ReportError: it holds no bus statistics.

    """
    reader = LogReader(log)
    logged = reader.run.robot.description
    plan = cycle_plan(logged)
    if robot is not None and cycle_plan(robot) != plan:
        raise UsageError(
            f"--log {log}: made with another plan ({logged.name} at {logged.rate_hz:g} Hz) than that of {robot.name} at"
            f" {robot.rate_hz:g} Hz; leave out --robot to examine the log's own"
        )
    topics = [LOAD_PREFIX + bus.name for bus in logged.buses]
    found = bus_metrics(logged, (decode(BusStatistics, record.data) for record in reader.records(topics)))
    if not found:
        raise ReportError(
            f"{log}: holds no bus statistics ({LOAD_PREFIX}…): they come from a simulated plant on virtual buses"
        )
    by_bus = {metrics.bus: metrics for metrics in found}
    realtime = reader.run.scenario.clock is Clock.REALTIME
    return logged, tuple(
        Comparison(load, plan, by_bus[load.bus], realtime) for load in plan.loads if load.bus in by_bus
    )


def comparison_table(comparisons: tuple[Comparison, ...]) -> Table:
    """Worst case and measured, one below the other."""
    table = Table(title="buses, worst case and measured; times in ms after SYNC", title_justify="left")
    for header in ("bus", ""):
        table.add_column(header, no_wrap=True)
    headers = ("load", "busiest\ncycle", "last\nreport", "last\ncommand", "late", "replaced")
    for header in headers:
        table.add_column(header, justify="right", no_wrap=True)
    for each in comparisons:
        load, measured = each.load, each.measured
        worst = (load.fraction, load.peak_fraction, each.report_end_s, each.command_end_s)
        found = (measured.load_mean, measured.load_max, measured.report_end_max_s, measured.command_end_max_s)
        table.add_row(load.bus, "worst", *_cells(load, worst), "", "")
        table.add_row(
            "", "measured", *_cells(load, found), str(measured.late), str(measured.replaced), end_section=True
        )
    return table


def _cells(load: BusLoad, figures: tuple[float, float, float, float]) -> tuple[str, ...]:
    mean, busiest, report_s, command_s = figures
    command = f"{command_s * 1e3:.3f}" if load.commands else "none"
    return f"{mean:.1%}", f"{busiest:.1%}", f"{report_s * 1e3:.3f}", command
