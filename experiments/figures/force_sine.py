"""Fig. 5 of [Del Prete 2016], the forces of the foot on the block, and below it the foot lifted off and landing."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures.drawing import SPAN_COLOURS, THIN, common_limits, describe, legend, line, tidy, top_text
from experiments.hand_runs import end_of, event_of
from experiments.leg_signals import Contact, SineSpans, in_span
from schemas.load import Run

EVENT: Final = "lifted"
VARIANTS: Final = {"with": "With force feedback", "without": "Feed-forward alone (Kₚ = K_f = 0)"}
REFERENCE: Final[dict[str, Any]] = {"color": "black", "linewidth": 1.2, "linestyle": "--"}
RAW: Final[dict[str, Any]] = {"color": "#92c5de", "linewidth": 0.7}
FORCE: Final = ("#7b3294", "#d95f02", "#2166ac")
"""F_x, F_y, F_z."""
AFTER_S: Final = 1.1
"""Of the time after the event's start that is drawn large."""


def force_sine_figure(contacts: dict[str, Contact], scenario: Run, spans: SineSpans) -> Figure:
    """Draw a column a run: vertical force, horizontal forces, moments, and the vertical force around the event.

    Args:
        contacts: by `with` and `without`, or one of them.
        scenario: whose event it is.
        spans: what is judged.

    """
    names = [name for name in VARIANTS if name in contacts]
    figure = Figure(figsize=(6.0 * len(names), 10.5), layout="constrained")
    figure.suptitle("Sinusoidal vertical force of the foot on a rigid block, all else zero: true forces")
    axes = figure.subplots(4, len(names), squeeze=False, height_ratios=(2.4, 1.5, 1.5, 2.4))
    amplitude = float(np.ptp(contacts[names[0]].reference[in_span(contacts[names[0]].time_s, spans.before), 2])) / 2.0
    end_s = spans.before[1] if spans.after is None else spans.after[1]
    for column, name in enumerate(names):
        force = contacts[name]
        span = (spans.before[0] - 1.0, end_s)
        chosen = in_span(force.time_s, span)
        time_s, smooth = force.time_s[chosen], force.smooth[chosen]
        top, sideways, moments, event = axes[:, column]
        error = (force.smooth[:, 2] - force.reference[:, 2])[in_span(force.time_s, spans.before)]
        line(top, time_s, smooth[:, 2], color=FORCE[2], linewidth=1.5, label="F_z, mean over the window")
        line(top, time_s, force.reference[chosen, 2], label="F_z, reference", **REFERENCE)
        largest = float(np.abs(error).max())
        describe(top, f"{VARIANTS[name]}: error up to {largest:.0f} N before the event", "vertical force [N]")
        for axis_name, index in (("x", 0), ("y", 1)):
            line(
                sideways,
                time_s,
                smooth[:, index],
                color=FORCE[index],
                linewidth=1.2,
                label=f"F_{axis_name}, M_{axis_name}",
            )
            line(moments, time_s, smooth[:, 3 + index], color=FORCE[index], linewidth=1.2)
        line(moments, time_s, smooth[:, 5], color=FORCE[2], linewidth=1.2, label="M_z")
        for level in (-0.1, 0.1):
            sideways.axhline(level * amplitude, **THIN | {"linestyle": ":"}, label="10 % of the amplitude")
        before = in_span(force.time_s, spans.before)
        worst = float(np.abs(force.smooth[before, :2]).max() / amplitude)
        describe(sideways, f"Horizontal forces: coupling {100.0 * worst:.1f} % before the event", "force [N]")
        describe(moments, "Moments about the foot's origin", "moment [N·m]")
        _event(event, force, scenario)
        for axis in (top, sideways, moments):
            _shade(axis, scenario)
            axis.set_xlim(*span)
        for axis in axes[:, column]:
            axis.set_xlabel("time [s]")
        top_text(top, event_of(scenario, EVENT).start_s + 0.2, "lifted")
    for row, least in ((0, 10.0), (1, 10.0), (2, 2.0)):
        limits = common_limits(
            [drawn.get_ydata() for axis in axes[row] for drawn in axis.lines if len(drawn.get_xdata()) > 2], least
        )
        for axis in axes[row]:
            axis.set_ylim(limits)
    tidy([*axes.flat])
    legend(figure, [axes[0, 0], axes[1, 0], axes[2, 0], axes[3, 0]], columns=4)
    return figure


def _event(axis: Axes, force: Contact, scenario: Run) -> None:
    """Draw the vertical force as it is while the foot is lifted and lands."""
    event = event_of(scenario, EVENT)
    chosen = in_span(force.time_s, (event.start_s - 0.1, event.start_s + AFTER_S))
    time_s = force.time_s[chosen]
    axis.plot(time_s, force.raw[chosen, 2], label="F_z, every cycle", **RAW)
    axis.plot(time_s, force.smooth[chosen, 2], color=FORCE[2], linewidth=1.5)
    axis.plot(time_s, force.reference[chosen, 2], **REFERENCE)
    landed = force.raw[in_span(force.time_s, (end_of(event), event.start_s + AFTER_S))]
    _shade(axis, scenario)
    axis.set_xlim(time_s[0], time_s[-1])
    describe(axis, f"Lifted off and landing: up to {landed[:, 2].max():.0f} N", "vertical force [N]")


def _shade(axis: Axes, scenario: Run) -> None:
    event = event_of(scenario, EVENT)
    axis.axvspan(
        event.start_s, end_of(event), color=SPAN_COLOURS[0], zorder=0, linewidth=0, label="somebody lifts the foot"
    )
