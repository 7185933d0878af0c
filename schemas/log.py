"""The log of a run: one MCAP file with every message as JSON, its schema, the configuration and the fingerprint.

Chunks are compressed with zstd and closed at least once a second of wall-clock time, so what was written more than a
second before a `kill -9` can be read: a cut file is read as a stream up to its last whole chunk, here and by any MCAP
reader that streams (`mcap recover` writes an indexed copy).
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self, TypeVar

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, DataEnd, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from schemas.base import Model
from schemas.errors import CosimError
from schemas.load import Robot, Run
from schemas.robot import RobotDescription
from schemas.scenario import Scenario
from schemas.topics import MalformedMessageError, decode, encode, stamp, topics_of

M = TypeVar("M", bound=Model)

PROFILE: Final = "hrp-cosim"
RUN_ATTACHMENT: Final = "run.json"
FINGERPRINT: Final = "fingerprint"
FLUSH_INTERVAL_S: Final = 1.0
CHUNK_BYTES: Final = 512 * 1024


class LogError(CosimError):
    """A log cannot be written or read."""


class UnknownTopicError(LogError):
    """A message on a topic that the robot does not have."""


class RunRecord(Model):
    """The resolved configuration of a run, whole: replay needs no other file."""

    robot: RobotDescription
    urdf: str
    scenario: Scenario

    @classmethod
    def of(cls, run: Run) -> Self:
        """Take down a run."""
        return cls(robot=run.robot.description, urdf=run.robot.urdf, scenario=run.scenario)

    def run(self) -> Run:
        """Make the run again."""
        return Run(Robot(self.robot, self.urdf), self.scenario)


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One message of a log, not parsed."""

    topic: str
    """As in `schemas.topics`: `state`, `bus/can0`, …; the channel's topic is `/` and this."""
    sequence: int
    """Of the MCAP message: frames of the boot (−1) have 0 here and −1 in their JSON."""
    time_ns: int
    data: bytes


