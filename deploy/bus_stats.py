"""`cosim bus --stats`: how full each bus is, and what became of the frames of each identifier."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from deploy.bus_frames import BusFrame, duration_ns, identifier
from deploy.loads import BusMetrics, bus_metrics
from hal.profile.frames import CAN_EFF_MASK
from hal.profile.identifiers import SYNC
from schemas.log import LogReader
from schemas.messages import BusStatistics, FrameStatistics
from schemas.robot import RobotDescription
from schemas.topics import LOAD_PREFIX, decode


@dataclass(frozen=True, slots=True)
class BusReport:
    """Statistics of some buses of a robot."""

    metrics: tuple[BusMetrics, ...]
    timed: bool
    """Told by the bus itself, with times and losses; else counted from the frames seen, loads in time of SYNCs."""

    def as_json(self) -> list[dict[str, Any]]:
        """Plain values; what is not known is left out."""
        result = []
        for bus in self.metrics:
            values = asdict(bus)
            if not self.timed:
                for name in ("report_end_max_s", "command_end_max_s", "late", "replaced"):
                    del values[name]
                frames = [
                    {name: frame[name] for name in ("can_id", "what", "owner", "frames")} for frame in values["frames"]
                ]
                values["frames"] = frames
            result.append({**values, "timed": self.timed})
        return result

    def tables(self) -> list[tuple[str, Table]]:
        """One heading and table a bus."""
        return [(self._heading(bus), self._table(bus)) for bus in self.metrics]

    def _heading(self, bus: BusMetrics) -> str:
        text = f"bus {bus.bus}: load {bus.load_mean:.1%} on average, {bus.load_max:.1%} at most, {bus.cycles} cycles"
        if not self.timed:
            return text
        return (
            f"{text}\nlast report {_ms(bus.report_end_max_s)}, last command {_ms(bus.command_end_max_s)} after its SYNC"
        )

    def _table(self, bus: BusMetrics) -> Table:
        table = Table()
        table.add_column("id")
        table.add_column("frame")
        table.add_column("of")
        for name in ("frames", "late", "replaced", "wait mean", "wait max") if self.timed else ("frames",):
            table.add_column(name, justify="right")
        for frame in bus.frames:
            row = [f"{frame.can_id:03X}", frame.what, frame.owner, str(frame.frames)]
            if self.timed:
                row += [str(frame.late or ""), str(frame.replaced or "")]
                row += [f"{time_s * 1e6:.0f} µs" for time_s in (frame.wait_mean_s, frame.wait_max_s)]
            table.add_row(*row)
        return table


def logged_report(reader: LogReader, buses: Sequence[str]) -> BusReport | None:
    """Sum up what the buses said of themselves in a log; None when they said nothing: no simulated bus was there."""
    topics = [LOAD_PREFIX + bus for bus in buses]
    messages = [decode(BusStatistics, record.data) for record in reader.records(topics)]
    return BusReport(bus_metrics(reader.run.robot.description, messages), timed=True) if messages else None


def counted_report(robot: RobotDescription, frames: Iterable[BusFrame]) -> BusReport:
    """Count frames and load from the first SYNC of each bus on; a cycle lasts a period, whatever the clock says."""
    buses = {bus.name: _Count(bus.name, bus.bitrate, robot.period_ns) for bus in robot.buses}
    for each in frames:
        buses[each.bus].add(each.frame)
    messages = [count.summary() for count in buses.values() if count.cycles]
    return BusReport(bus_metrics(robot, messages), timed=False)


class _Count:
    """Frames of one bus."""

    def __init__(self, bus: str, bitrate: int, period_ns: int) -> None:
        self._bus = bus
        self._bitrate = bitrate
        self._period_ns = period_ns
        self._frames: Counter[int] = Counter()
        self._busy_ns = 0
        self._total_ns = 0
        self._longest_ns = 0
        self.cycles = 0

    def add(self, frame: bytes) -> None:
        number = identifier(frame)
        if number == SYNC:
            self._close()
            self.cycles += 1
        if self.cycles:
            self._frames[number] += 1
            self._busy_ns += duration_ns(frame, self._bitrate)

    def summary(self) -> BusStatistics:
        self._close()
        counts = sorted(self._frames.items(), key=lambda item: (item[0] & CAN_EFF_MASK, item[0]))
        return BusStatistics(
            sequence=self.cycles - 1,
            time_ns=(self.cycles - 1) * self._period_ns,
            bus=self._bus,
            cycles=self.cycles,
            load_mean=self._total_ns / (self.cycles * self._period_ns),
            load_max=self._longest_ns / self._period_ns,
            report_end_max_s=0.0,
            command_end_max_s=0.0,
            frames=tuple(FrameStatistics(can_id=can_id, frames=count) for can_id, count in counts),
        )

    def _close(self) -> None:
        self._longest_ns = max(self._longest_ns, self._busy_ns)
        self._total_ns += self._busy_ns
        self._busy_ns = 0


def _ms(time_s: float) -> str:
    return f"{time_s * 1e3:.3f} ms"
