"""Cycle times summed up once a second, and their percentiles over many seconds; summaries of buses merged."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.messages import BusStatistics, CycleStatistics, FrameStatistics
from schemas.statistics import CycleMeter, merge, percentile

PERIOD_S = 0.002


def summaries(times: np.ndarray) -> list[CycleStatistics]:
    """Feed cycles that follow each other without a gap; the last second is completed by an idle one."""
    meter = CycleMeter("hal", PERIOD_S)
    now, found = 0.0, []
    meter.report(0, 0, now)
    for sequence, time_s in enumerate(times):
        now += time_s
        meter.cycle(float(time_s))
        found.append(meter.report(sequence, 0, now))
    found.append(meter.report(len(times), 0, now + 1.0))
    return [each for each in found if each is not None]


@pytest.fixture
def times() -> np.ndarray:
    return np.random.default_rng(0).lognormal(np.log(1.5e-3), 0.4, 4000)


def test_nothing_before_a_second_is_over() -> None:
    meter = CycleMeter("hal", PERIOD_S)
    assert meter.report(0, 0, 10.0) is None
    meter.cycle(0.4)
    assert meter.report(1, 0, 10.99) is None
    assert meter.report(2, 0, 11.0) is not None
    assert meter.report(3, 0, 13.0) is None  # nothing counted since


def test_every_cycle_is_in_one_summary(times: np.ndarray) -> None:
    found = summaries(times)
    assert len(found) > 4
    assert sum(each.cycles for each in found) == len(times)
    for each in found:
        assert sum(count for _, count in each.cycle_time_counts) == each.cycles
        assert [number for number, _ in each.cycle_time_counts] == sorted({n for n, _ in each.cycle_time_counts})
        assert each.cycle_time_median_s <= each.cycle_time_p99_s <= each.cycle_time_max_s
    assert max(each.cycle_time_max_s for each in found) == times.max()


@pytest.mark.parametrize("q", [1.0, 50.0, 99.0, 99.9, 100.0])
def test_percentile_of_the_whole_run_is_at_most_a_bin_above(times: np.ndarray, q: float) -> None:
    exact = float(np.percentile(times, q, method="inverted_cdf"))
    found = percentile(summaries(times), q)
    assert found is not None
    assert exact < found <= exact * 10.0**0.01


def test_percentile_of_nothing_is_none() -> None:
    assert percentile([], 50.0) is None


def test_real_time_factor_is_simulated_over_wall_clock_time() -> None:
    (only,) = summaries(np.full(250, 0.001))  # a quarter of a second of cycles, then one idle
    assert only.real_time_factor == pytest.approx(250 * PERIOD_S / 1.25)


def test_late_and_missed_are_those_of_the_summary_alone() -> None:
    meter = CycleMeter("hal", PERIOD_S)
    meter.report(0, 0, 0.0)
    counts = []
    for second, (late, missed) in enumerate([(3, 1), (0, 0), (2, 5)], start=1):
        meter.cycle(PERIOD_S)
        meter.late_cycles += late
        meter.missed_commands += missed
        found = meter.report(second, 0, second - 0.5, final=second == 3) or meter.report(second, 0, float(second))
        assert found is not None
        counts.append((found.late_cycles, found.missed_commands))
    assert counts == [(3, 1), (0, 0), (2, 5)]


def _load(bus: str = "can0", *, sequence: int = 0, cycles: int = 1, load: float = 0.5, **frames: int) -> BusStatistics:
    one = FrameStatistics(can_id=0x181, frames=frames.get("count", 1), late=frames.get("late", 0), wait_mean_s=1e-4)
    return BusStatistics(
        sequence=sequence, time_ns=2 * sequence, bus=bus, cycles=cycles, load_mean=load, load_max=load,
        report_end_max_s=load * 1e-3, command_end_max_s=1e-3, frames=(one,),
    )  # fmt: skip


def test_one_summary_merges_to_itself() -> None:
    assert merge([_load()]) == _load()


def test_merged_counts_add_up_means_are_weighted_and_maxima_kept() -> None:
    merged = merge([_load(sequence=5, cycles=3, load=0.6, count=30, late=2), _load(sequence=1, load=0.2, count=10)])
    assert (merged.sequence, merged.time_ns, merged.cycles) == (5, 10, 4)
    assert merged.load_mean == pytest.approx(0.5)
    assert (merged.load_max, merged.report_end_max_s) == (0.6, 0.6e-3)
    assert (merged.frames[0].frames, merged.frames[0].late) == (40, 2)


def test_identifiers_of_all_summaries_are_in_the_merged_one_in_their_order() -> None:
    other = _load().model_copy(update={"frames": (FrameStatistics(can_id=0x80, frames=7, wait_max_s=1e-3),)})
    merged = merge([_load(), other])
    assert [(each.can_id, each.frames) for each in merged.frames] == [(0x80, 7), (0x181, 1)]
    assert merged.frames[0].wait_max_s == 1e-3


@pytest.mark.parametrize("parts", [[], [_load(), _load("can1")]])
def test_summaries_of_no_or_several_buses_are_refused(parts: list[BusStatistics]) -> None:
    with pytest.raises(ValueError, match="one bus"):
        merge(parts)
