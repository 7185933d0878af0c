"""Files of frames of other CAN tools, by python-can: candump's .log, Vector's .asc and .blf, PEAK's .trc, .csv.

`.log` is what `candump -l` writes and `canplayer` sends: `(seconds.microseconds) channel identifier#data`.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TextIO, cast

import can
from can.io.blf import BLFParseError
from can.io.canutils import CanutilsLogReader, CanutilsLogWriter
from can.io.generic import MessageReader, MessageWriter

from deploy.bus_frames import BusFrame, hal_identifiers
from deploy.errors import DeployError, UsageError
from hal.bus.can_frame import decode, encode
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG
from schemas.robot import RobotDescription

Channels = Literal["names", "numbers", "none"]
FORMATS: Final[Mapping[str, Channels]] = {
    ".log": "names", ".asc": "numbers", ".blf": "numbers", ".trc": "numbers", ".csv": "none",
}  # fmt: skip
"""Suffixes and how each format names a frame's channel."""
TEXT: Final = (".log", ".asc", ".csv")
"""Formats that may be compressed, with `.gz` after their suffix."""
LONGEST_CHANNEL: Final = 15
"""Of an interface's name in Linux (IFNAMSIZ); `canplayer` refuses longer ones."""
FIRST_NUMBER: Final = 1
"""Of the channels in a file with numbers; python-can counts from 0, but its TRC reader gives those of the file."""


class FrameFileError(DeployError):
    """A file of frames cannot be read or written."""


@dataclass(frozen=True, slots=True)
class ChannelMap:
    """Which channel of a file or interface is which bus; `given` ones alone when there are any."""

    robot: RobotDescription
    given: Mapping[str, str]
    """Channels by bus."""
    only: str | None = None
    """The one bus that everything is of, where a file does not say."""

    def bus(self, channel: str | int | None) -> str | None:
        """Bus of a channel, a name or the file's number, that counts from 1; None when it is not one of ours."""
        if channel is None:
            return self.only
        text = str(channel)
        if self.given:
            return next((name for name, chosen in self.given.items() if chosen == text), None)
        if isinstance(channel, int):
            index = channel - FIRST_NUMBER
            return self.robot.buses[index].name if 0 <= index < len(self.robot.buses) else None
        names = {each: bus.name for bus in self.robot.buses for each in (bus.channel, bus.name)}
        return names.get(text)

    def channel(self, bus: str) -> str:
        """Name under which a bus is written."""
        return self.given.get(bus, bus)


def suffix_of(path: Path) -> str:
    """Format of a file by its name, `.gz` left aside.

    Raises:
        UsageError: no format that this program reads and writes.

    """
    suffixes = [each.lower() for each in path.suffixes]
    compressed = suffixes[-1:] == [".gz"]
    suffix = (suffixes[-2:-1] if compressed else suffixes[-1:]) or [""]
    if suffix[0] not in FORMATS or (compressed and suffix[0] not in TEXT):
        raise UsageError(
            f"{path.name}: no format of CAN frames; known are {', '.join(FORMATS)}, and {', '.join(TEXT)} with .gz"
        )
    return suffix[0]


def write_frames(path: Path, frames: Iterable[BusFrame], channels: ChannelMap, buses: Iterable[str]) -> int:
    """Write frames; returns how many. What is there is replaced.

    Args:
        path: its suffix says the format.
        frames: in the order of their times.
        channels: names of the buses in the file; formats with numbers count the robot's buses.
        buses: of the frames.

    Raises:
        UsageError: an unknown format, one without channels for several buses, a channel's name that is too long.
        FrameFileError: the file cannot be written, or its format cannot hold a frame.

    """
    suffix, chosen = suffix_of(path), list(buses)
    if FORMATS[suffix] == "none" and len(chosen) > 1:
        raise UsageError(f"{path.name}: {suffix} holds no channels; choose one of {', '.join(chosen)} by --bus")
    names = {bus: _written_channel(suffix, bus, channels) for bus in chosen}
    count = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with _writer(path, suffix) as writer:
            for each in frames:
                message = decode(each.frame, each.time_ns * 1e-9)
                message.channel = names[each.bus]
                message.is_rx = not each.sent
                if suffix == ".trc" and (message.is_error_frame or message.is_remote_frame):
                    kind = "error" if message.is_error_frame else "remote"
                    raise FrameFileError(f"{path}: python-can writes no {kind} frames to .trc; use another format")
                writer.on_message_received(message)
                count += 1
    except OSError as error:
        raise FrameFileError(f"{path}: cannot be written: {error.strerror or error}") from error
    return count


