"""A delay line: what was pushed comes out that much later, also between cycles and over missed ones."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.delay_line import DelayLine

T = 0.001


@pytest.mark.parametrize("cycles", [0, 1, 7])
def test_a_whole_delay_gives_back_the_very_rows(cycles: int) -> None:
    line, rows = DelayLine(3, cycles * T, T), np.random.default_rng(0).standard_normal((30, 3))
    for k, row in enumerate(rows):
        assert np.array_equal(line.push(row), rows[max(0, k - cycles)])


@pytest.mark.parametrize("delay", [0.3, 0.5, 39.5, 2.25])
def test_a_part_of_a_cycle_lies_on_the_line_between_two_rows(delay: float) -> None:
    line, rows = DelayLine(2, delay * T, T), np.random.default_rng(1).standard_normal((120, 2))
    for k, row in enumerate(rows):
        expected = [np.interp(max(0.0, k - delay), np.arange(120), rows[:, channel]) for channel in range(2)]
        assert line.push(row) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("whole", range(1, 60))
def test_rounding_of_the_delay_costs_no_cycle(whole: int) -> None:
    line = DelayLine(1, whole * T, T)
    for k in range(whole + 3):
        given = line.push(np.array([float(k)]))
    assert given == pytest.approx([2.0], abs=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.5, 3.0, 7.5])
@pytest.mark.parametrize("gaps", [(2, 1, 3, 1), (5, 1, 1), (9, 2, 30), (100,)])
def test_missed_cycles_of_a_ramp_are_as_if_none_was_missed(delay: float, gaps: tuple[int, ...]) -> None:
    line, slope, now = DelayLine(2, delay * T, T), np.array([1.0, -3.0]), 0
    line.push(0.0 * slope)
    for _ in range(12):
        now += 1
        line.push(now * slope)
    for gap in gaps:
        now += gap
        assert line.push(now * slope, gap) == pytest.approx((now - delay) * slope, abs=1e-9)
    for _ in range(12):
        now += 1
        assert line.push(now * slope) == pytest.approx((now - delay) * slope, abs=1e-9)


def test_before_the_first_row_all_were_like_it() -> None:
    line = DelayLine(1, 4.5 * T, T)
    assert line.push(np.array([5.0]), 3).item() == 5.0
    given = [line.push(np.array([6.0])).item() for _ in range(6)]
    assert given == [5.0, 5.0, 5.0, 5.0, 5.5, 6.0]


@pytest.mark.parametrize("delay", [0.0, 0.5, 3.0])
def test_rows_in_and_out_are_the_caller_s(delay: float) -> None:
    """Neither a row that is changed after it was pushed nor one that came out and is changed touches the line."""
    line, untouched = DelayLine(1, delay * T, T), DelayLine(1, delay * T, T)
    for k in range(10):
        row = np.array([float(k)])
        expected = untouched.push(row.copy())
        given = line.push(row)
        assert np.array_equal(given, expected)
        given += 100.0
        row += 1000.0
