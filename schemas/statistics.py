"""Wall-clock figures of a service's cycles, summed up once a second."""

from __future__ import annotations

import statistics

from schemas.messages import CycleStatistics

INTERVAL_S = 1.0


class CycleMeter:
    """Collects cycle times; `report` gives a summary when a wall-clock second is over. Time is passed in [s]."""

    def __init__(self, service: str, period_s: float) -> None:
        self._service = service
        self._period_s = period_s
        self._times: list[float] = []
        self._begun_s: float | None = None
        self.late_cycles = 0
        self.missed_commands = 0

    def cycle(self, duration_s: float) -> None:
        """Count one cycle."""
        self._times.append(duration_s)

    def report(self, sequence: int, time_ns: int, now_s: float, *, final: bool = False) -> CycleStatistics | None:
        """Summary since the last one; None before a second is over, or when nothing was counted."""
        if self._begun_s is None:
            self._begun_s = now_s
            return None
        elapsed = now_s - self._begun_s
        if not self._times or (elapsed < INTERVAL_S and not final) or elapsed <= 0.0:
            return None
        summary = CycleStatistics(
            service=self._service,
            sequence=sequence,
            time_ns=time_ns,
            cycles=len(self._times),
            cycle_time_median_s=statistics.median(self._times),
            cycle_time_max_s=max(self._times),
            late_cycles=self.late_cycles,
            missed_commands=self.missed_commands,
            real_time_factor=len(self._times) * self._period_s / elapsed,
        )
        self._times.clear()
        self._begun_s = now_s
        return summary