def read_frames(path: Path, channels: ChannelMap) -> Iterator[BusFrame]:
    """Yield the frames of a file in its order, those of channels that `channels` leaves out excepted.

    A frame is the HAL's by its identifier: captures do not tell who sent it.

    Raises:
        UsageError: an unknown format, a channel that is no bus of the robot.
        FrameFileError: the file cannot be read.

    """
    suffix = suffix_of(path)
    robot = channels.robot
    ours = {bus.name: hal_identifiers(robot, bus.name) for bus in robot.buses}
    empty = True
    for message in _messages(path, suffix):
        empty, channel = False, message.channel
        if suffix != ".trc" and isinstance(channel, int):
            channel += FIRST_NUMBER
        bus = channels.bus(channel if channel is None or isinstance(channel, int) else str(channel))
        if bus is None:
            if channels.given and channel is not None:
                continue
            raise UsageError(_unknown_channel(path, channel, robot))
        try:
            frame = encode(message)
        except ValueError as error:
            raise FrameFileError(f"{path}: at {message.timestamp:.6f} s: {error}") from error
        number = int.from_bytes(frame[:4], "little")
        yield BusFrame(round(message.timestamp * 1e9), bus, frame, sent=number in ours[bus])
    if empty:
        raise FrameFileError(f"{path}: not a readable {suffix} file: it holds no frames")


def _unknown_channel(path: Path, channel: object, robot: RobotDescription) -> str:
    buses = ", ".join(bus.name for bus in robot.buses)
    if channel is None:
        return f"{path}: does not tell the frames' channel; say which bus of robot {robot.name} by --bus: {buses}"
    return (
        f"{path}: channel {channel} is no bus of robot {robot.name} ({buses});"
        f" say which it is, e.g. --channel {robot.buses[0].name}={channel}"
    )


def _written_channel(suffix: str, bus: str, channels: ChannelMap) -> str | int:
    name = channels.channel(bus)
    if FORMATS[suffix] != "names":
        return int(name) - FIRST_NUMBER if name.isdigit() else channels.robot.bus_index(bus)
    if len(name) > LONGEST_CHANNEL:
        raise UsageError(
            f"bus {name}: an interface's name has at most {LONGEST_CHANNEL} characters; give --channel {bus}=NAME"
        )
    return name


def _writer(path: Path, suffix: str) -> MessageWriter:
    if suffix != ".log":
        return can.Logger(path)
    if path.suffix == ".gz":
        return _CandumpWriter(cast(TextIO, gzip.open(path, "wt", encoding="ascii")))
    return _CandumpWriter(path)


_READ_ERRORS: Final = (
    ValueError, IndexError, struct.error, EOFError, can.CanError, BLFParseError, NotImplementedError,
)  # fmt: skip


def _messages(path: Path, suffix: str) -> Iterator[can.Message]:
    open_reader: Callable[[Path], MessageReader] = _CandumpReader if suffix == ".log" else can.LogReader
    if not path.is_file():
        raise FrameFileError(f"{path}: no such file")
    reader = None
    try:
        reader = open_reader(path)
        yield from reader
    except OSError as error:
        raise FrameFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _READ_ERRORS as error:
        raise FrameFileError(f"{path}: not a readable {suffix} file: {error}") from error
    finally:
        if reader is not None:
            with suppress(ValueError):  # closed at its end by the reader itself
                reader.stop()


class _CandumpWriter(CanutilsLogWriter):
    """The library's, which drops class and data of error frames and the length of remote ones: here as candump does."""

    def on_message_received(self, msg: can.Message) -> None:
        if not (msg.is_error_frame or msg.is_remote_frame):
            super().on_message_received(msg)
            return
        self.last_timestamp = max(msg.timestamp, self.last_timestamp or 0.0)
        if msg.is_error_frame:
            text = f"{CAN_ERR_FLAG | msg.arbitration_id:08X}#{bytes(msg.data).hex().upper()}"
        else:
            text = f"{msg.arbitration_id:0{8 if msg.is_extended_id else 3}X}#R{msg.dlc or ''}"
        self.file.write(f"({self.last_timestamp:f}) {msg.channel} {text}\n")


class _CandumpReader(CanutilsLogReader):
    """The library's, which takes most error frames for data frames with 29-bit identifiers and forgets channels."""

    _ERROR: Final = re.compile(r"\((?P<time>\d+\.\d+)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{8})#(?P<data>\w*)")

    def __init__(self, path: Path) -> None:
        is_plain = path.suffix != ".gz"
        text = path.open("r", encoding="ascii") if is_plain else gzip.open(path, "rt", encoding="ascii")  # noqa: SIM115 closed by `stop`
        super().__init__(cast(TextIO, text))

    def __iter__(self) -> Iterator[can.Message]:  # type: ignore[override]  # a generator there
        for line in self.file:
            found = self._ERROR.match(line)
            number = int(found["id"], 16) if found else 0
            if found and number & CAN_ERR_FLAG and not number & CAN_EFF_FLAG:
                data = bytes.fromhex(found["data"])
                yield can.Message(
                    timestamp=float(found["time"]), channel=found["channel"], is_error_frame=True,
                    is_extended_id=False, arbitration_id=number & ~CAN_ERR_FLAG, data=data, dlc=len(data),
                )  # fmt: skip
            else:
                with CanutilsLogReader(io.StringIO(line)) as reader:
                    yield from reader
