"""The parts that the experiments' figures are made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.testing import assert_allclose

from controller_service.model import RobotModel
from deploy.series import Array
from experiments.figures.drawing import BINS, align_zeros, line, save, spans, thinned
from experiments.figures.views import ArmView, capsule_outline, draw_obstacle
from schemas.load import load_run
from schemas.world import Box, Pole


@pytest.mark.parametrize("count", [0, 5, 4 * BINS, 20_000])
def test_a_thinned_line_keeps_its_extremes_and_ends(count: int) -> None:
    values = np.random.default_rng(3).normal(size=count)
    chosen = thinned(values)
    assert len(chosen) <= 4 * BINS
    assert np.all(np.diff(chosen) > 0)
    if count:
        assert {0, count - 1, int(values.argmin()), int(values.argmax())} <= set(chosen.tolist())


def test_six_noisy_lines_of_a_long_run_make_a_small_file(tmp_path: Path) -> None:
    figure = Figure()
    axis = figure.subplots()
    for noise in np.random.default_rng(3).normal(size=(6, 30_000)):
        line(axis, np.arange(30_000.0), noise)
    save(figure, tmp_path / "noise")
    assert (tmp_path / "noise.svg").stat().st_size < 600_000


def test_spans_are_the_stretches_of_a_mask() -> None:
    time_s = np.arange(6.0)
    assert spans(time_s, np.array([1, 1, 0, 0, 1, 0], np.bool_)) == [(0.0, 1.0), (4.0, 4.0)]
    assert spans(time_s, np.zeros(6, np.bool_)) == []


@pytest.mark.parametrize("right", [(-5.0, 1.0), (-0.1, 7.0), (0.0, 3.0)])
def test_aligned_axes_have_one_zero_and_still_hold_all(right: tuple[float, float]) -> None:
    one, other = Figure().subplots(2, 1)
    one.set_ylim(-1.0, 4.0)
    other.set_ylim(*right)
    align_zeros(one, other)
    shares = [-axis.get_ylim()[0] / np.ptp(axis.get_ylim()) for axis in (one, other)]
    assert shares[0] == pytest.approx(shares[1])
    for axis, (low, high) in ((one, (-1.0, 4.0)), (other, right)):
        assert axis.get_ylim()[0] <= low + 1e-12
        assert axis.get_ylim()[1] >= high - 1e-12


def test_outlines_cover_what_the_shapes_cover() -> None:
    assert _area(capsule_outline(((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0.1, (0, 1))) == pytest.approx(
        np.pi * 0.01, rel=5e-3
    )
    rod = capsule_outline(((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0.1, (0, 2))
    assert _area(rod) == pytest.approx(0.2 + np.pi * 0.01, rel=5e-3)
    turned = Box(
        name="box", position_in_world=(1.0, 2.0, 3.0), half_sizes=(0.1, 0.2, 0.3),
        orientation_to_world=(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)),
    )  # fmt: skip
    axis = Figure().subplots()
    draw_obstacle(axis, turned, (0, 1))
    (patch,) = axis.patches
    assert isinstance(patch, Polygon)
    assert_allclose((patch.get_xy().min(axis=0), patch.get_xy().max(axis=0)), [(0.8, 1.9), (1.2, 2.1)])
    draw_obstacle(axis, Pole(name="rod", start_in_world=(0, 0, 0), end_in_world=(1, 0, 0), radius=0.1), (0, 1))
    assert_allclose(axis.patches[1].get_xy().max(axis=0), (1.1, 0.1), rtol=1e-2)


def test_the_arm_goes_from_the_base_to_the_hand() -> None:
    robot = load_run("arm9-null-space").robot
    position = np.full(len(robot.description.joints), 0.1)
    points = ArmView(robot).points(position)
    assert len(points) == 12
    assert_allclose(points[0], 0.0)
    assert_allclose(points[-1], RobotModel(robot).pose(position, "hand")[0])


def _area(outline: Array) -> float:
    x, y = outline.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))
