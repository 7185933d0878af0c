"""The short table at the end of a run."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from deploy.metrics import CSP, CST, RunMetrics

MODE_NAMES = {CSP: "position", CST: "torque"}


def summary_table(metrics: RunMetrics) -> RenderableType:
    """Two columns, what and how much; below them a line for each bus that lost frames."""
    table = Table(
        title=f"{metrics.scenario} on {metrics.robot}, {metrics.clock}, seed {metrics.seed}", show_header=False
    )
    table.add_column("what", no_wrap=True)
    table.add_column("value", justify="right")
    table.add_row("states / commands / missed", f"{metrics.states} / {metrics.commands} / {metrics.missed_commands}")
    cycle = (metrics.cycle_time_median_s, metrics.cycle_time_p99_s, metrics.cycle_time_max_s)
    if None not in cycle:
        text = " / ".join(f"{time_s * 1e3:.2f}" for time_s in cycle if time_s is not None)
        table.add_row("cycle time, median / 99 % / worst", f"{text} ms")
    if metrics.real_time_factor is not None:
        table.add_row("real-time factor", f"{metrics.real_time_factor:.2f}")
    if metrics.late_cycles:
        table.add_row("late cycles", str(metrics.late_cycles))
    if metrics.hand_error_rms_m is not None and metrics.hand_error_max_m is not None:
        error = f"{metrics.hand_error_rms_m * 1e3:.2f} / {metrics.hand_error_max_m * 1e3:.2f} mm"
        table.add_row("hand error on the path, RMS / worst", error)
    for change in metrics.mode_changes:
        names = " → ".join(MODE_NAMES.get(mode, f"mode {mode}") for mode in (change.from_mode, change.to_mode))
        table.add_row(f"torque step {names} at {change.time_s:.3f} s", f"{change.largest_step:.2%} of the limit")
    for bus in metrics.buses:
        table.add_row(f"load of {bus.bus}, mean / busiest cycle", f"{bus.load_mean:.1%} / {bus.load_max:.1%}")
    table.add_row("warnings / errors", f"{metrics.warnings} / {metrics.errors}")
    if not metrics.log_complete:
        table.add_row("log", "cut short: the recorder was killed")
    losses = [line for bus in metrics.buses if (line := bus.complaint())]
    if losses:
        why = ", though the buses can carry this plan" if metrics.plan_fits else ": the buses cannot carry this plan"
        losses.append(f"late commands act a cycle or more later, replaced frames never{why}; see `cosim doctor --log`")
    return Group(table, *(Text(line, style="yellow") for line in losses))
