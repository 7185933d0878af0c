"""What every figure of an experiment must have: units at its axes, and no text over another."""

from __future__ import annotations

import re
from itertools import combinations

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text


def check_figure(figure: Figure) -> None:
    """Draw a figure and look at its labels, titles and legends."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    texts: list[Text] = []
    for axis in figure.axes:
        title: Text = axis._left_title  # type: ignore[attr-defined]
        assert re.search(r"\[.+\]$", axis.get_ylabel()), title.get_text()
        assert re.search(r"\[.+\]$", axis.get_xlabel()), title.get_text()
        texts += [title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
    parts = [figure, *figure.subfigs]
    legends = [legend for part in parts for legend in part.legends]
    assert legends
    texts += [text for legend in legends for text in legend.get_texts()]
    places = [text.get_window_extent(renderer) for text in texts if text.get_text()]
    assert not [1 for one, other in combinations(places, 2) if one.overlaps(other)]
    assert all(figure.bbox.x0 <= place.x0 and place.x1 <= figure.bbox.x1 for place in places)
    boxes = [axis.get_window_extent(renderer) for axis in figure.axes]
    assert not [1 for legend in legends for box in boxes if legend.get_window_extent(renderer).overlaps(box)]
