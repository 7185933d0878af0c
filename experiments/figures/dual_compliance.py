"""Fig. 9 of [Benallegue 2021]: the elbow gives way alone; the hand follows who leads it, and keeps the new place."""

from __future__ import annotations

from itertools import cycle
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.series import RunSeries
from experiments.figures.drawing import (
    RED,
    THIN,
    TRUE,
    at,
    common_limits,
    component_lines,
    describe,
    end,
    events,
    halves,
    headroom,
    legend,
    line,
    measured_force,
    name_events,
    norms,
    shade_events,
    shade_mask,
    side_legend,
    tidy,
    torque_mode_start,
    twin,
)
from experiments.figures.views import ArmView, plane_axes
from experiments.hand_runs import common_ticks
from schemas.world import HandHeld

ADMITTANCE: Final[dict[str, Any]] = {"color": "#d9efd3", "label": "admittance on"}
INSTANT_COLOURS: Final = ("#222222", "#2166ac", "#e08214", "#1b7837", "#7b3294", "#b2182b")
"""Of the snapshots, in time."""
VIEWS: Final = {"front view": (1, 2), "side view": (0, 2)}
LEAST_CM: Final = 1.0
SHARES: Final = {False: 0.95, True: 0.5}
"""Of a push's, and of a leading hand's duration: when the arm is drawn."""


def dual_compliance_figure(series: RunSeries, elbow: str) -> Figure:
    """Draw displacements of hand and elbow with the forces on them over time, and the arm at the instants that matter.

    Args:
        series: the run.
        elbow: frame whose displacement is drawn.

    """
    figure = Figure(figsize=(14.0, 8.6), layout="constrained")
    figure.suptitle("Dual compliance: the elbow is pushed and the hand stays; the hand is led and keeps its new place")
    left, right = halves(figure, (1.55, 1.0))
    hand, force, arm = left.subplots(3, 1, sharex=True)
    _hand(hand, series)
    _force(force, series)
    push = _elbow(arm, series, elbow)
    arm.set_xlabel("time [s]")
    arm.set_xlim(0.0, float(series.state.time_s[-1]))
    views = [*right.subplots(2, 1)]
    _snapshots(views, series)
    tidy([hand, force, arm, *views])
    for axis in (hand, force):
        side_legend(axis)
    side_legend(arm, push)
    legend(right, views, columns=2)
    return figure


def _hand(axis: Axes, series: RunSeries) -> None:
    """Draw hand and desired hand from where the latter was when torque mode began."""
    of_trace, of_truth = common_ticks(series)
    desired = series.trace.hand_desired[of_trace]
    known = series.trace.torque_mode[of_trace] & np.isfinite(desired).all(axis=1)
    describe(axis, "Hand", "displacement [cm]")
    if known.any():
        start = desired[known][0]
        time_s = series.trace.time_s[of_trace][known]
        component_lines(axis, time_s, (series.truth.hand[of_truth] - start)[known] * 1e2, "{}, true")
        wanted = (desired - start)[known] * 1e2
        for number, column in enumerate(wanted.T):
            label = None if number else "desired"
            line(axis, time_s, column, color="black", linewidth=1.0, linestyle=(0, (4, 3)), label=label)
    axis.set_ylim(common_limits([drawn.get_ydata() for drawn in axis.lines], LEAST_CM))
    headroom(axis)
    shade_events(axis, series)
    name_events(axis, series)


def _force(axis: Axes, series: RunSeries) -> None:
    """Draw true and measured force at the hand with the thresholds of the dual compliance."""
    config = series.run.scenario.controller
    hand = series.run.robot.description.hand_frame
    for event in events(series):
        if event.link == hand and event.name in series.truth.world_forces:
            label = "true, of the person"
            line(axis, series.truth.time_s, norms(series.truth.world_forces[event.name]), label=label, **TRUE)
    measured = norms(measured_force(series, min((event.start_s for event in events(series)), default=0.0)))
    if np.isfinite(measured).any():
        label = "measured at the wrist,\nless its value at rest"
        line(axis, series.state.time_s, measured, color="#999999", linewidth=0.7, label=label, zorder=1.9)
    dual = config.hand_force.dual_compliance if config.hand_force else None
    if dual is not None:
        for name, value, dashes in (("on", dual.force_on, "-"), ("off", dual.force_off, ":")):
            label = f"threshold {name}, {value:g} N"
            axis.axhline(value, label=label, **{**THIN, "color": RED, "linewidth": 1.1, "linestyle": dashes})
    axis.set_ylim(0.0, common_limits([drawn.get_ydata() for drawn in axis.lines], 1.0)[1])
    shade_mask(axis, series.trace.time_s, series.trace.admittance, **ADMITTANCE)
    describe(axis, "Force on the hand", "force [N]")


def _elbow(axis: Axes, series: RunSeries, elbow: str) -> Axes:
    """Draw the elbow's distance from its start; what pushes it on the axis at the right, which is returned."""
    truth, hand = series.truth, series.run.robot.description.hand_frame
    right = twin(axis, "force [N]", RED)
    title = "Elbow"
    if elbow in truth.frames and len(truth.time_s):
        last = end(series)
        path = truth.frames[elbow][:last]
        moved_cm = norms(path - path[torque_mode_start(series)]) * 1e2
        line(axis, truth.time_s[:last], moved_cm, label="displacement, true", **TRUE)
        title = f"Elbow: up to {moved_cm.max():.1f} cm from its place"
    for event in events(series):
        if event.link != hand and event.name in truth.world_forces:
            force = norms(truth.world_forces[event.name])
            label = f"push on the {event.name}\n(right axis)"
            line(right, truth.time_s, force, color=RED, linewidth=1.2, linestyle="--", label=label)
    for side, least in ((axis, LEAST_CM), (right, 1.0)):
        side.set_ylim(0.0, common_limits([drawn.get_ydata() for drawn in side.lines], least)[1])
    shade_events(right, series)
    describe(axis, title, "distance [cm]")
    return right


def _snapshots(axes: list[Axes], series: RunSeries) -> None:
    """Draw the arm before the first event, late in each push, in the middle of each leading, and at the end."""
    truth = series.truth
    instants: dict[str, float] = {}
    for event in events(series):
        held = isinstance(event, HandHeld)
        instants[f"{event.name} {'led' if held else 'pushed'}"] = event.start_s + SHARES[held] * event.duration_s
    if len(truth.time_s):
        instants = {
            "before": truth.time_s[torque_mode_start(series)],
            **instants,
            "at the end": series.state.time_s[-1],
        }
        arm = ArmView(series.run.robot)
        for axis, plane in zip(axes, VIEWS.values(), strict=True):
            for (name, when_s), colour in zip(instants.items(), cycle(INSTANT_COLOURS), strict=False):
                label = f"{name}, {when_s:.1f} s"
                arm.draw(axis, truth.position[at(truth.time_s, when_s)], plane, colour, label)
            arm.draw_body(axis, plane)
    for axis, (name, plane) in zip(axes, VIEWS.items(), strict=True):
        describe(axis, f"Arm, {name}", "")
        plane_axes(axis, plane)
