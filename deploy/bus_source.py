"""What `cosim bus` looks at: the live buses of a run or a robot, a log, or a file of another CAN tool."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.bus_cycles import by_time
from deploy.bus_files import ChannelMap, read_frames
from deploy.bus_frames import BusFrame, in_time
from deploy.bus_monitor import channel_options, choose_buses, live_channels, live_frames
from deploy.errors import UsageError
from deploy.launcher import RUN_NAME
from deploy.run_file import read_run
from deploy.session import choose_session
from schemas.load import Run, load_robot
from schemas.log import LogReader
from schemas.messages import BusFrames
from schemas.robot import RobotDescription

LOG_SUFFIX = ".mcap"


@dataclass(frozen=True, slots=True)
class Place:
    """A robot, and the log or file of frames if it is not the live one."""

    robot: RobotDescription
    path: Path | None = None
    log: LogReader | None = None
    run: Run | None = None
    """Of the log, of the scenario that was named, or the one going on."""
    base_port: int | None = None


def find_place(path: Path | None, robot: str | None, run: Run | None, base_port: int | None) -> Place:
    """Find out which robot it is: that of the log, of the run given, the one named, or that of the run going on.

    Raises:
        UsageError: named twice or not at all.
        CosimError: log or robot cannot be read.

    """
    if robot is not None and run is not None:
        raise UsageError("give --robot or --scenario, which has its own robot")
    if path is not None and path.suffix == LOG_SUFFIX:
        if robot is not None or run is not None:
            raise UsageError(f"{path} holds its own robot and scenario; leave --robot and --scenario out")
        log = LogReader(path)
        return Place(log.run.robot.description, path, log, log.run)
    if run is not None:
        return Place(run.robot.description, path, run=run, base_port=base_port)
    if robot is not None:
        return Place(load_robot(robot, allow_overload=True).description, path, base_port=base_port)
    if path is not None:
        raise UsageError(f"{path}: give --robot or --scenario, so that its frames have names")
    running = read_run(Path(choose_session(base_port).output) / RUN_NAME)
    return Place(running.robot.description, run=running, base_port=base_port)


@dataclass(frozen=True, slots=True)
class Feed:
    """Frames of the chosen buses of a place."""

    place: Place
    buses: tuple[str, ...]
    given: dict[str, str]
    """Channels by bus, where they are not the description's."""

    @classmethod
    def of(cls, place: Place, bus: str | None, channels: Sequence[str]) -> Feed:
        """Choose by the options --bus and --channel; channels of some buses choose these.

        Raises:
            UsageError: no such bus, or it is open which is meant.

        """
        buses = choose_buses(place.robot, bus)
        given = channel_options(place.robot, buses, channels)
        if bus is None and given:
            buses = tuple(name for name in buses if name in given)
        return cls(place, buses, given)

    @property
    def channels(self) -> ChannelMap:
        """Names of the buses in a file."""
        return ChannelMap(self.place.robot, self.given, self.buses[0] if len(self.buses) == 1 else None)

    def frames(self, interface_of: Callable[[str], tuple[str, str]], tell: Callable[[str], None]) -> Iterator[BusFrame]:
        """Yield them from wherever they come.

        Args:
            interface_of: interface and channel of what --channel gave.
            tell: takes a line when a live bus goes.

        Raises:
            CosimError: the file cannot be read, or a bus not opened.

        """
        place = self.place
        if place.log is not None:
            messages = (each for each in place.log.messages(BusFrames) if each.bus in self.buses)
            yield from in_time(place.robot, messages, len(self.buses))
        elif place.path is not None:
            yield from self._of_file(place.path)
        else:
            given = {name: interface_of(text) for name, text in self.given.items()}
            channels = live_channels(place.robot, self.buses, given, lambda: choose_session(place.base_port).directory)
            yield from live_frames(place.robot, channels, tell)

    def _of_file(self, path: Path) -> Iterator[BusFrame]:
        empty = True
        for frame in by_time(each for each in read_frames(path, self.channels) if each.bus in self.buses):
            empty = False
            yield frame
        if empty:
            names = ", ".join(self.buses)
            raise UsageError(f"{path}: no frames of bus {names}; give --channel BUS=CHANNEL with its channel there")
