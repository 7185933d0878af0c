"""What the figures of motor identification must show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

from controller_service.motor_fit import fit_least_squares
from deploy.identify import Identification
from experiments.figures import friction_figure, motor_figure, save
from tests.experiments.made_up_motors import made_up_identification

ANKLE = 5


@pytest.fixture(scope="module")
def result() -> Identification:
    return made_up_identification()


@pytest.fixture(scope="module")
def torque(result: Identification) -> Figure:
    return motor_figure(result, ANKLE)


@pytest.fixture(scope="module")
def friction(result: Identification) -> Figure:
    return friction_figure(result, ANKLE)


def panel(figure: Figure, start: str) -> Axes:
    return next(axis for axis in figure.axes if axis.get_title(loc="left").startswith(start))


def slope(axis: Axes, label: str) -> float:
    line = next(line for line in axis.lines if str(line.get_label()).startswith(label))
    x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    return float(np.polyfit(x, y, 1)[0])


@pytest.mark.parametrize("name", ["torque", "friction"])
def test_every_axis_has_its_unit(name: str, request: pytest.FixtureRequest) -> None:
    figure: Figure = request.getfixturevalue(name)
    assert len(figure.axes) == 4
    bottom, left = figure.axes[2:], figure.axes[::2]
    assert all("[" in axis.get_xlabel() for axis in bottom)
    assert all("[" in axis.get_ylabel() for axis in left)


def test_four_panels_show_the_same_samples_at_rest(torque: Figure, result: Identification) -> None:
    samples = result.data.of(ANKLE)
    resting = samples.torque[np.abs(samples.velocity) < result.options.still_velocity]
    for axis in torque.axes:
        shown = [line for line in axis.lines if str(line.get_label()).startswith("samples")]
        assert len(shown) == 2
        seen = np.concatenate([np.asarray(line.get_xdata(), float) for line in shown])
        assert np.isin(seen, resting).all()
        assert len(seen) > 1000


def test_points_are_split_by_the_sign_of_the_velocity(torque: Figure) -> None:
    axis = panel(torque, "(a)")
    way = {str(line.get_label()): np.asarray(line.get_ydata(), float).mean() for line in axis.lines}
    assert way["samples, q̇ > 0"] > way["samples, q̇ < 0"]  # friction


def test_lines_are_those_of_the_fits(torque: Figure, friction: Figure, result: Identification) -> None:
    fit, symmetric = result.joints[ANKLE].fit, fit_least_squares(result.data.of(ANKLE))
    assert_allclose(slope(panel(torque, "(b)"), "symmetric"), symmetric.torque_gain * 1e3)
    assert_allclose(slope(panel(torque, "(d)"), "two-stage"), fit.torque_gain * 1e3)
    assert_allclose(slope(panel(friction, "symmetric"), "symmetric"), symmetric.velocity_gain * 1e3)
    assert_allclose(slope(panel(friction, "two-stage"), "two-stage"), fit.velocity_gain * 1e3)


def test_the_piecewise_panel_says_how_the_fits_ended(torque: Figure) -> None:
    assert panel(torque, "(c)").get_title(loc="left").count("converge") == 2


def test_the_identified_model_over_estimates_less_than_the_symmetric_one(friction: Figure) -> None:
    above, below = friction.axes[1], friction.axes[3]
    rates = [float(axis.get_title(loc="left").split("%")[0]) for axis in (above, below)]
    assert rates[1] < 0.5 * rates[0]
    over = [sum(bar.get_height() for bar in axis.patches if bar.get_x() >= -1e-9) for axis in (above, below)]
    assert_allclose(np.array(over) * 100.0, rates, atol=0.2)


def test_figures_are_written(torque: Figure, friction: Figure, tmp_path: Path) -> None:
    for name, figure in (("torque", torque), ("friction", friction)):
        save(figure, tmp_path / name)
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000
        assert (tmp_path / f"{name}.svg").stat().st_size > 20_000
