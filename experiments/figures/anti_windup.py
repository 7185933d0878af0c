"""Fig. 5 of [Benallegue 2021]: the additional torque while the hand is held out of its place, and after the release."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from deploy.series import Array, RunSeries
from experiments.figures.drawing import (
    RED,
    THIN,
    align_zeros,
    common_limits,
    component_lines,
    describe,
    headroom,
    legend,
    line,
    measured_force,
    tidy,
    top_text,
    twin,
)
from experiments.hand_runs import WINDOW_S, oscillation

METHODS: Final = {
    "none": "Without anti-windup",
    "scaling": r"Scaling, $\tilde{u}_K = \lambda_w u_K$ (10)",
    "qp": "QP-based anti-windup (11)",
    "conditioned": "(11) and back-calculation",
}
"""From top to bottom."""
BEFORE_S: Final = 1.0
AFTER_S: Final = 3.5
"""Of the push and the release: what the torques are drawn for."""
HAND_BEFORE_S: Final = 0.3
HAND_AFTER_S: Final = 2.0
"""Of the release: what the hand is drawn for."""
LEAST_MM: Final = 2.0
"""A smaller motion is not blown up to the height of the plot."""


def anti_windup_figure(runs: dict[str, RunSeries], push: tuple[float, float]) -> Figure:
    """Draw the additional torque of the elbow with the measured force, and the hand's way, a row a method.

    Args:
        runs: by method: `none`, `scaling`, `qp`, or some of them.
        push: when the hand is taken, and when it is let go [s].

    """
    methods = [method for method in METHODS if method in runs]
    figure = Figure(figsize=(12.5, 2.6 * len(methods) + 1.1), layout="constrained")
    grid = figure.subplots(len(methods), 2, squeeze=False, sharex="col", gridspec_kw={"width_ratios": (1.7, 1.0)})
    joint = _elbow(runs[methods[0]])
    name = runs[methods[0]].run.robot.description.joint_names[joint].replace("_", " ")
    figure.suptitle(f"Anti-windup: the hand is held out of its place for {push[1] - push[0]:g} s, then let go")
    rights = []
    for (left, hand), method in zip(grid, methods, strict=True):
        rights.append(_torque(left, runs[method], joint, push))
        describe(left, f"{METHODS[method]}: {_peaks(runs[method], joint, push)}", f"torque, {name} [N·m]")
        _displacement(hand, runs[method], push)
    _one_scale(grid[:, 0], rights)
    limits = common_limits([line.get_ydata() for axis in grid[:, 1] for line in axis.lines], LEAST_MM)
    for left, hand in grid:
        hand.set_ylim(limits)
        _mark(left, {"taken": push[0], "let go": push[1]})
        _mark(hand, {"let go": push[1]})
    for axis in grid[-1]:
        axis.set_xlabel("time [s]")
    grid[0, 0].set_xlim(push[0] - BEFORE_S, push[1] + AFTER_S)
    grid[0, 1].set_xlim(push[1] - HAND_BEFORE_S, push[1] + HAND_AFTER_S)
    tidy([*grid.flat])
    legend(figure, [grid[0, 0], rights[0], grid[0, 1]], columns=4)
    return figure


def _torque(axis: Axes, series: RunSeries, joint: int, push: tuple[float, float]) -> Axes:
    """Draw u_K, ũ_K and ±τ_m of a joint; the force on the axis at the right, which is returned."""
    trace, state = series.trace, series.state
    limit = _limit(series, joint)
    chosen = _within(trace.time_s, push[0] - BEFORE_S, push[1] + AFTER_S)
    time_s = trace.time_s[chosen]
    right = twin(axis, "force [N]")
    seen = _within(state.time_s, push[0] - BEFORE_S, push[1] + AFTER_S)
    force = _along_push(series, push)[seen]
    if np.isfinite(force).any():
        line(right, state.time_s[seen], force, color="black", linewidth=1.0, label="measured force, along the push")
    for sign in (1.0, -1.0):
        axis.axhline(sign * limit, label=r"$\pm\tau_m$", **THIN)
    before = r"$u_K$ before the limit"
    line(axis, time_s, trace.torque_windup[chosen, joint], color=RED, linewidth=1.0, linestyle="--", label=before)
    after = r"additional torque $\tilde{u}_K$"
    line(axis, time_s, trace.torque_limited[chosen, joint], color=RED, linewidth=1.7, label=after)
    return right


def _displacement(axis: Axes, series: RunSeries, push: tuple[float, float]) -> None:
    """Draw the true hand from where it was when it was taken."""
    truth = series.truth
    title = "Hand"
    chosen = _within(truth.time_s, push[1] - HAND_BEFORE_S, push[1] + HAND_AFTER_S)
    if chosen.any():
        start = truth.hand[max(int(np.searchsorted(truth.time_s, push[0])) - 1, 0)]
        moved_mm = (truth.hand[chosen] - start) * 1e3
        component_lines(axis, truth.time_s[chosen], moved_mm, "true hand, {}")
    if len(truth.time_s) and truth.time_s[-1] >= push[1] + WINDOW_S:
        swing_mm = float(oscillation(truth.time_s, truth.hand, push[1]).max()) * 1e3
        title = f"Hand: oscillation {swing_mm:.2g} mm peak to peak"
    describe(axis, title, "displacement [mm]")


def _along_push(series: RunSeries, push: tuple[float, float]) -> Array:
    """Measured force (K,) [N] along its mean while the hand is held; NaN without a sensor."""
    force = measured_force(series, push[0])
    held = force[_within(series.state.time_s, *push)]
    mean = held.mean(axis=0) if len(held) else np.zeros(3)
    norm = float(np.linalg.norm(mean))
    return force @ (mean / norm) if norm > 0.0 else force[:, 0]


def _peaks(series: RunSeries, joint: int, push: tuple[float, float]) -> str:
    trace = series.trace
    window = trace.torque_mode & (trace.time_s >= push[0])
    torques = (trace.torque_windup, trace.torque_limited)
    if not np.isfinite(trace.torque_windup[window, joint]).any():
        return "no additional torque"
    before, after = (float(np.nanmax(np.abs(torque[window, joint]))) / _limit(series, joint) for torque in torques)
    return rf"$|u_K| \leq$ {before:.2f} $\tau_m$, $|\tilde{{u}}_K| \leq$ {after:.2f} $\tau_m$"


def _one_scale(lefts: NDArray[np.object_], rights: list[Axes]) -> None:
    """Give all rows the same limits, with the zeros of torque and force at one height."""
    for axes in (lefts, rights):
        limits = common_limits([line.get_ydata() for axis in axes for line in axis.lines], 1.0)
        for axis in axes:
            axis.set_ylim(limits)
    for left, right in zip(lefts, rights, strict=True):
        headroom(left, 0.1)
        headroom(right, 0.1)
        align_zeros(left, right)


def _mark(axis: Axes, times: dict[str, float]) -> None:
    for name, time_s in times.items():
        axis.axvline(time_s, color="#888888", linewidth=0.9, linestyle=":", zorder=1)
        top_text(axis, time_s, f" {name}", align="left")


def _elbow(series: RunSeries) -> int:
    """Index of the elbow's joint; of the first joint where none has that name."""
    names = series.run.robot.description.joint_names
    return next((j for j, name in enumerate(names) if "elbow" in name), 0)


def _limit(series: RunSeries, joint: int) -> float:
    """τ_m [N·m]."""
    share = series.run.scenario.controller.anti_windup.torque_share
    return float(share * series.run.robot.description.joints[joint].torque_limit)


def _within(time_s: Array, first_s: float, last_s: float) -> NDArray[np.bool_]:
    return np.asarray((time_s >= first_s) & (time_s <= last_s), np.bool_)
