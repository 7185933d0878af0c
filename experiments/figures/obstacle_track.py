"""Figs. 10 and 11 of [Benallegue 2021]: tracking of a closed shape while the arm runs into poles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.series import Array, RunSeries
from experiments.figures.drawing import (
    AXES,
    AXIS_STYLE,
    TRUE,
    at,
    common_limits,
    describe,
    end,
    halves,
    legend,
    line,
    norms,
    side_legend,
    tidy,
    torque_mode_start,
)
from experiments.figures.views import ArmView, Plane, draw_obstacle, path_line, plane_axes
from experiments.hand_runs import common_ticks

OBSTACLE_COLOURS: Final = ("#c0392b", "#8c510a", "#01665e", "#5e3c99")
"""Of contacts and forces, in the order of the obstacles."""
VIEWS: Final[dict[str, Plane]] = {"front view": (1, 2), "top view": (0, 1)}
FRAME_STYLE: Final[tuple[dict[str, Any], ...]] = (
    {"color": "#80b1d3", "linewidth": 1.0},
    {"color": "#7fbf7b", "linewidth": 1.0},
    {"color": "#c2a5cf", "linewidth": 1.0},
)
FRAME_NAMES: Final = {"elbow_pitch_link": "elbow", "wrist_yaw_link": "forearm"}
"""Where the origins of links lie, in words; others are called by the link."""
CONTACT_STYLE: Final[dict[str, Any]] = {
    "linestyle": "none",
    "marker": "x",
    "markersize": 7.0,
    "markeredgewidth": 1.8,
    "zorder": 5,
}
MEAN_S: Final = 0.05
"""Of the running mean of the contact forces: hard contacts rattle from sample to sample."""


def obstacle_track_figure(series: RunSeries, contact_times: Mapping[str, Sequence[float]]) -> Figure:
    """Draw references, true positions and errors in y and z, contact forces and energy, and the scene from two sides.

    Args:
        series: the run.
        contact_times: when contacts with each obstacle begin [s].

    """
    figure = Figure(figsize=(15.0, 9.6), layout="constrained")
    count = sum(len(times) for times in contact_times.values())
    figure.suptitle(f"Tracking among obstacles that the controller does not know of: {count} contacts")
    left, right = halves(figure, (1.55, 1.0))
    axes = left.subplots(4, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0, 0.8))
    position, error, force, energy = axes
    obstacles = series.run.scenario.plant.world.obstacles
    names = {obstacle.name: f"{obstacle.name} {obstacle.kind}" for obstacle in obstacles}
    colours = dict(zip(names, cycle(OBSTACLE_COLOURS), strict=False))
    _tracking(position, error, series)
    _forces(force, series, names, colours)
    last = end(series)
    joules = series.truth.kinetic_energy[:last]
    line(energy, series.truth.time_s[:last], joules, label="true,\nrotors included", **TRUE)
    describe(energy, "Kinetic energy", "energy [J]")
    energy.set(xlabel="time [s]", xlim=(0.0, float(series.state.time_s[-1])), ylim=(0.0, None))
    for axis in axes:
        for name, times in contact_times.items():
            for time_s in times:
                axis.axvline(time_s, color=colours[name], linewidth=0.9, linestyle=":", zorder=1)
        side_legend(axis)
    views = [*right.subplots(2, 1)]
    for axis, (view, plane) in zip(views, VIEWS.items(), strict=True):
        _scene(axis, series, contact_times, colours, plane)
        describe(axis, f"Scene, {view}", "")
        plane_axes(axis, plane)
    legend(right, views, columns=3)
    tidy([*axes, *views])
    return figure


def _tracking(position: Axes, error: Axes, series: RunSeries) -> None:
    """Draw y and z of hand and desired hand in torque mode, and their differences."""
    of_trace, of_truth = common_ticks(series)
    desired, true = series.trace.hand_desired[of_trace], series.truth.hand[of_truth]
    known = series.trace.torque_mode[of_trace] & np.isfinite(desired).all(axis=1)
    time_s, desired, true = series.trace.time_s[of_trace][known], desired[known], true[known]
    for axis_number in (1, 2):
        name, style = AXES[axis_number], AXIS_STYLE[axis_number]
        line(position, time_s, true[:, axis_number], label=f"{name}, true", **{**style, "linewidth": 2.2, "alpha": 0.6})
        label = "references" if axis_number == 2 else None
        line(position, time_s, desired[:, axis_number], label=label, color="black", linewidth=0.9, linestyle="--")
        line(error, time_s, (true - desired)[:, axis_number] * 1e3, label=name, **style)
    largest = np.abs(true - desired).max(axis=0, initial=0.0) * 1e3
    describe(position, "Hand, references and true positions (dotted: a contact begins)", "position [m]")
    title = f"Tracking errors, true − desired: up to {largest[1]:.1f} mm in y, {largest[2]:.1f} mm in z"
    describe(error, title, "error [mm]")
    error.set_ylim(common_limits([drawn.get_ydata() for drawn in error.lines], 2.0))


def _forces(axis: Axes, series: RunSeries, names: Mapping[str, str], colours: Mapping[str, str]) -> None:
    """Draw the force of each obstacle on the arm, every sample and its running mean."""
    largest = []
    count = max(1, round(MEAN_S / series.run.robot.description.period_s))
    for name, title in names.items():
        force = _force_of(series, name)
        line(axis, series.truth.time_s, force, color=colours[name], linewidth=0.6, alpha=0.35)
        if len(force) >= count:
            mean = np.convolve(force, np.full(count, 1.0 / count), "same")
            label = f"{title},\nmean of {MEAN_S:g} s"
            line(axis, series.truth.time_s, mean, color=colours[name], linewidth=1.4, label=label)
        largest.append(f"{force.max(initial=0.0):.0f} N at the {title}")
    what = "Contact force (true)"
    describe(axis, f"{what}: up to {', '.join(largest)}" if largest else what, "force [N]")
    axis.set_ylim(0.0, common_limits([drawn.get_ydata() for drawn in axis.lines], 1.0)[1])


def _scene(
    axis: Axes,
    series: RunSeries,
    contact_times: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    plane: Plane,
) -> None:
    """Draw obstacles, paths and contacts as seen along the third axis, and the arm at the first contact."""
    truth, trace = series.truth, series.trace
    for obstacle in series.run.scenario.plant.world.obstacles:
        draw_obstacle(axis, obstacle, plane, edgecolor=colours[obstacle.name])
    moving = slice(torque_mode_start(series), end(series))
    hand = series.run.robot.description.hand_frame
    others = [name for name in truth.frames if name != hand]
    for number, name in enumerate(others):
        label = f"{FRAME_NAMES.get(name, name.replace('_', ' '))}'s path"
        path_line(axis, truth.frames[name][moving], plane, label=label, **FRAME_STYLE[number % len(FRAME_STYLE)])
    path_line(axis, truth.hand[moving], plane, label="hand's true path", **TRUE)
    desired = trace.hand_desired[trace.torque_mode]
    path_line(axis, desired, plane, label="desired shape", color="black", linewidth=0.9, linestyle="--")
    begins = sorted(time_s for times in contact_times.values() for time_s in times)
    if begins:
        arm = ArmView(series.run.robot)
        position = truth.position[at(truth.time_s, begins[0])]
        arm.draw(axis, position, plane, "#444444", f"arm at {begins[0]:.1f} s")
        arm.draw_body(axis, plane)
    for name, times in contact_times.items():
        if not times:
            continue
        points = np.array([_contact_point(series, name, time_s) for time_s in times]).reshape(-1, 3)
        style = {**CONTACT_STYLE, "color": colours[name]}
        axis.plot(points[:, plane[0]], points[:, plane[1]], label=f"contacts, {name}", **style)


def _force_of(series: RunSeries, name: str) -> Array:
    """Norm (K,) [N] of the force of an obstacle on the robot."""
    zero = np.zeros(3)
    sums = [
        sum((np.array(sample.force_in_world) for sample in samples if sample.other == name), start=zero)
        for samples in series.truth.contacts
    ]
    return norms(np.array(sums).reshape(-1, 3))


def _contact_point(series: RunSeries, name: str, time_s: float) -> tuple[float, float, float]:
    """Where an obstacle is touched at a time [m]; NaN when it is not."""
    samples = series.truth.contacts[at(series.truth.time_s, time_s)] if series.truth.contacts else ()
    places = [sample.position_in_world for sample in samples if sample.other == name]
    return places[0] if places else (np.nan,) * 3
