from __future__ import annotations

import math
from pathlib import Path

import pytest

from deploy.experiment import Bar, ExperimentResult, FailedRun
from deploy.sweep_figure import limit_share, sweep_figure


def result(seed: int, *bars: Bar) -> ExperimentResult:
    return ExperimentResult("transition", "arm9", seed, {}, {}, bars)


@pytest.mark.parametrize(
    ("bar", "share"),
    [
        (Bar("x", 2.0, 4.0), 0.5),
        (Bar("x", 8.0, 4.0), 2.0),
        (Bar("x", -2.0, 4.0), 0.0),
        (Bar("x", 8.0, 4.0, at_least=True), 0.5),
        (Bar("x", 2.0, 4.0, at_least=True), 2.0),
        (Bar("x", 0.0, 4.0, at_least=True), math.inf),
        (Bar("x", -1.0, 4.0, at_least=True), math.inf),
        (Bar("x", 0.0, 0.0), 0.0),
        (Bar("x", 1.0, 0.0), math.inf),
        (Bar("x", 0.0, -1.0, at_least=True), 0.0),
        (Bar("x", math.nan, 4.0), math.inf),
        (Bar("x", math.inf, 4.0), math.inf),
        (Bar("x", math.inf, 4.0, at_least=True), 0.0),
        (Bar("x", math.nan, 4.0, at_least=True), math.inf),
    ],
)
def test_shares_of_the_limit(bar: Bar, share: float) -> None:
    assert limit_share(bar) == share
    assert bar.holds is (share <= 1.0)


def test_the_figure_has_a_row_a_bar_and_a_point_a_seed(tmp_path: Path) -> None:
    values = [(0.5, 20.0), (1.2, 5.0), (math.nan, math.nan)]
    outcomes = [
        *(result(seed, Bar("most", a, 1.0), Bar("least", b, 10.0, True)) for seed, (a, b) in enumerate(values)),
        FailedRun(7, "stopped"),
    ]
    figure = sweep_figure("transition", outcomes)
    axis = figure.axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["most ≤ 1", "least ≥ 10"]
    assert figure.get_suptitle() == "transition on arm9: 1 of 4 seeds pass"
    assert figure.legends[0].get_title().get_text() == "without result: seed 7"
    points = sum(len(drawn.get_offsets()) for drawn in axis.collections if drawn.get_sizes()[0] < 50)
    assert points == 6
    low, high = axis.get_xlim()
    for drawn in axis.collections:
        assert all(low < x < high for x, _ in drawn.get_offsets())
    figure.savefig(tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 1000


def test_one_seed_with_values_beyond_all_limits_is_drawn(tmp_path: Path) -> None:
    bars = (Bar("tiny", 1e-12, 1.0), Bar("huge", 1e12, 1.0), Bar("none", 0.0, 0.0))
    sweep_figure("transition", [result(0, *bars)]).savefig(tmp_path / "sweep.png")
    low, high = sweep_figure("transition", [result(0, *bars)]).axes[0].get_xlim()
    assert low < 1.0 < high
