"""What the experiments' figures must show, on made-up runs of their scenarios."""

from __future__ import annotations

import re
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from numpy.testing import assert_allclose

from controller_service.model import RobotModel
from experiments.figures import (
    anti_windup_figure,
    dual_compliance_figure,
    null_space_figure,
    obstacle_track_figure,
    save,
)
from tests.experiments.made_up_runs import CONTACTS, ELBOW, made_up, nothing_known

PUSH = (4.5, 8.0)
"""Of arm9-anti-windup."""


def anti_windup(change: Any = None) -> Figure:
    series = {method: made_up("arm9-anti-windup", torque) for method, torque in (("qp", 90.0), ("none", 36.0))}
    series["scaling"] = made_up("arm9-anti-windup", 54.0)
    return anti_windup_figure({name: change(s) if change else s for name, s in series.items()}, PUSH)


def null_space(change: Any = None) -> Figure:
    series = {"with": made_up("arm9-null-space"), "without": made_up("arm9-null-space", way=0.01)}
    return null_space_figure({name: change(s) if change else s for name, s in series.items()}, ELBOW)


def dual_compliance(change: Any = None) -> Figure:
    series = made_up("arm9-dual-compliance")
    return dual_compliance_figure(change(series) if change else series, ELBOW)


def obstacle_track(change: Any = None) -> Figure:
    series = made_up("arm9-obstacle-track", way=0.2)
    if change:
        return obstacle_track_figure(change(series), {name: [] for name in CONTACTS})
    return obstacle_track_figure(series, CONTACTS)


ALL = (anti_windup, null_space, dual_compliance, obstacle_track)


def by_title(figure: Figure, start: str) -> Axes:
    return next(axis for axis in figure.axes if axis.get_title(loc="left").startswith(start))


def levels(axis: Axes) -> list[float]:
    """Heights of the horizontal lines."""
    return sorted(float(line.get_ydata()[0]) for line in axis.lines if list(line.get_xdata()) == [0, 1])


def marks(axis: Axes) -> list[float]:
    """Times of the vertical lines."""
    return sorted(float(line.get_xdata()[0]) for line in axis.lines if list(line.get_ydata()) == [0, 1])


def shaded(axis: Axes) -> list[tuple[float, float]]:
    patches = [patch for patch in axis.patches if isinstance(patch, Rectangle)]
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in patches]


@pytest.mark.parametrize("make", ALL)
def test_every_axis_has_a_name_with_its_unit(make: Any) -> None:
    figure = make()
    below = {id(joined) for axis in figure.axes if "[" in axis.get_xlabel() for joined in _sharing(axis)}
    for axis in figure.axes:
        assert re.search(r"\[.+\]$", axis.get_ylabel()), axis.get_title(loc="left")
        assert id(axis) in below, axis.get_ylabel()
    words = [axis.get_title(loc="left") + axis.get_ylabel() for axis in figure.axes]
    words += [text.get_text() for legend in _legends(figure) for text in legend.get_texts()]
    assert not [word for word in words if "_link" in word or re.search(r"[a-z]_[a-z]{2}", word)]


def _sharing(axis: Axes) -> list[Axes]:
    return [axis, *axis.get_shared_x_axes().get_siblings(axis)]


def _legends(figure: Figure) -> list[Any]:
    found = [axis.get_legend() for axis in figure.axes if axis.get_legend()]
    return found + [legend for part in (figure, *figure.subfigs) for legend in part.legends]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("make", ALL)
def test_nothing_overlaps_its_neighbours_and_legends_lie_outside(make: Any) -> None:
    figure = make()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = [axis.get_window_extent(renderer) for axis in figure.axes]
    legends = [legend.get_window_extent(renderer) for legend in _legends(figure)]
    assert not [1 for legend, box in product(legends, boxes) if legend.overlaps(box)]
    texts = [text for axis in figure.axes for text in _texts(axis)]
    texts += [text for legend in _legends(figure) for text in legend.get_texts()]
    places = [text.get_window_extent(renderer) for text in texts]
    clash = [(texts[i], texts[j]) for i, j in combinations(range(len(texts)), 2) if places[i].overlaps(places[j])]
    assert not clash
    assert all(figure.bbox.x0 <= place.x0 and place.x1 <= figure.bbox.x1 for place in places)


def _texts(axis: Axes) -> list[Text]:
    """What is written at an axis and is not empty, figures at its ticks excepted."""
    written = [axis._left_title, axis.xaxis.label, axis.yaxis.label, *axis.texts]  # type: ignore[attr-defined]
    return [text for text in written if text.get_visible() and text.get_text()]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("make", ALL)
def test_a_run_without_truth_sensor_and_contacts_is_drawn(make: Any) -> None:
    figure = make(nothing_known)
    FigureCanvasAgg(figure).draw()
    assert all(axis.get_ylabel() for axis in figure.axes)


