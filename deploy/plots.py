"""Figures of a run: torques at a mode change, hand path, joint positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.metrics import CSP, CST, ModeChange, path_phases
from deploy.series import Array, RunSeries

BEFORE_S = 0.05
AFTER_S = 0.15
SMALLEST_SPAN = 1.0
"""[N·m] or [°]; a smaller range of values is not blown up to the height of the plot."""
STYLE: dict[str, dict[str, Any]] = {
    "reference": {"color": "black", "linewidth": 1.6},
    "computed": {"color": "#7b3294", "linewidth": 1.2},
    "integral": {"color": "#2166ac", "linewidth": 1.2},
    "measured": {"color": "#888888", "linewidth": 1.0, "linestyle": "--"},
    "true": {"color": "#e08214", "linewidth": 0.9},
}
"""The colours of Fig. 3 of [Benallegue 2021]; what only the plant knows is orange."""
CHANGE_COLOUR = "#d6604d"
TORQUE_MODE_COLOUR = "#eeeeee"


def transition_figure(series: RunSeries, change: ModeChange) -> Figure:
    """Torques of every joint around a mode change, as Fig. 3 of [Benallegue 2021].

    Black: the torque reference given to the motors (in position mode there is none); purple: the computed torque uʳ;
    blue: the integral term, all three at the time when the command takes effect; grey: the motor torque measured from
    the current; orange: the true one at the firmware's rate.
    """
    robot = series.run.robot.description
    names = robot.joint_names
    figure, axes = _grid(len(names), f"Torques at the change of mode at {change.time_s:.3f} s ({_direction(change)})")
    trace, state = series.trace, series.state
    effect_s = trace.time_s + robot.command_delay_cycles * robot.period_s
    ticks, trace_ms = _window(effect_s, change)
    cycles, state_ms = _window(state.time_s, change)
    truth_ms, true = _true_torque(series, change)
    in_torque = trace.torque_mode[ticks][:, None]
    commanded = np.where(in_torque, trace.torque_commanded[ticks], np.nan)
    integral = np.where(in_torque, trace.torque_integral[ticks], np.nan)
    for j, (axis, name) in enumerate(zip(axes, names, strict=True)):
        axis.plot(truth_ms, true[:, j], label="true motor torque", **STYLE["true"])
        axis.plot(state_ms, state.motor_torque[cycles][:, j], label="measured motor torque", **STYLE["measured"])
        axis.plot(trace_ms, trace.torque_reference[ticks][:, j], label="computed torque uʳ", **STYLE["computed"])
        axis.plot(trace_ms, integral[:, j], label="integral term L s", **STYLE["integral"])
        axis.plot(trace_ms, commanded[:, j], label="reference torque u", **STYLE["reference"])
        axis.axvline(0.0, color=CHANGE_COLOUR, linewidth=0.8)
        axis.set_title(f"{name}, step {change.torque_step[j]:.2%} of the limit", fontsize=9)
    _finish(figure, axes, "time from the change [ms]", "torque [N·m]")
    return figure


def hand_figure(series: RunSeries) -> Figure | None:
    """Hand path, desired and true, in the plane it extends most in, and the error over time; None without a path."""
    trace, truth = series.trace, series.truth
    _, of_trace, of_truth = np.intersect1d(trace.sequence, truth.sequence, return_indices=True)
    mask = path_phases(trace)[of_trace] if of_trace.size else np.zeros(0, np.bool_)
    mask &= np.isfinite(truth.hand[of_truth]).all(axis=1)
    if not mask.any():
        return None
    desired, true = trace.hand_desired[of_trace][mask], truth.hand[of_truth][mask]
    phases = np.array(trace.phase)[of_trace][mask]
    names = list(dict.fromkeys(phases.tolist()))
    figure = Figure(figsize=(5.0 * (len(names) + 1), 4.6), layout="constrained")
    axes = figure.subplots(1, len(names) + 1)
    for axis, phase in zip(axes, names, strict=False):
        here = phases == phase
        a, b = _plane(desired[here])
        axis.plot(desired[here][:, a], desired[here][:, b], label="desired", **STYLE["reference"])
        axis.plot(true[here][:, a], true[here][:, b], label="true", **STYLE["true"])
        axis.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]", title=f"hand in the world, {phase}")
        axis.set_aspect("equal", adjustable="datalim")
        axis.legend(fontsize=8)
    time_s = trace.time_s[of_trace][mask]
    error_mm = np.linalg.norm(desired - true, axis=1) * 1e3
    for phase in names:
        here = phases == phase
        rms = float(np.sqrt(np.mean(error_mm[here] ** 2)))
        axes[-1].plot(time_s[here], error_mm[here], label=f"{phase}: {rms:.2f} mm RMS", linewidth=1.2)
    axes[-1].set(xlabel="time [s]", ylabel="distance desired to true [mm]", title="hand error", ylim=(0.0, None))
    axes[-1].legend(fontsize=8)
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure


def joints_figure(series: RunSeries) -> Figure:
    """Measured joint positions over the whole run, and their reference where the robot is in position mode."""
    names = series.run.robot.description.joint_names
    figure, axes = _grid(len(names), "Joint positions (torque mode shaded)")
    trace, state = series.trace, series.state
    reference = np.degrees(np.where(trace.torque_mode[:, None], np.nan, trace.position_reference))
    for j, (axis, name) in enumerate(zip(axes, names, strict=True)):
        axis.plot(state.time_s, np.degrees(state.position[:, j]), label="measured", **STYLE["integral"])
        axis.plot(trace.time_s, reference[:, j], label="reference", color="black", linewidth=1.0, linestyle="--")
        for start_s, end_s in _spans(trace.time_s, trace.torque_mode):
            axis.axvspan(start_s, end_s, color=TORQUE_MODE_COLOUR, zorder=0)
        axis.set_title(name, fontsize=9)
    _finish(figure, axes, "time [s]", "position [°]")
    return figure


def _window(time_s: Array, change: ModeChange) -> tuple[npt.NDArray[np.bool_], Array]:
    """Mask (K,) of the times around a change, and these times from the change on [ms]."""
    mask = (time_s >= change.time_s - BEFORE_S) & (time_s <= change.time_s + AFTER_S)
    return mask, (time_s[mask] - change.time_s) * 1e3


def _true_torque(series: RunSeries, change: ModeChange) -> tuple[Array, Array]:
    """Give times from the change [ms] and true motor torque (M, n) [N·m] of the firmware's steps around it."""
    period_s = series.run.robot.description.period_s
    mask, end_ms = _window(series.truth.time_s, change)
    torque = series.truth.motor_torque_substeps[mask]
    count, substeps, n = torque.shape
    offset_ms = (np.arange(substeps) / max(substeps, 1) - 1.0) * period_s * 1e3
    return (end_ms[:, None] + offset_ms).ravel(), torque.reshape(count * substeps, n)


