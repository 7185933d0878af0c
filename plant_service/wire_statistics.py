"""What came of the frames of one bus: loads of its cycles, ends of reports and commands, waits, losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from schemas.messages import BusStatistics, FrameStatistics

NANO: Final = 1e-9


@dataclass(slots=True)
class Account:
    """Sums of one identifier's frames; waits in ns."""

    frames: int = 0
    late: int = 0
    replaced: int = 0
    wait_ns: int = 0
    wait_max_ns: int = 0

    def add(self, wait_ns: int) -> None:
        """Count a frame that was on the bus."""
        self.frames += 1
        self.wait_ns += wait_ns
        if wait_ns > self.wait_max_ns:
            self.wait_max_ns = wait_ns

    def summary(self, can_id: int) -> FrameStatistics:
        """As a message."""
        return FrameStatistics(
            can_id=can_id,
            frames=self.frames,
            late=self.late,
            replaced=self.replaced,
            wait_mean_s=self.wait_ns / max(self.frames, 1) * NANO,
            wait_max_s=self.wait_max_ns * NANO,
        )


class WireStatistics:
    """Collects between two messages, from the first SYNC on. A cycle's load is known when the next one begins.

    Times in ns. A cycle shorter than the period (realtime: a SYNC after a late one) counts as one period.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.busy_ns = 0
        """Of the cycle in course."""
        self._begun_ns: int | None = None
        self._restart()

    def _restart(self) -> None:
        """Forget what has been told; the cycle in course goes on."""
        self._accounts: dict[int, Account] = {}
        self._cycles = 0
        self._busy_total_ns = 0
        self._time_total_ns = 0
        self._load_max = 0.0
        self._report_end_ns = 0
        self._command_end_ns = 0

    def account(self, can_id: int) -> Account:
        """Give the sums of one identifier, to add to."""
        account = self._accounts.get(can_id)
        if account is None:
            account = self._accounts[can_id] = Account()
        return account

    def completed(self, end_ns: int, is_command: bool, is_report: bool) -> None:
        """Note when process data was through, counted from the SYNC before it was put."""
        if is_command:
            if end_ns > self._command_end_ns:
                self._command_end_ns = end_ns
        elif is_report and end_ns > self._report_end_ns:
            self._report_end_ns = end_ns

    def begin(self, now_ns: int) -> None:
        """End the cycle in course and begin another."""
        if self._begun_ns is None:
            self.busy_ns = 0  # the boot is no cycle
            self._restart()
        else:
            self._end_cycle(now_ns - self._begun_ns)
        self._begun_ns = now_ns

    def take(self, bus: str, sequence: int, time_ns: int, *, final: bool = False) -> BusStatistics | None:
        """Sum up the cycles that have ended since the last call, with `final` the one in course too; None: no cycle."""
        if final and self._begun_ns is not None:
            self._end_cycle(0)
            self._begun_ns = None
        if not self._cycles:
            return None
        message = BusStatistics(
            sequence=sequence,
            time_ns=time_ns,
            bus=bus,
            cycles=self._cycles,
            load_mean=self._busy_total_ns / self._time_total_ns,
            load_max=self._load_max,
            report_end_max_s=self._report_end_ns * NANO,
            command_end_max_s=self._command_end_ns * NANO,
            frames=tuple(account.summary(can_id) for can_id, account in sorted(self._accounts.items())),
        )
        self._restart()
        return message

    def _end_cycle(self, duration_ns: int) -> None:
        duration_ns = max(duration_ns, self._period_ns)
        self._cycles += 1
        self._busy_total_ns += self.busy_ns
        self._time_total_ns += duration_ns
        self._load_max = max(self._load_max, self.busy_ns / duration_ns)
        self.busy_ns = 0
