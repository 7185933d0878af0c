"""`cosim bus`: where frames come from, what of them is wanted, and how they are shown."""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Final

import can

from deploy.bus_frames import BusFrame, hal_identifiers
from deploy.bus_layout import ALL, HAL, bus_layouts
from deploy.bus_names import BUS_ERROR, CONTROLLER, Decoded, FrameNames
from deploy.errors import UsageError
from hal.bus.can_frame import encode
from schemas.robot import RobotDescription

POLL_S: Final = 0.2
Waiting = queue.SimpleQueue[tuple[str, can.Message | Exception | None]]
"""What buses brought: messages, the error that ended one, None when all is to end."""
_NUMBER: Final = re.compile(r"(0x)?[0-9a-fA-F]{1,8}")


def choose_buses(robot: RobotDescription, bus: str | None) -> tuple[str, ...]:
    """Names of the buses that an option names (`A` or `A,B`); all of the robot without one.

    Raises:
        UsageError: the robot has no such bus.

    """
    known = tuple(each.name for each in robot.buses)
    if bus is None:
        return known
    chosen = tuple(name.strip() for name in bus.split(","))
    for name in chosen:
        if name not in known:
            raise UsageError(f"--bus {name}: robot {robot.name} has {', '.join(known)}")
    return tuple(name for name in known if name in chosen)


def channel_options(robot: RobotDescription, buses: Sequence[str], channels: Iterable[str]) -> dict[str, str]:
    """Channel by bus, of options `NAME=CHANNEL`, or `CHANNEL` where there is one bus.

    Raises:
        UsageError: no such bus, given twice, or it is open which bus is meant.

    """
    found: dict[str, str] = {}
    for text in channels:
        name, equals, channel = text.partition("=")
        if not equals:
            if len(buses) != 1:
                raise UsageError(f"--channel {text}: of which bus? Give e.g. --channel {buses[0]}={text}")
            name, channel = buses[0], text
        choose_buses(robot, name)
        if name in found or not channel:
            raise UsageError(f"--channel {text}: " + ("no channel" if not channel else f"bus {name} is given twice"))
        found[name] = channel
    return found


@dataclass(frozen=True, slots=True)
class Only:
    """Which frames are wanted: by joint, sensor, kind of frame or identifier; all without any word."""

    words: frozenset[str] = frozenset()
    ids: frozenset[int] = frozenset()

    @classmethod
    def of(cls, robot: RobotDescription, buses: Sequence[str], texts: Iterable[str]) -> Only:
        """Read the options.

        Raises:
            UsageError: a word that no frame of these buses has.

        """
        layouts = [layout for bus in buses for layout in bus_layouts(robot, bus)]
        owners = {layout.owner for layout in layouts} | {ALL, HAL, CONTROLLER}
        kinds = {layout.what for layout in layouts} | {BUS_ERROR}
        known = {name.lower() for name in owners | kinds | {kind.split()[0] for kind in kinds}}
        words, ids = set(), set()
        for text in texts:
            if text.lower() in known:
                words.add(text.lower())
            elif _NUMBER.fullmatch(text):
                ids.add(int(text, 16))
            else:
                raise UsageError(
                    f"--only {text}: no joint, sensor, kind of frame or hexadecimal identifier; there are"
                    f" {', '.join(sorted(owners))} and {', '.join(sorted(kinds))}"
                )
        return cls(frozenset(words), frozenset(ids))

    def wants(self, can_id: int, decoded: Decoded) -> bool:
        """Tell whether a frame is wanted."""
        if not self.words and not self.ids:
            return True
        kind = decoded.what.lower()
        return can_id in self.ids or not self.words.isdisjoint((decoded.who.lower(), kind, kind.split()[0]))


