"""Estimators compared: velocity and torque of the knee as they come, and bars of the table's figures."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.series import Array
from experiments.figures.drawing import describe, legend, line, tidy

JOINT: Final = "R_KNEE"
NAMES: Final[dict[str, tuple[str, str, dict[str, Any]]]] = {
    "centre": ("Savitzky-Golay, centre", "centre", {"color": "#2166ac", "linewidth": 1.2}),
    "unpredicted": (
        "Savitzky-Golay, centre, velocity not predicted",
        "not\npredicted",
        {"color": "#92c5de", "linewidth": 1.2},
    ),
    "end": ("Savitzky-Golay, end", "end", {"color": "#d95f02", "linewidth": 1.0}),
    "kalman": ("Kalman filter", "Kalman", {"color": "#1b7837", "linewidth": 1.2}),
}
TRUTH: Final[dict[str, Any]] = {"color": "black", "linewidth": 1.2, "linestyle": "--"}
SPAN_S: Final = 0.6
"""Of the swing that is drawn, from its start."""
MEASURES: Final = (
    ("Delay of the velocity", "velocity_delay_s", 1e3, "delay [ms]"),
    ("Velocity error as it comes", "velocity_error_late_rad_s", 1.0, "rms [rad/s]"),
    ("Torque noise in motion", "torque_noise_motion_nm", 1.0, "deviation [N·m]"),
    ("Torque error as it comes", "torque_error_late_nm", 1.0, "rms [N·m]"),
    ("Swing, largest error", "position_error_max_rad", 1e3, "qᵈ − q [mrad]"),
    ("Force, rms error / amplitude", "force_error_rms_ratio", 100.0, "error [%]"),
)


def estimators_figure(estimates: dict[str, Any], metrics: dict[str, dict[str, float]]) -> Figure:
    """Draw what each estimator made of the knee at the swing's start, and compare figures.

    Args:
        estimates: `experiments.estimators.Estimates` of each estimator whose run finished.
        metrics: of each estimator, by the names of the table.

    """
    figure = Figure(figsize=(11.0, 10.0), layout="constrained")
    figure.suptitle("Estimators, each in control of the leg: against the plant's truth")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.0, 1.05))
    above, below = (figure.add_subfigure(grid[row, 0]) for row in range(2))
    axes = above.subplots(1, 2)
    for axis, field, title, unit in (
        (axes[0], "velocity", "Knee velocity", "velocity [rad/s]"),
        (axes[1], "torque", "Knee torque, motor and friction", "torque [N·m]"),
    ):
        _signals(axis, estimates, field)
        describe(axis, f"{title}, as it comes", unit)
    bars = below.subplots(2, 3)
    for axis, (title, metric, factor, unit) in zip(bars.flat, MEASURES, strict=True):
        _bars(axis, {name: factor * of[metric] for name, of in metrics.items() if metric in of})
        describe(axis, title, unit)
    tidy([*axes, *bars.flat])
    legend(above, [*axes], columns=4)
    return figure


def _signals(axis: Axes, estimates: dict[str, Any], field: str) -> None:
    for number, (name, each) in enumerate(estimates.items()):
        if name == "unpredicted":
            continue
        label, _, style = NAMES[name]
        joint = each.joints.index(JOINT)
        chosen = each.time_s < each.time_s[0] + SPAN_S
        time_s: Array = each.time_s[chosen]
        line(axis, time_s, getattr(each, field)[chosen, joint], label=label, **style)
        if number == 0:
            label = f"truth, with {NAMES[name][1]} in control"
            line(axis, time_s, getattr(each, f"true_{field}")[chosen, joint], label=label, **TRUTH, zorder=3)
        axis.set_xlim(time_s[0], time_s[-1])
    axis.set_xlabel("time [s]")


def _bars(axis: Axes, values: dict[str, float]) -> None:
    for number, (name, (_, _, style)) in enumerate(NAMES.items()):
        value = values.get(name, float("nan"))
        known = bool(np.isfinite(value))
        axis.bar(number, value if known else 0.0, 0.6, color=style["color"])
        text = f"{value:.3g}" if known else "none"
        axis.annotate(
            text, (number, value if known else 0.0), (0, 2), textcoords="offset points", ha="center", fontsize=8
        )
    axis.set_xticks(range(len(NAMES)), [word for _, word, _ in NAMES.values()])
    axis.set_xlabel("estimator [–]")
    axis.set_axisbelow(True)
    axis.margins(y=0.15)
