"""Fig. 6 of [Benallegue 2021]: the pushed hand's errors with a witness joint, without and with the compliance."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.series import RunSeries
from experiments.figures.drawing import (
    RED,
    TRUE,
    align_zeros,
    common_limits,
    component_lines,
    describe,
    end,
    headroom,
    legend,
    line,
    name_events,
    norms,
    shade_events,
    tidy,
    torque_mode_start,
    twin,
)
from experiments.hand_runs import hand_error

VARIANTS: Final = {"without": "Without null-space compliance", "with": "With null-space compliance"}
"""From top to bottom."""
VARIANT_STYLE: Final[dict[str, dict[str, Any]]] = {
    "without": {**TRUE, "linestyle": "--"},
    "with": {**TRUE, "linewidth": 1.8},
}
LEAST_MM: Final = 1.0
LEAST_DEG: Final = 1.0
"""Smaller motions are not blown up to the height of the plot."""


def null_space_figure(runs: dict[str, RunSeries], elbow: str) -> Figure:
    """Draw hand errors and the joint that moves most, a row a run, and below how far the elbow goes in each.

    Args:
        runs: `without` and `with`, or one of them.
        elbow: frame whose displacement is drawn.

    """
    names = [name for name in VARIANTS if name in runs]
    joint = _witness(runs[names[-1]])
    figure = Figure(figsize=(10.0, 2.7 * len(names) + 3.0), layout="constrained")
    figure.suptitle("Null-space compliance: the hand is pushed, then the elbow")
    axes = figure.subplots(len(names) + 1, 1, sharex=True, squeeze=False)[:, 0]
    rights = []
    for axis, name in zip(axes, names, strict=False):
        rights.append(_errors(axis, runs[name], joint))
        describe(axis, f"{VARIANTS[name]}: {_largest(runs[name])}", "hand error [mm]")
    for group, least in ((axes[:-1], LEAST_MM), (rights, LEAST_DEG)):
        limits = common_limits([line.get_ydata() for axis in group for line in axis.lines], least)
        for axis in group:
            axis.set_ylim(limits)
            headroom(axis)
    for axis, right, name in zip(axes, rights, names, strict=False):
        align_zeros(axis, right)
        shade_events(right, runs[name])
        name_events(axis, runs[name])
    _elbow(axes[-1], runs, names, elbow)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(0.0, max(float(runs[name].state.time_s[-1]) for name in names))
    tidy([*axes])
    legend(figure, [axes[0], rights[0], axes[-1]], columns=3)
    return figure


def _errors(axis: Axes, series: RunSeries, joint: int) -> Axes:
    """Draw the true hand's error; the angle of a joint on the axis at the right, which is returned."""
    truth = series.truth
    name = series.run.robot.description.joint_names[joint].replace("_", " ")
    right = twin(axis, f"{name} [°]", RED)
    if len(truth.time_s):
        last = end(series)
        moved = np.degrees(truth.position[:last, joint] - truth.position[torque_mode_start(series), joint])
        style = {"color": RED, "linewidth": 1.3, "linestyle": "--"}
        line(right, truth.time_s[:last], moved, **style, label=f"{name} from its start (right axis)")
    time_s, error = hand_error(series)
    component_lines(axis, time_s, error * 1e3, "hand error {}, true − desired")
    return right


def _elbow(axis: Axes, runs: dict[str, RunSeries], names: list[str], elbow: str) -> None:
    farthest = []
    for name in names:
        truth = runs[name].truth
        if elbow not in truth.frames or not len(truth.time_s):
            continue
        last = end(runs[name])
        path = truth.frames[elbow][:last]
        moved_cm = norms(path - path[torque_mode_start(runs[name])]) * 1e2
        farthest.append(f"{moved_cm.max():.2g} cm {name}")
        line(axis, truth.time_s[:last], moved_cm, label=f"true elbow, {name}", **VARIANT_STYLE[name])
    title = "Elbow's true displacement"
    describe(axis, f"{title}: up to {', '.join(farthest)}" if farthest else title, "distance [cm]")
    axis.set_ylim(common_limits([line.get_ydata() for line in axis.lines], 1.0))
    shade_events(axis, runs[names[-1]])


def _witness(series: RunSeries) -> int:
    """Index of the joint that moves most in torque mode."""
    moving = series.truth.position[torque_mode_start(series) : end(series)]
    return int(np.argmax(np.ptp(moving, axis=0))) if len(moving) else 0


def _largest(series: RunSeries) -> str:
    _, error = hand_error(series)
    if not len(error):
        return "no hand task"
    return f"hand error up to {norms(error).max() * 1e3:.1f} mm"
