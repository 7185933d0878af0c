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

    def clear(self) -> None:
        """Begin anew."""
        self.frames = self.late = self.replaced = self.wait_ns = self.wait_max_ns = 0

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
        self._accounts: dict[int, Account] = {}
        self.busy_ns = 0
        """Of the cycle in course."""
        self._begun_ns: int | None = None
        self._restart()

    def _restart(self) -> None:
        """Forget what has been told; the cycle in course goes on."""
        for account in self._accounts.values():
            account.clear()
        self._cycles = 0
        self._busy_total_ns = 0
        self._time_total_ns = 0
        self._load_max = 0.0
        self._report_end_ns = 0
        self._command_end_ns = 0

    def account(self, can_id: int) -> Account:
        """Give the sums of one identifier, to add to; they stay the same object."""
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

    def begin(self, now_ns: int, idle_ns: int) -> None:
        """End the cycle in course and begin another, which has the rest of a frame on the bus until `idle_ns`."""
        rest_ns = max(0, idle_ns - now_ns)
        if self._begun_ns is None:
            self._restart()  # the boot is no cycle
        else:
            self.busy_ns -= rest_ns
            self._end_cycle(now_ns - self._begun_ns)
        self._begun_ns, self.busy_ns = now_ns, rest_ns

    def end(self, now_ns: int, idle_ns: int) -> None:
        """End the cycle in course: no SYNC is to come. What the frame on the bus takes after it is of no cycle."""
        if self._begun_ns is not None:
            end_ns = max(now_ns, self._begun_ns + self._period_ns)
            self.busy_ns -= max(0, idle_ns - end_ns)
            self._end_cycle(end_ns - self._begun_ns)
            self._begun_ns = None

    def take(self, bus: str, sequence: int, time_ns: int) -> BusStatistics | None:
        """Sum up the cycles that have ended since the last call; None: no cycle."""
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
            frames=tuple(
                account.summary(can_id)
                for can_id, account in sorted(self._accounts.items())
                if account.frames or account.replaced
            ),
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
