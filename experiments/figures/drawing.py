"""What the experiments' figures share: colours, thinned lines, shaded spans, legends, files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray

from deploy.plots import STYLE
from deploy.series import Array, RunSeries, stretches
from schemas.world import HandHeld, Push

AXES: Final = "xyz"
AXIS_STYLE: Final[tuple[dict[str, Any], ...]] = (
    {"color": "#7b3294", "linewidth": 1.2},
    {"color": "#2166ac", "linewidth": 1.2},
    {"color": "#1b7837", "linewidth": 1.2},
)
"""x, y, z of the world in all figures."""
TRUE: Final[dict[str, Any]] = {**STYLE["true"], "linewidth": 1.3}
"""What only the plant knows, where one signal is drawn alone."""
RED: Final = "#c0392b"
THIN: Final[dict[str, Any]] = {"color": "#555555", "linewidth": 0.8}
"""Limits and thresholds."""
SPAN_COLOURS: Final = ("#dce9f5", "#fbe6d0", "#e3f0dc", "#eadff0")
"""Of pushes, in the order in which they come."""
BINS: Final = 700
"""Stretches of a thinned line: about one a pixel at 130 dpi."""
HEADROOM: Final = 0.22
"""Of an axis' height: kept free above the lines for the names of the spans."""
DPI: Final = 130

Indices = NDArray[np.intp]


def save(figure: Figure, path: Path) -> None:
    """Write a figure beside its experiment's logs, PNG to look at and SVG to zoom into; equal figures, equal bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "hrp-cosim"}):
        figure.savefig(path.with_suffix(".png"), dpi=DPI)
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def thinned(values: Array, bins: int = BINS) -> Indices:
    """Choose indices of a signal (K,) that look like all: first, least, greatest, last of each of `bins` stretches."""
    count = len(values)
    if count <= 4 * bins:
        return np.arange(count)
    edges = np.linspace(0, count, bins + 1).astype(np.intp)
    stretches = [(first, values[first:last]) for first, last in pairwise(edges)]
    lows = np.array([first + np.argmin(stretch) for first, stretch in stretches], np.intp)
    highs = np.array([first + np.argmax(stretch) for first, stretch in stretches], np.intp)
    return np.unique(np.concatenate((edges[:-1], edges[1:] - 1, lows, highs)))


def line(axis: Axes, time_s: Array, values: Array, **style: Any) -> None:
    """Draw a signal over time with no more points than the eye sees."""
    chosen = thinned(values)
    axis.plot(time_s[chosen], values[chosen], **style)


def component_lines(axis: Axes, time_s: Array, values: Array, label: str = "{}", **style: Any) -> None:
    """Draw x, y, z of a vector (K, 3) over time; `label` with {} where the axis' name comes."""
    for name, own, column in zip(AXES, AXIS_STYLE, values.T, strict=True):
        line(axis, time_s, column, label=label.format(name), **{**own, **style})


def events(series: RunSeries) -> tuple[Push | HandHeld, ...]:
    """List what people do to the robot in a run, in time."""
    return tuple(sorted(series.run.scenario.plant.world.events, key=lambda event: event.start_s))


def event_name(series: RunSeries, event: Push | HandHeld) -> str:
    """Name of a push with its force; of a hand that holds, with the largest force that it really had."""
    if isinstance(event, Push):
        return f"{event.name} pushed,\n{np.linalg.norm(event.force_in_world):.0f} N"
    forces = series.truth.world_forces.get(event.name)
    if forces is None:
        return f"{event.name} led"
    return f"{event.name} led,\nup to {np.linalg.norm(forces, axis=1).max():.0f} N"


def shade_events(axis: Axes, series: RunSeries) -> None:
    """Shade the span of every event, below all lines; of two axes on one place, give the lower one."""
    for number, event in enumerate(events(series)):
        end_s = event.start_s + event.duration_s
        axis.axvspan(event.start_s, end_s, color=SPAN_COLOURS[number % len(SPAN_COLOURS)], zorder=0, linewidth=0)


def name_events(axis: Axes, series: RunSeries) -> None:
    """Write the name and force of every event at the top; `headroom` makes the place."""
    for event in events(series):
        top_text(axis, event.start_s + 0.5 * event.duration_s, event_name(series, event))


