from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.measure import Stopwatch, Timing, measure
from benchmarks.yardstick import ping_pong


def test_figures_are_percentiles_of_the_samples() -> None:
    figures = Timing("stage", np.arange(1.0, 1002.0)).figures()
    assert (figures.count, figures.median_s) == (1001, 501.0)
    assert (figures.p99_s, figures.p99_9_s) == pytest.approx((991.0, 1000.0))
    assert json.loads(json.dumps(figures.as_json()))["name"] == "stage"


def test_warm_up_does_not_count() -> None:
    calls: list[int] = []
    assert len(measure("call", lambda: calls.append(1), 7, warm_up=3).samples) == 7
    assert len(calls) == 10


def test_a_stopwatch_passes_values_and_errors_on() -> None:
    class Owner:
        def halve(self, value: int) -> float:
            if value < 0:
                raise ValueError("negative")
            return value / 2

    owner = Owner()
    watch = Stopwatch("halve", owner, "halve")
    assert owner.halve(3) == 1.5
    with pytest.raises(ValueError, match="negative"):
        owner.halve(-1)
    assert len(watch.timing().samples) == 2
    watch.clear()
    assert len(watch.timing().samples) == 0


@pytest.mark.processes
def test_every_ping_has_its_pong() -> None:
    timing = ping_pong(20, warm_up=2)
    assert len(timing.samples) == 20
    assert (timing.samples > 0.0).all()