def test_equal_figures_are_equal_files(tmp_path: Path) -> None:
    for name in ("one", "two"):
        save(null_space(), tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_anti_windup_rows_have_the_bounds_the_torques_and_the_release() -> None:
    figure = anti_windup()
    rows = [by_title(figure, start) for start in ("Without", "Scaling", "QP")]
    assert [row.get_window_extent().y0 for row in rows] == sorted(
        (row.get_window_extent().y0 for row in rows), reverse=True
    )
    for row, peak in zip(rows, ("2.00", "3.00", "5.00"), strict=True):
        assert levels(row) == [-18.0, 18.0]
        assert marks(row) == list(PUSH)
        assert f" {peak} " in row.get_title(loc="left")
        before, limited = (line for line in row.lines if to_rgba(line.get_color()) == to_rgba("#c0392b"))
        assert (before.get_linestyle(), limited.get_linestyle()) == ("--", "-")
        assert np.nanmax(before.get_ydata()) == pytest.approx(18.0 * float(peak), rel=1e-3)
        assert np.nanmax(limited.get_ydata()) == 18.0
        assert row.get_ylim() == rows[0].get_ylim()
    hands = [axis for axis in figure.axes if axis.get_title(loc="left").startswith("Hand")]
    assert len({axis.get_ylim() for axis in hands}) == 1
    assert all(marks(axis) == [PUSH[1]] for axis in hands)


def test_anti_windup_force_is_what_the_push_adds_on_the_right_axis() -> None:
    figure = anti_windup()
    rights = [axis for axis in figure.axes if axis.get_ylabel() == "force [N]"]
    assert len(rights) == 3
    for left, right in zip((by_title(figure, s) for s in ("Without", "Scaling", "QP")), rights, strict=True):
        force = np.asarray(right.lines[0].get_ydata())
        assert_allclose((force.min(), force.max()), (0.0, 20.0), atol=1e-9)
        zeros = [axis.transData.transform((0.0, 0.0))[1] for axis in (left, right)]
        assert zeros[0] == pytest.approx(zeros[1])


def test_null_space_shades_every_push_once_and_says_its_force() -> None:
    figure = null_space()
    rows = [by_title(figure, start) for start in ("Without", "With ")]
    rights = [axis for axis in figure.axes if axis.get_ylabel() == "shoulder yaw [°]"]
    assert len(rights) == 2
    for axis in (*rights, by_title(figure, "Elbow")):
        assert_allclose(shaded(axis), [(3.0, 5.5), (9.0, 13.5)])
    for row in rows:
        assert [text.get_text() for text in row.texts] == ["hand pushed,\n60 N", "elbow pushed,\n240 N"]
        assert [line.get_label()[:12] for line in row.lines] == ["hand error x", "hand error y", "hand error z"]
        assert_allclose(row.lines[2].get_ydata(), -2.0, atol=1e-9)
        assert max(np.max(line.get_ydata()) for line in row.lines) < row.get_ylim()[1]
    moved = [np.ptp(axis.lines[0].get_ydata()) for axis in rights]
    assert_allclose(moved, np.degrees((0.02, 0.2)), rtol=1e-3)


def test_dual_compliance_shows_thresholds_admittance_and_the_kept_place() -> None:
    figure = dual_compliance()
    force, hand = by_title(figure, "Force"), by_title(figure, "Hand")
    assert levels(force) == [6.0, 15.0]
    assert_allclose(shaded(force), [(9.52, 11.98)])
    assert_allclose(shaded(hand), [(3.0, 7.0), (9.0, 12.5)])
    assert sum(line.is_dashed() for line in hand.lines) == 3
    true = next(line for line in force.lines if line.get_label().startswith("true"))
    assert np.max(true.get_ydata()) == 20.0


def test_dual_compliance_draws_the_arm_where_it_was() -> None:
    series = made_up("arm9-dual-compliance")
    model = RobotModel(series.run.robot)
    front = by_title(dual_compliance_figure(series, ELBOW), "Arm, front")
    assert [line.get_label().split(",")[0] for line in front.lines] == [
        "before", "elbow pushed", "hand led", "at the end",
    ]  # fmt: skip
    for line in front.lines:
        when_s = float(line.get_label().split()[-2])
        position = series.truth.position[np.argmin(np.abs(series.truth.time_s - when_s))]
        hand, _ = model.pose(position, "hand")
        assert_allclose((line.get_xdata()[-1], line.get_ydata()[-1]), hand[1:], atol=0.02)


def test_obstacle_track_draws_every_pole_to_scale_and_every_contact() -> None:
    figure = obstacle_track()
    front = by_title(figure, "Scene, front")
    poles = [patch for patch in front.patches if to_rgba(patch.get_facecolor()) == to_rgba("#8a8a8a")]
    assert_allclose([np.ptp(pole.get_xy(), axis=0) for pole in poles], [(0.03, 0.83)] * 2, rtol=2e-3)
    crosses = {line.get_label(): line for line in front.lines if line.get_marker() == "x"}
    assert {name: len(line.get_xdata()) for name, line in crosses.items()} == {
        "contacts, outer": 2,
        "contacts, inner": 1,
    }
    assert_allclose(crosses["contacts, inner"].get_xydata(), [(-0.2, 0.3)])
    for start in ("Hand", "Tracking", "Contact", "Kinetic"):
        assert marks(by_title(figure, start)) == [6.0, 10.0, 12.0]
    assert "2.0 mm in y" in by_title(figure, "Tracking").get_title(loc="left")
    assert "500 N at the outer pole" in by_title(figure, "Contact").get_title(loc="left")
