"""The figure of a sweep: how much of its limit every bar takes in every seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from deploy.experiment import Bar, BarSummary, ExperimentResult, Outcome, summarize

HOLDS_COLOUR: Final = "#2166ac"
FAILS_COLOUR: Final = "#d6604d"
BEYOND_COLOUR: Final = "#fbeeea"
ENDS: Final = (1e-3, 1e2)
"""The axis goes no farther; shares beyond its ends are drawn at them, those below as arrows."""
AROUND_LIMIT: Final = (0.3, 2.0)
"""The axis shows these at the least."""
ROOM: Final = 1.4
"""It goes on for this factor beyond the outermost share."""
EDGE: Final = 1.12
"""What is beyond an end is drawn this factor within it."""
SPREAD: Final = 0.26
"""Half the height over which the seeds of a row are spread, of the rows' distance."""


def limit_share(bar: Bar) -> float:
    """Value over limit, or limit over value where a bar wants at least that: above 1 where it fails.

    Where there is no such ratio (a limit or value that is not positive, a value that is not a number) it is 0 where the
    bar holds and ∞ where it fails.
    """
    above, below = (bar.limit, bar.value) if bar.at_least else (bar.value, bar.limit)
    if math.isfinite(above) and bar.limit > 0.0 and below > 0.0:
        return max(above / below, 0.0)
    return 0.0 if bar.holds else math.inf


def sweep_figure(experiment: str, outcomes: Sequence[Outcome]) -> Figure:
    """Draw a row a bar, a point a seed at its share of the limit; the median is a line, the worst seed is named."""
    bars = summarize(outcomes)
    results = [outcome for outcome in outcomes if isinstance(outcome, ExperimentResult)]
    passed = sum(outcome.passed for outcome in outcomes)
    figure = Figure(figsize=(9.6, 1.9 + 0.52 * max(len(bars), 1)), layout="constrained")
    robot = f" on {results[0].robot}" if results else ""
    figure.suptitle(f"{experiment}{robot}: {passed} of {len(outcomes)} seeds pass", fontsize=12)
    axis = figure.subplots()
    low, high = _ends([limit_share(bar) for result in results for bar in result.bars])
    axis.set_xscale("log")
    axis.set_xlim(low, high)
    axis.set_ylim(max(len(bars), 1) - 0.5, -0.5)
    axis.axvspan(1.0, high, color=BEYOND_COLOUR, zorder=0)
    axis.axvline(1.0, color=FAILS_COLOUR, linewidth=1.4, zorder=1)
    for number, row in enumerate(bars):
        seeds = [
            (bar, result.seed == row.worst_seed) for result in results for bar in result.bars if bar.name == row.name
        ]
        _draw_row(axis, number, seeds, (low, high))
    _label(axis, bars, len(outcomes))
    lost = [str(outcome.seed) for outcome in outcomes if not isinstance(outcome, ExperimentResult)]
    handles = [
        Line2D([], [], color=HOLDS_COLOUR, marker="o", linestyle="", label="a seed in which the bar holds"),
        Line2D([], [], color=FAILS_COLOUR, marker="X", linestyle="", label="fails"),
        Line2D([], [], color="black", marker="o", fillstyle="none", markersize=8, linestyle="", label="the worst seed"),
        Line2D([], [], color="black", marker="|", markersize=12, linestyle="", label="median"),
        Line2D([], [], color=FAILS_COLOUR, label="limit"),
    ]
    title = f"without result: seed {', '.join(lost)}" if lost else None
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False,
        title=title, title_fontsize=8,
    )  # fmt: skip
    return figure


def _ends(shares: list[float]) -> tuple[float, float]:
    """Choose the ends of the axis."""
    drawn = [share for share in shares if 0.0 < share < math.inf] or [1.0]
    return (
        max(min(min(drawn) / ROOM, AROUND_LIMIT[0]), ENDS[0]),
        min(max(max(drawn) * ROOM, AROUND_LIMIT[1]), ENDS[1]),
    )


def _draw_row(axis: Axes, number: int, seeds: list[tuple[Bar, bool]], ends: tuple[float, float]) -> None:
    """Points of a bar, spread over the row in the order of the seeds; the worst one has a ring."""
    low, high = ends
    shares = np.array([limit_share(bar) for bar, _ in seeds])
    drawn = np.clip(shares, low * EDGE, high / EDGE)
    heights = number + (np.linspace(-SPREAD, SPREAD, len(seeds)) if len(seeds) > 1 else np.zeros(1))
    fails = ~np.array([bar.holds for bar, _ in seeds])
    below = ~fails & (shares < low)
    for marker, size, colour, which in (
        ("o", 22, HOLDS_COLOUR, ~fails & ~below), ("<", 26, HOLDS_COLOUR, below), ("X", 34, FAILS_COLOUR, fails),
    ):  # fmt: skip
        axis.scatter(
            drawn[which], heights[which], s=size, color=colour, marker=marker, alpha=0.8, linewidths=0.0, zorder=3
        )
    worst = np.array([is_worst for _, is_worst in seeds])
    axis.scatter(drawn[worst], heights[worst], s=70, facecolors="none", edgecolors="black", linewidths=0.8, zorder=5)
    median = float(np.clip(np.median(shares), low * EDGE, high / EDGE))
    axis.plot([median, median], [number - 0.36, number + 0.36], color="black", linewidth=1.4, zorder=2)


def _label(axis: Axes, bars: Sequence[BarSummary], count: int) -> None:
    """Bars and limits on the left, passes and worst values on the right."""
    numbers = range(len(bars))
    axis.set_yticks(numbers, [f"{bar.name} {'≥' if bar.at_least else '≤'} {bar.limit:.4g}" for bar in bars], fontsize=8)
    axis.set_xlabel("share of the limit: value / limit, for ≥ limit / value", fontsize=9)
    axis.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.tick_params(axis="x", labelsize=8)
    axis.tick_params(axis="y", length=0)
    axis.grid(axis="x", alpha=0.3)
    for number in numbers[1:]:
        axis.axhline(number - 0.5, color="#dddddd", linewidth=0.6, zorder=0)
    right = axis.secondary_yaxis("right")
    right.set_yticks(
        numbers,
        [f"{bar.holds_count}/{count}, worst {bar.worst:.3g} (seed {bar.worst_seed})" for bar in bars],
        fontsize=8,
    )
    right.tick_params(length=0)
    for tick, bar in zip(right.get_yticklabels(), bars, strict=True):
        tick.set_color("black" if bar.holds_count == count else FAILS_COLOUR)
    for side in (*axis.spines.values(), *right.spines.values()):
        side.set_visible(False)
