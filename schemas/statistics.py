"""Wall-clock figures of a service's cycles, summed up once a second; summaries of buses put together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

import numpy as np

from schemas.messages import BusStatistics, CycleStatistics, FrameStatistics

INTERVAL_S: Final = 1.0
BINS_PER_DECADE: Final = 100
_SHORTEST_S: Final = 1e-7
"""Bounds the histogram below; no cycle is that short."""


class CycleMeter:
    """Collects cycle times; `report` gives a summary when a wall-clock second is over. Time is passed in [s]."""

    def __init__(self, service: str, period_s: float) -> None:
        self._service = service
        self._period_s = period_s
        self._times: list[float] = []
        self._begun_s: float | None = None
        self.late_cycles = 0
        """Since the last summary, as the next."""
        self.missed_commands = 0

    def cycle(self, duration_s: float) -> None:
        """Count one cycle."""
        self._times.append(duration_s)

    def report(self, sequence: int, time_ns: int, now_s: float, *, final: bool = False) -> CycleStatistics | None:
        """Summary since the last one; None before a second is over, unless `final`, or when nothing was counted."""
        if self._begun_s is None:
            self._begun_s = now_s
            return None
        elapsed = now_s - self._begun_s
        if not self._times or (elapsed < INTERVAL_S and not final) or elapsed <= 0.0:
            return None
        times = np.array(self._times)
        median, p99, longest = np.percentile(times, (50.0, 99.0, 100.0)).tolist()
        bins = np.floor(BINS_PER_DECADE * np.log10(np.maximum(times, _SHORTEST_S) * 1e6)).astype(np.int64)
        summary = CycleStatistics(
            service=self._service,
            sequence=sequence,
            time_ns=time_ns,
            cycles=len(self._times),
            cycle_time_median_s=median,
            cycle_time_p99_s=p99,
            cycle_time_max_s=longest,
            cycle_time_counts=tuple(sorted(Counter(bins.tolist()).items())),
            late_cycles=self.late_cycles,
            missed_commands=self.missed_commands,
            real_time_factor=len(self._times) * self._period_s / elapsed,
        )
        self._times.clear()
        self.late_cycles = self.missed_commands = 0
        self._begun_s = now_s
        return summary


def percentile(statistics: Iterable[CycleStatistics], q: float) -> float | None:
    """Percentile (0 < q ≤ 100) of the cycle times [s] of several summaries together; None when they hold none.

    It is the upper edge of the bin in which the percentile lies, so never below the true one and at most 2.3 % above.
    """
    counts: Counter[int] = Counter()
    for each in statistics:
        counts.update(dict(each.cycle_time_counts))
    needed, seen = q / 100.0 * counts.total(), 0
    for number, count in sorted(counts.items()):
        seen += count
        if seen >= needed:
            return float(10.0 ** ((number + 1) / BINS_PER_DECADE) * 1e-6)
    return None


def merge(statistics: Iterable[BusStatistics]) -> BusStatistics:
    """One summary of several of the same bus, as if they were one: counts add up, means are weighted, maxima kept.

    It bears sequence and time of the last. Loads are weighted by cycles, waits by frames.

    Raises:
        ValueError: no summary, or those of different buses.

    """
    parts = list(statistics)
    if len({part.bus for part in parts}) != 1:
        named = ", ".join(sorted({part.bus for part in parts})) or "none"
        raise ValueError(f"summaries of one bus are wanted, at least one; given are those of: {named}")
    cycles = sum(part.cycles for part in parts)
    frames: dict[int, list[FrameStatistics]] = {}
    for part in parts:
        for each in part.frames:
            frames.setdefault(each.can_id, []).append(each)
    last = max(parts, key=lambda part: (part.sequence, part.time_ns))
    return BusStatistics(
        sequence=last.sequence,
        time_ns=last.time_ns,
        bus=last.bus,
        cycles=cycles,
        load_mean=sum(part.load_mean * part.cycles for part in parts) / max(cycles, 1),
        load_max=max(part.load_max for part in parts),
        report_end_max_s=max(part.report_end_max_s for part in parts),
        command_end_max_s=max(part.command_end_max_s for part in parts),
        frames=tuple(_merge_frames(can_id, frames[can_id]) for can_id in sorted(frames)),
    )


def _merge_frames(can_id: int, parts: list[FrameStatistics]) -> FrameStatistics:
    count = sum(part.frames for part in parts)
    return FrameStatistics(
        can_id=can_id,
        frames=count,
        late=sum(part.late for part in parts),
        replaced=sum(part.replaced for part in parts),
        wait_mean_s=sum(part.wait_mean_s * part.frames for part in parts) / max(count, 1),
        wait_max_s=max(part.wait_max_s for part in parts),
    )
