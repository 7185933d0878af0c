"""A log holds what was written, opens in the public reader, and stays readable wherever it is cut."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from schemas.fingerprint import ARITHMETIC, differences, fingerprint
from schemas.log import FLUSH_INTERVAL_S, LogError, LogReader, LogWriter, UnknownTopicError
from schemas.messages import BusFrames, Event, OperatorRequest


def _event(sequence: int) -> Event:
    return Event(
        sequence=sequence, time_ns=sequence * 2_000_000, service="hal", kind="note", severity="info", text="é" * 40
    )


def _frames(sequence: int, bus: str) -> BusFrames:
    return BusFrames(sequence=sequence, time_ns=0, bus=bus, sent=bytes(range(16)), received=b"")


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def _write(path: Path, run: Any, count: int) -> None:
    with LogWriter(path, run, fingerprint(run)) as log:
        for k in range(count):
            log.write("event", _event(k))


def test_what_was_written_is_read(tmp_path: Path, run: Any) -> None:
    path = tmp_path / "deep" / "run.mcap"
    with LogWriter(path, run, {"seed": "7"}) as log:
        log.write("bus/can1", _frames(-1, "can1"))
        log.write("bus/can0", _frames(-1, "can0"))
        for k in range(5):
            log.write("event", _event(k))
        log.write("operator", OperatorRequest(action="stop"))
    reader = LogReader(path)
    assert reader.complete
    assert reader.run == run
    assert reader.fingerprint == {"seed": "7"}
    assert list(reader.messages(Event)) == [_event(k) for k in range(5)]
    assert [frames.bus for frames in reader.messages(BusFrames)] == ["can1", "can0"]
    assert [frames.sequence for frames in reader.messages(BusFrames, bus="can0")] == [-1]
    assert reader.counts() == {"event": 5, "operator": 1, "bus/can0": 1, "bus/can1": 1}
    assert [(record.topic, record.sequence, record.time_ns) for record in reader.records({"event"})][4] == (
        "event",
        4,
        8_000_000,
    )


def test_public_reader_finds_schemas_configuration_and_simulated_times(tmp_path: Path, run: Any) -> None:
    _write(tmp_path / "run.mcap", run, 5)
    with (tmp_path / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "hrp-cosim"
        summary = reader.get_summary()
        assert summary is not None
        assert [channel.topic for channel in summary.channels.values()] == [
            "/state", "/command", "/trace", "/truth", "/event", "/health", "/operator", "/bus/can0", "/bus/can1",
            "/load/can0", "/load/can1",
        ]  # fmt: skip
        assert all(channel.message_encoding == "json" for channel in summary.channels.values())
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        rows = list(reader.iter_messages(topics="/event"))
        assert [message.log_time for _, _, message in rows] == [k * 2_000_000 for k in range(5)]
        schema = rows[0][0]
        assert schema is not None
        assert (schema.name, schema.encoding) == ("Event", "jsonschema")
        properties = json.loads(schema.data)["properties"]
        assert set(json.loads(rows[0][2].data)) == set(properties)
        (attachment,) = reader.iter_attachments()
        assert json.loads(attachment.data)["scenario"]["controller"]["lambda"] == 2.0
        (metadata,) = reader.iter_metadata()
        assert metadata.name == "fingerprint"
        assert metadata.metadata["seed"] == "7"


def test_equal_messages_make_equal_files(tmp_path: Path, run: Any) -> None:
    for name in ("a", "b"):
        _write(tmp_path / name, run, 300)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_log_cut_anywhere_is_readable_up_to_its_last_chunk(tmp_path: Path, run: Any) -> None:
    clock = Clock()
    path = tmp_path / "run.mcap"
    sizes = [0]
    with LogWriter(path, run, {}, clock_s=clock) as log:
        start = path.stat().st_size
        for k in range(160):
            clock.now += FLUSH_INTERVAL_S / 16
            log.write("event", _event(k))
            if path.stat().st_size != (sizes[-1] or start):
                sizes.append(path.stat().st_size)
    whole = path.read_bytes()
    assert len(sizes) == 11
    cut = tmp_path / "cut.mcap"
    chooser = random.Random(1)
    for length in [*sizes[1:], *(chooser.randrange(start, len(whole) - 1) for _ in range(60)), len(whole) - 1]:
        cut.write_bytes(whole[:length])
        reader = LogReader(cut)
        got = [event.sequence for event in reader.messages(Event)]
        flushed = sum(size <= length for size in sizes[1:])
        assert not reader.complete
        assert got == list(range(len(got)))
        assert len(got) >= 16 * flushed
        assert len(got) <= 16 * (flushed + 1)


def test_flush_every_second_even_without_messages(tmp_path: Path, run: Any) -> None:
    clock = Clock()
    path = tmp_path / "run.mcap"
    with LogWriter(path, run, {}, clock_s=clock) as log:
        log.write("event", _event(0))
        clock.now = 0.99
        log.flush_if_due()
        assert list(LogReader(path).messages(Event)) == []
        clock.now = 1.0
        log.flush_if_due()
        assert list(LogReader(path).messages(Event)) == [_event(0)]


def test_damage_in_a_whole_log_is_an_error(tmp_path: Path, run: Any) -> None:
    path = tmp_path / "run.mcap"
    _write(path, run, 2000)
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[0]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"run.mcap: the log is damaged"):
        list(LogReader(path).messages(Event))


def test_what_is_no_log_is_refused(tmp_path: Path, run: Any) -> None:
    with pytest.raises(LogError, match="No such file"):
        LogReader(tmp_path / "none.mcap")
    for content in (b"", b"abc", b"x" * 100):
        (tmp_path / "text").write_bytes(content)
        with pytest.raises(LogError, match=r"text: (not an MCAP file|cannot read)"):
            LogReader(tmp_path / "text")
    _write(tmp_path / "run.mcap", run, 1)
    (tmp_path / "head").write_bytes((tmp_path / "run.mcap").read_bytes()[:60])
    with pytest.raises(LogError, match=r"run.json"):
        LogReader(tmp_path / "head")


def test_a_message_that_is_not_one_names_topic_and_time(tmp_path: Path, run: Any) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, run, {}) as log:
        log.write_bytes("event", b'{"sequence": NaN}', 3, 2_000_000)
    with pytest.raises(LogError, match=r"/event at 0.002 s: Event: "):
        list(LogReader(path).messages(Event))


def test_unknown_topic_and_full_disk_are_typed_errors(tmp_path: Path, run: Any) -> None:
    with LogWriter(tmp_path / "run.mcap", run, {}) as log, pytest.raises(UnknownTopicError, match="'bus/can9'"):
        log.write("bus/can9", _frames(0, "can9"))
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot write the log"):
        LogWriter(tmp_path / "file" / "run.mcap", run, {})
    full = Path("/dev/full")
    if full.exists():
        with pytest.raises(LogError, match="No space left on device"):
            LogWriter(full, run, {})


def test_fingerprint_names_what_differs(run: Any) -> None:
    here = fingerprint(run)
    assert set(ARITHMETIC) <= set(here)
    assert (here["clock"], here["seed"]) == ("lockstep", "7")
    assert all(isinstance(value, str) and value for value in here.values())
    assert differences(here, here) == ()
    assert differences(here | {"numpy": "1.0", "git_commit": "other"}, here) == (f"numpy: 1.0 → {here['numpy']}",)