class LogWriter:
    """Writes a run's messages; channels and their numbers depend on the robot alone.

    Raises:
        LogError: the file cannot be written (from every method).

    """

    def __init__(
        self, path: Path, run: Run, fingerprint: dict[str, str], *, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.path = path
        self._clock_s = clock_s
        self._closed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = path.open("wb")
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=PROFILE)
            record = RunRecord.of(run).model_dump_json(by_alias=True).encode()
            self._writer.add_attachment(0, 0, RUN_ATTACHMENT, "application/json", record)
            self._writer.add_metadata(FINGERPRINT, fingerprint)
            self._channels = self._register(run)
            self._stream.flush()
        except OSError as error:
            raise self._failure(error) from error
        self._flush_due_s = clock_s() + FLUSH_INTERVAL_S

    def write(self, topic: str, message: Model) -> None:
        """Write a message on a topic of `schemas.topics.topics_of`."""
        self.write_bytes(topic, encode(message), *stamp(message))

    def write_bytes(self, topic: str, data: bytes, sequence: int, time_ns: int) -> None:
        """As `write`, for a message that is already encoded. Time is the message's own: simulated in lockstep."""
        channel = self._channels.get(topic)
        if channel is None:
            raise UnknownTopicError(
                f"{self.path}: the robot has no topic {topic!r}; it has {', '.join(self._channels)}"
            )
        try:
            self._writer.add_message(
                channel, log_time=time_ns, data=data, publish_time=time_ns, sequence=max(sequence, 0)
            )
        except OSError as error:
            raise self._failure(error) from error
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Close the chunk and hand it to the system once a second; call it when no messages come, too."""
        now = self._clock_s()
        if now >= self._flush_due_s:
            self._flush_due_s = now + FLUSH_INTERVAL_S
            self.flush()

    def flush(self) -> None:
        """Close the chunk and hand everything to the operating system."""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]  # mcap has no annotation there
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Write the index and close the file; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap has no annotation there
            self._stream.close()
        except OSError as error:
            raise self._failure(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, run: Run) -> dict[str, int]:
        schemas: dict[type[Model], int] = {}
        channels = {}
        for topic, model in topics_of(run.robot.description).items():
            if model not in schemas:
                text = json.dumps(model.model_json_schema(), sort_keys=True).encode()
                schemas[model] = self._writer.register_schema(model.__name__, "jsonschema", text)
            channels[topic] = self._writer.register_channel(f"/{topic}", "json", schemas[model])
        return channels

    def _failure(self, error: OSError) -> LogError:
        return LogError(f"{self.path}: cannot write the log: {error.strerror or error}")


class LogReader:
    """Reads a log, whole or cut short.

    Raises:
        LogError: no such file, not a log of this project, or damaged.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.complete = _ends_with_magic(path)
        """False when the writer was killed: the messages end with the last flushed chunk."""
        record: RunRecord | None = None
        self.fingerprint: dict[str, str] = {}
        for item in self._records(chunks=False):
            if isinstance(item, Attachment) and item.name == RUN_ATTACHMENT:
                try:
                    record = decode(RunRecord, item.data)
                except MalformedMessageError as error:
                    raise LogError(f"{path}: {RUN_ATTACHMENT}: {error}") from error
            elif isinstance(item, Metadata) and item.name == FINGERPRINT:
                self.fingerprint = dict(item.metadata)
                break
        if record is None:
            raise LogError(f"{path}: holds no {RUN_ATTACHMENT}: not a log of hrp-cosim")
        self.run = record.run()

    def records(self, topics: Collection[str] | None = None) -> Iterator[LogRecord]:
        """Messages of some topics, or of all, in the order of writing."""
        names: dict[int, str] = {}
        for item in self._records():
            if isinstance(item, Channel):
                names[item.id] = item.topic.removeprefix("/")
            elif isinstance(item, Message):
                topic = names[item.channel_id]
                if topics is None or topic in topics:
                    yield LogRecord(topic, item.sequence, item.log_time, item.data)

    def messages(self, model: type[M], *, bus: str | None = None) -> Iterator[M]:
        """All messages of one kind in the order of writing; `bus` picks one of what has a topic a bus."""
        topics = topics_of(self.run.robot.description)
        wanted = tuple(
            topic for topic, each in topics.items() if each is model and (bus is None or topic.endswith(f"/{bus}"))
        )
        for record in self.records(wanted):
            try:
                yield decode(model, record.data)
            except MalformedMessageError as error:
                raise LogError(f"{self.path}: /{record.topic} at {record.time_ns * 1e-9:g} s: {error}") from error

    def counts(self) -> dict[str, int]:
        """Count the messages of each topic that has any, in the order of the channels."""
        found = Counter(record.topic for record in self.records())
        return {topic: found[topic] for topic in topics_of(self.run.robot.description) if found[topic]}

    def _records(self, *, chunks: bool = True) -> Iterator[object]:
        try:
            with self.path.open("rb") as stream:
                for record in StreamReader(stream, validate_crcs=chunks, emit_chunks=not chunks).records:
                    if isinstance(record, DataEnd):
                        return
                    yield record
        except OSError as error:
            raise LogError(f"{self.path}: cannot read the log: {error.strerror or error}") from error
        except (McapError, CRCValidationError, zstandard.ZstdError, struct.error, ValueError) as error:
            if self.complete:
                raise LogError(f"{self.path}: the log is damaged: {error or type(error).__name__}") from error


def _ends_with_magic(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            start = stream.read(len(MCAP0_MAGIC))
            stream.seek(-len(start), os.SEEK_END)
            end, length = stream.read(), stream.tell()
    except OSError as error:
        raise LogError(f"{path}: cannot read the log: {error.strerror or error}") from error
    if start != MCAP0_MAGIC:
        raise LogError(f"{path}: not an MCAP file")
    return end == MCAP0_MAGIC and length > 2 * len(MCAP0_MAGIC)