@dataclass(slots=True)
class Monitor:
    """Makes a line of each frame that is wanted."""

    robot: RobotDescription
    buses: Sequence[str]
    only: Only = field(default_factory=Only)
    as_json: bool = False
    origin_ns: int | None = None
    """Time from which a text's times count; None: that of the first frame. JSON has them as they are."""
    _names: dict[str, FrameNames] = field(init=False)
    _width: int = field(init=False)
    _bus_width: int = field(init=False)

    def __post_init__(self) -> None:
        self._names = {bus: FrameNames(self.robot, bus) for bus in self.buses}
        owners = [layout.owner for bus in self.buses for layout in bus_layouts(self.robot, bus)]
        self._width = max(map(len, owners))
        self._bus_width = max(map(len, self.buses)) if len(self.buses) > 1 else 0

    def lines(self, frames: Iterable[BusFrame], count: int | None = None) -> Iterator[str]:
        """Yield a line a frame, up to `count`."""
        shown = 0
        for frame in frames:
            if self.origin_ns is None:
                self.origin_ns = frame.time_ns
            decoded = self._names[frame.bus].decode(frame.can_id, frame.data)
            if not self.only.wants(frame.can_id, decoded):
                continue
            yield self._json(frame, decoded) if self.as_json else self._text(frame, decoded)
            shown += 1
            if shown == count:
                return

    def _text(self, frame: BusFrame, decoded: Decoded) -> str:
        bus = f"{frame.bus:<{self._bus_width}} " if self._bus_width else ""
        time_s = (frame.time_ns - (self.origin_ns or 0)) * 1e-9
        head = f"{time_s:10.6f} {bus}{frame.can_id:03X} {decoded.who:<{self._width}} {decoded.what:<12}"
        return f"{head} {decoded.content}".rstrip()

    def _json(self, frame: BusFrame, decoded: Decoded) -> str:
        line = {
            "time_s": frame.time_ns / 1e9,
            "bus": frame.bus,
            "id": frame.can_id,
            "data": frame.data.hex(),
            "who": decoded.who,
            "what": decoded.what,
            "content": decoded.content,
            "values": dict(decoded.values),
        }
        return json.dumps(line, ensure_ascii=False, allow_nan=False)


def live_frames(
    robot: RobotDescription, channels: Mapping[str, tuple[str, str]], tell: Callable[[str], None]
) -> Iterator[BusFrame]:
    """Yield the frames that pass on buses, until all are gone or Ctrl-C is pressed.

    Args:
        robot: the description.
        channels: interface and channel of each bus, by name.
        tell: takes a line when a bus goes.

    Raises:
        UsageError: a bus cannot be opened.

    """
    waiting: Waiting = queue.SimpleQueue()
    ours = {bus: hal_identifiers(robot, bus) for bus in channels}
    with ExitStack() as stack:
        for bus, (interface, channel) in channels.items():
            port = stack.enter_context(_open(robot, bus, interface, channel))
            stack.enter_context(_reading(bus, port, waiting))
        stack.enter_context(_interrupt_ends(waiting))
        open_buses = set(channels)
        while open_buses:
            bus, item = waiting.get()
            if item is None:
                return
            if isinstance(item, Exception):
                open_buses.discard(bus)
                tell(f"bus {bus}: {item}")
                continue
            try:
                frame = encode(item)
            except ValueError as error:
                tell(f"bus {bus}: {error}; it is left out")
                continue
            number = int.from_bytes(frame[:4], "little")
            yield BusFrame(round(item.timestamp * 1e9), bus, frame, sent=number in ours[bus])


@contextmanager
def _interrupt_ends(waiting: Waiting) -> Iterator[None]:
    """Take the first Ctrl-C for the end of the frames, so that what was made of them is still shown."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def end(*_: object) -> None:
        waiting.put(("", None))
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _reading(bus: str, port: can.BusABC, waiting: Waiting) -> Iterator[None]:
    """Read a bus in a thread of its own, up to its first error: python-can's `Notifier` would try for ever."""
    leave = threading.Event()

    def read() -> None:
        while not leave.is_set():
            try:
                message = port.recv(POLL_S)
            except (can.CanError, OSError) as error:
                waiting.put((bus, error))
                return
            if message is not None:
                waiting.put((bus, message))

    thread = threading.Thread(target=read, name=f"bus {bus}")
    thread.start()
    try:
        yield
    finally:
        leave.set()
        thread.join()


def _open(robot: RobotDescription, bus: str, interface: str, channel: str) -> can.BusABC:
    bitrate = robot.buses[robot.bus_index(bus)].bitrate
    try:
        return can.Bus(interface=interface, channel=channel, bitrate=bitrate)
    except (can.CanError, OSError) as error:
        raise UsageError(f"bus {bus}, {interface}:{channel}: {error}") from error


def live_channels(
    robot: RobotDescription, buses: Sequence[str], given: Mapping[str, tuple[str, str]], directory: Callable[[], str]
) -> dict[str, tuple[str, str]]:
    """Interface and channel of each bus: as given, else as described; bare names lie in the run's directory."""
    chosen = {}
    for name in buses:
        bus = robot.buses[robot.bus_index(name)]
        interface, channel = given.get(name, (bus.interface, bus.channel))
        if interface == "cosim" and os.sep not in channel:
            channel = str(os.path.join(directory(), channel))
        chosen[name] = (interface, channel)
    return chosen
