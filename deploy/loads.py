"""The buses of a run as measured: loads, latest completions, late and replaced frames by COB-ID."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from deploy.bus_layout import ALL, bus_layouts
from schemas.messages import BusStatistics
from schemas.robot import RobotDescription
from schemas.statistics import merge

UNPLANNED: Final = frozenset({"EMCY", "SDO answer", "SDO request", "NMT"})
"""What the worst case of a cycle leaves out."""
LISTED_FRAMES: Final = 3
"""Frames that a line names; the rest is in the JSON."""


@dataclass(frozen=True, slots=True)
class FrameMetrics:
    """What became of the frames of one COB-ID."""

    can_id: int
    what: str
    """E.g. `RPDO1`; the number of a COB-ID that is nobody's."""
    owner: str
    """Joint or sensor that it is of, `all` for SYNC and NMT; empty when it is nobody's."""
    frames: int
    late: int
    replaced: int
    wait_mean_s: float
    wait_max_s: float

    @property
    def name(self) -> str:
        """E.g. `RPDO1 of elbow`."""
        return self.what if self.owner in ("", ALL) else f"{self.what} of {self.owner}"


@dataclass(frozen=True, slots=True)
class BusMetrics:
    """One bus over the whole run; times of completion count from the SYNC of their cycle."""

    bus: str
    cycles: int
    load_mean: float
    load_max: float
    report_end_max_s: float
    command_end_max_s: float
    late: int
    """Commands that were on the bus only after the SYNC that was to latch them."""
    replaced: int
    """Frames that were never transmitted: a newer one took their place."""
    frames: tuple[FrameMetrics, ...]

    @property
    def unplanned(self) -> int:
        """Frames that the worst case of a cycle leaves out, or knows nothing of."""
        return sum(frame.frames for frame in self.frames if frame.what in UNPLANNED or not frame.owner)

    def complaint(self) -> str:
        """Say in a line which frames were late or replaced; empty when none was."""
        if not self.late and not self.replaced:
            return ""
        worst = sorted((f for f in self.frames if f.late or f.replaced), key=lambda f: -(f.late + f.replaced))
        parts = [f"{f.name} {_counts(f.late, f.replaced)}" for f in worst[:LISTED_FRAMES]]
        if len(worst) > LISTED_FRAMES:
            parts.append(f"{len(worst) - LISTED_FRAMES} more")
        return f"bus {self.bus}: {_counts(self.late, self.replaced)} frames ({'; '.join(parts)})"


def bus_metrics(robot: RobotDescription, statistics: Iterable[BusStatistics]) -> tuple[BusMetrics, ...]:
    """Sum up all messages of a run, in the order of the robot's buses; a bus without a message is left out."""
    by_bus: dict[str, list[BusStatistics]] = {bus.name: [] for bus in robot.buses}
    for message in statistics:
        by_bus[message.bus].append(message)
    return tuple(_of(robot, merge(messages)) for messages in by_bus.values() if messages)


def _of(robot: RobotDescription, statistics: BusStatistics) -> BusMetrics:
    names = {layout.can_id: (layout.what, layout.owner) for layout in bus_layouts(robot, statistics.bus)}
    frames = []
    for frame in statistics.frames:
        what, owner = names.get(frame.can_id, (f"0x{frame.can_id:03X}", ""))
        frames.append(FrameMetrics(what=what, owner=owner, **dict(frame)))
    return BusMetrics(
        bus=statistics.bus,
        cycles=statistics.cycles,
        load_mean=statistics.load_mean,
        load_max=statistics.load_max,
        report_end_max_s=statistics.report_end_max_s,
        command_end_max_s=statistics.command_end_max_s,
        late=sum(frame.late for frame in frames),
        replaced=sum(frame.replaced for frame in frames),
        frames=tuple(frames),
    )


def _counts(late: int, replaced: int) -> str:
    """`300 late, 12 replaced`, without what is none."""
    return ", ".join(f"{count} {what}" for count, what in ((late, "late"), (replaced, "replaced")) if count)
