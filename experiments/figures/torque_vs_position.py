"""Fig. 4 of [Del Prete 2016], motion and errors of two joints, and the ratios of Tables 2 and 3 beside the paper's."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from deploy.series import RunSeries
from experiments.figures.drawing import THIN, common_limits, describe, legend, line, tidy
from experiments.leg_signals import Motion

JOINTS: Final = {"R_HIP_R": "Hip roll", "R_ANKLE_P": "Ankle pitch"}
"""Of the paper's figure."""
DRAWN: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "position": ("position control", {"color": "#b2182b", "linewidth": 1.3}),
    "k6_1": ("torque control, K₆ = 1", {"color": "#2166ac", "linewidth": 1.5}),
    "k6_0.25": ("torque control, K₆ = 0.25", {"color": "#1b7837", "linewidth": 1.3}),
}
GAIN_STYLE: Final = {"k6_1": "#2166ac", "k6_0.5": "#67a9cf", "k6_0.25": "#1b7837", "k6_0.1": "#a6a61d"}
MEASURES: Final = {"avg": "Average error (Table 2)", "max": "Largest error (Table 3)"}
SPREAD: Final = 0.17
"""Between the marks of a joint."""
AXIS_WORDS: Final = {"P": "pitch", "R": "roll", "Y": "yaw"}
Ratios = dict[str, dict[str, dict[str, float]]]
"""Measure → run → joint → error over the position control's."""


def torque_vs_position_figure(
    runs: dict[str, RunSeries], motions: dict[str, Motion], ratios: Ratios, paper: Ratios
) -> Figure:
    """Draw q^d and true position, errors, and the ratios of all joints.

    Args:
        runs: for the joints' names.
        motions: of the swing, by run; the three of `DRAWN` are drawn.
        ratios: of the errors to the position control's.
        paper: the same of the paper.

    """
    names = next(iter(runs.values())).run.robot.description.joint_names
    figure = Figure(figsize=(11.0, 10.5), layout="constrained")
    figure.suptitle("Stairs-climbing swing: torque control through the position interface against position control")
    axes = figure.subplots(3, 2, height_ratios=(2.0, 2.6, 3.0))
    for column, (joint, title) in enumerate(JOINTS.items()):
        _motion(axes[0, column], motions["position"], names.index(joint), title)
        _errors(axes[1, column], motions, names.index(joint), title)
    for column, (measure, title) in enumerate(MEASURES.items()):
        _ratios(axes[2, column], ratios[measure], paper[measure])
        describe(axes[2, column], title, "error over position control's [1]")
    limits = [axis.get_ylim() for axis in axes[2]]
    for axis in axes[2]:
        axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    tidy([*axes.flat])
    for axis in axes[2]:
        axis.grid(visible=True, which="minor", axis="y", alpha=0.12)
    legend(figure, [axes[0, 0], axes[1, 0], axes[2, 0]], columns=4)
    return figure


def joint_word(name: str) -> str:
    """Give a leg's joint in words: `R_HIP_P` is the hip pitch."""
    place, _, axis = name.removeprefix("R_").partition("_")
    return f"{place} {AXIS_WORDS.get(axis, axis)}".strip().lower()


def _motion(axis: Axes, motion: Motion, joint: int, title: str) -> None:
    true = motion.desired[:, joint] - motion.error[:, joint]
    line(axis, motion.time_s, motion.desired[:, joint], color="black", linewidth=1.4, label="qᵈ")
    line(axis, motion.time_s, true, label="true, position control", **DRAWN["position"][1] | {"linestyle": "--"})
    describe(axis, f"{title}: reference and position", "angle [rad]")
    axis.set_xlabel("time [s]")


def _errors(axis: Axes, motions: dict[str, Motion], joint: int, title: str) -> None:
    peaks = []
    for name, (label, style) in DRAWN.items():
        error = 1e3 * motions[name].error[:, joint]
        peaks.append(f"{np.abs(error).max():.1f}")
        line(axis, motions[name].time_s, error, label=f"error, {label}", **style)
    axis.axhline(0.0, **THIN)
    axis.set_ylim(common_limits([1e3 * motions[name].error[:, joint] for name in DRAWN]))
    plain, stiff, soft = peaks
    describe(axis, f"{title}: largest {plain} (position), {stiff} (K₆ = 1), {soft} (0.25) mrad", "qᵈ − q [mrad]")
    axis.set_xlabel("time [s]")


def _ratios(axis: Axes, ours: dict[str, dict[str, float]], paper: dict[str, dict[str, float]]) -> None:
    joints = [*next(iter(ours.values()))]
    middle = 0.5 * (len(GAIN_STYLE) - 1)
    for number, (name, colour) in enumerate(GAIN_STYLE.items()):
        places = np.arange(len(joints)) + SPREAD * (number - middle)
        gain = name.removeprefix("k6_")
        for values, marker, filled, whose in ((paper, "D", False, "paper"), (ours, "o", True, "here")):
            axis.add_line(
                Line2D(
                    places,
                    [values[name][joint] for joint in joints],
                    linestyle="none",
                    marker=marker,
                    markersize=6.0,
                    color=colour,
                    markerfacecolor=colour if filled else "white",
                    label=f"K₆ = {gain}, {whose}",
                )
            )
    axis.set_yscale("log")
    axis.axhline(1.0, **THIN)
    everything = [v for values in (ours, paper) for name in GAIN_STYLE for v in values[name].values()]
    axis.set_ylim(0.7 * min(everything), 1.5 * max(everything))
    axis.set_xlim(-0.5, len(joints) - 0.5)
    axis.set_xticks(range(len(joints)), [joint_word(name) for name in joints])
    axis.set_xlabel("joint [–]")