def spans(time_s: Array, mask: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """First and last time [s] of each stretch in which a mask (K,) holds."""
    return [(float(time_s[first]), float(time_s[end - 1])) for first, end in stretches(mask)]


def shade_mask(axis: Axes, time_s: Array, mask: NDArray[np.bool_], **style: Any) -> None:
    """Shade the stretches in which a mask (K,) holds; the first one has the legend's entry."""
    for start_s, end_s in spans(time_s, mask):
        axis.axvspan(start_s, end_s, zorder=0, linewidth=0, **style)
        style.pop("label", None)


def headroom(axis: Axes, share: float = HEADROOM) -> None:
    """Leave this share of the axis' height free above what is drawn."""
    low, high = axis.get_ylim()
    axis.set_ylim(low, low + (high - low) / (1.0 - share))


def top_text(axis: Axes, time_s: float, text: str, align: Literal["left", "center", "right"] = "center") -> None:
    """Write below the upper edge, at a time."""
    where = blended_transform_factory(axis.transData, axis.transAxes)
    axis.text(time_s, 0.965, text, transform=where, ha=align, va="top", fontsize=8, linespacing=1.1)


def common_limits(groups: Iterable[Any], least: float = 0.0) -> tuple[float, float]:
    """Limits that hold all finite values and zero, with a margin; at least `least` apart."""
    arrays = [np.asarray(group, np.float64) for group in groups]
    values = [array[np.isfinite(array)] for array in arrays]
    low = min([0.0, *(float(v.min()) for v in values if v.size)])
    high = max([0.0, *(float(v.max()) for v in values if v.size)])
    span = max(high - low, least, 1e-9)
    return low - 0.06 * span, high + 0.06 * span


def align_zeros(left: Axes, right: Axes) -> None:
    """Widen the limits of two axes so that their zeros lie at one height."""
    limits = [axis.get_ylim() for axis in (left, right)]
    share = max(-low / (high - low) for low, high in limits)
    share = min(max(share, 0.0), 0.9)
    for axis, (low, high) in zip((left, right), limits, strict=True):
        span = max(high / (1.0 - share), -low / share if share > 0.0 else 0.0)
        axis.set_ylim(-share * span, (1.0 - share) * span)


def describe(axis: Axes, title: str, y_label: str) -> None:
    """Title at the left, and what is drawn upwards with its unit."""
    axis.set_title(title, loc="left", fontsize=10)
    axis.set_ylabel(y_label, fontsize=9)


def twin(axis: Axes, y_label: str, colour: str = "black") -> Axes:
    """Make a second axis with its scale at the right, below the first."""
    right = axis.twinx()
    right.set_ylabel(y_label, fontsize=9, color=colour)
    right.tick_params(axis="y", colors=colour, labelsize=8)
    axis.set_zorder(right.get_zorder() + 1)
    axis.patch.set_visible(False)
    return right


def tidy(axes: Sequence[Axes]) -> None:
    """Give all axes a light grid and small figures."""
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
        axis.xaxis.label.set_fontsize(9)
        axis.yaxis.label.set_fontsize(9)


def halves(figure: Figure, widths: tuple[float, float]) -> tuple[SubFigure, SubFigure]:
    """Split a figure in a left and a right part, each laid out for itself."""
    grid = figure.add_gridspec(1, 2, width_ratios=widths)
    return figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[0, 1])


def legend(figure: FigureBase, axes: Sequence[Axes], columns: int) -> None:
    """One legend below the figure for what is drawn in these axes, every name once."""
    entries: dict[str, Artist] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        handles = [*entries.values()]
        figure.legend(handles, [*entries], loc="outside lower center", ncols=columns, fontsize=9, frameon=False)


def side_legend(axis: Axes, twin_axis: Axes | None = None) -> None:
    """Legend at the right of an axis, outside of it, with the lines of its twin, whose scale it leaves free."""
    handles, labels = axis.get_legend_handles_labels()
    if twin_axis is not None:
        more = twin_axis.get_legend_handles_labels()
        handles, labels = handles + more[0], labels + more[1]
    if handles:
        place = (1.01 if twin_axis is None else 1.1, 0.5)
        axis.legend(handles, labels, loc="center left", bbox_to_anchor=place, fontsize=8, frameon=False)


def at(time_s: Array, when_s: float) -> int:
    """Index of the last sample at or before a time; 0 when there is none."""
    return max(int(np.searchsorted(time_s, when_s, side="right")) - 1, 0)


def measured_force(series: RunSeries, rest_s: float) -> Array:
    """Force (K, 3) [N] of the first sensor, in its frame, less its mean in the second before `rest_s`: the weight."""
    force = series.state.wrench[:, :3]
    before = (series.state.time_s >= rest_s - 1.0) & (series.state.time_s < rest_s)
    if not before.any():
        return force
    return np.asarray(force - force[before].mean(axis=0), np.float64)


def torque_mode_start(series: RunSeries) -> int:
    """Index in the truth of the first cycle in torque mode; 0 when there is none."""
    times = series.trace.time_s[series.trace.torque_mode]
    return at(series.truth.time_s, float(times[0])) if len(times) else 0


def end(series: RunSeries) -> int:
    """Count the cycles of the truth up to the last state: after it the plant lets the robot settle by itself."""
    return int(np.searchsorted(series.truth.time_s, series.state.time_s[-1], side="right"))


def norms(vectors: Array) -> Array:
    """Norms (K,) of vectors (K, 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=1), np.float64)