def _spans(time_s: Array, mask: npt.NDArray[np.bool_]) -> list[tuple[float, float]]:
    """First and last time of each stretch in which the mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return [(float(time_s[first]), float(time_s[end - 1])) for first, end in edges.reshape(-1, 2)]


def _grid(count: int, title: str) -> tuple[Figure, list[Axes]]:
    columns = min(3, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(4.2 * columns, 2.5 * rows + 0.9), layout="constrained")
    figure.suptitle(title)
    axes = list(np.atleast_1d(figure.subplots(rows, columns, sharex=True, squeeze=False)).flat)
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def _finish(figure: Figure, axes: Sequence[Axes], x_label: str, y_label: str) -> None:
    last_of_column = axes[-min(3, len(axes)) :]
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
        low, high = axis.get_ylim()
        if high - low < SMALLEST_SPAN:
            middle = 0.5 * (low + high)
            axis.set_ylim(middle - 0.5 * SMALLEST_SPAN, middle + 0.5 * SMALLEST_SPAN)
    for axis in last_of_column:
        axis.set_xlabel(x_label, fontsize=9)
        axis.tick_params(labelbottom=True)
    figure.supylabel(y_label, fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9, frameon=False)


def _plane(points: Array) -> tuple[int, int]:
    """Pick the two world axes along which points (K, 3) extend most, in order."""
    first, second = sorted(np.argsort(np.ptp(points, axis=0))[-2:].tolist())
    return first, second


def _direction(change: ModeChange) -> str:
    names = {CSP: "position", CST: "torque"}
    return f"{names.get(change.from_mode, change.from_mode)} to {names.get(change.to_mode, change.to_mode)}"
