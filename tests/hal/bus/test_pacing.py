"""A burst passes no faster than four frames ahead of the wire, and never slower than the wire."""

from __future__ import annotations

import pytest

from hal.bus.pacing import FRAMES_AHEAD, WirePacer, wire_time_s

FRAME_S = 111e-6
"""An 8-byte frame without stuff bits at 1 Mbit/s: 44 + 64 bits and 3 of interframe space."""


def send(pacer: WirePacer, count: int, now: float, oversleep: float = 0.0) -> list[float]:
    """Times at which frames are sent by somebody who waits as told, and a little longer."""
    times = []
    for _ in range(count):
        if (wait := pacer.wait_s(8, now)) > 0.0:
            now += wait + oversleep
        times.append(now)
    return times


def test_wire_times() -> None:
    assert wire_time_s(8, 1_000_000) == pytest.approx(FRAME_S)
    assert wire_time_s(0, 125_000) == pytest.approx(47 / 125_000)


@pytest.mark.parametrize("oversleep", [0.0, 60e-6, 300e-6])
def test_a_burst_keeps_a_fifo_of_five_frames_from_overflowing(oversleep: float) -> None:
    times = send(WirePacer(1_000_000), 50, 10.0, oversleep)
    for first in range(50 - FRAMES_AHEAD):
        # Frame n + 4 leaves when a wire has carried frame n.
        assert times[first + FRAMES_AHEAD] >= 10.0 + (first + 1) * FRAME_S - 1e-12


@pytest.mark.parametrize("oversleep", [0.0, 60e-6, 300e-6])
def test_a_wire_never_runs_dry(oversleep: float) -> None:
    times = send(WirePacer(1_000_000), 50, 10.0, oversleep)
    carried = 10.0
    for time in times:
        assert time <= carried + 1e-12, "the wire had nothing to carry"
        carried += FRAME_S


def test_a_pause_gives_no_credit_beyond_the_burst() -> None:
    pacer = WirePacer(1_000_000)
    send(pacer, 50, 0.0)
    times = send(pacer, 6, 5.0)
    assert times[:FRAMES_AHEAD] == pytest.approx([5.0] * FRAMES_AHEAD)
    assert times[FRAMES_AHEAD] == pytest.approx(5.0 + FRAME_S)
    assert times[FRAMES_AHEAD + 1] == pytest.approx(5.0 + 2 * FRAME_S)


def test_frames_within_the_wires_pace_never_wait() -> None:
    pacer = WirePacer(500_000)
    assert [pacer.wait_s(8, n * 222e-6) for n in range(100)] == [0.0] * 100
