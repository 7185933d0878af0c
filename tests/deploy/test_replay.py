"""A fresh log comes out the same in all parts; with one value edited, the replay names tick and field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deploy.cli import main
from deploy.errors import UsageError
from deploy.replay import PARTS, ReplayError, replay_log
from schemas.base import Model
from schemas.log import LogReader, LogWriter
from schemas.messages import BusFrames, JointCommand, RobotState
from schemas.topics import decode, topics_of

CYCLES = 150
HELD = 150
"""Cycles of the HAL's own at the end, as the run ends in torque mode."""


@pytest.fixture(scope="module")
def log(fresh_log: Path) -> Path:
    """A run with both changes of mode in it."""
    return fresh_log


Edit = Callable[[str, Model], Model | None]


def rewritten(log: Path, out: Path, edit: Edit, fingerprint: dict[str, str] | None = None) -> Path:
    """A copy whose messages have gone through `edit`; None leaves one out."""
    reader = LogReader(log)
    models = topics_of(reader.run.robot.description)
    with LogWriter(out, reader.run, reader.fingerprint if fingerprint is None else fingerprint) as writer:
        for record in reader.records():
            message = edit(record.topic, decode(models[record.topic], record.data))
            if message is not None:
                writer.write(record.topic, message)
    return out


def changed(message: Model, **fields: Any) -> Model:
    return type(message).model_validate(message.model_dump() | fields)


def bumped(vector: tuple[float, ...], index: int, by: float) -> tuple[float, ...]:
    return (*vector[:index], vector[index] + by, *vector[index + 1 :])


def at(sequence: int, model: type[Model], change: Callable[[Any], Model | None]) -> Edit:
    def edit(_topic: str, message: Model) -> Model | None:
        wanted = isinstance(message, model) and getattr(message, "sequence", None) == sequence
        return change(message) if wanted else message

    return edit


def keep(_topic: str, message: Model) -> Model:
    return message


@pytest.mark.parametrize("part", PARTS)
def test_a_fresh_log_comes_out_the_same(log: Path, part: str) -> None:
    result = replay_log(log, part)
    assert result.exact
    assert result.reasons == ()
    assert result.difference is None
    assert result.compared >= CYCLES
    assert "come out the same" in result.describe()
    assert result.as_json()["passed"] is True


def test_log_covers_both_modes(log: Path) -> None:
    modes = {command.mode for command in LogReader(log).messages(JointCommand)}
    assert {mode.value for mode in modes} == {"position", "torque"}


def test_edited_command_is_named(log: Path, tmp_path: Path) -> None:
    def change(command: JointCommand) -> Model:
        assert command.torque is not None
        return changed(command, torque=bumped(command.torque, 3, 1e-9))

    result = replay_log(rewritten(log, tmp_path / "run.mcap", at(100, JointCommand, change)), "controller")
    assert result.difference is not None
    assert (result.difference.tick, result.difference.field) == (100, "command.torque[3]")
    assert result.difference.logged - result.difference.replayed == pytest.approx(1e-9)
    assert result.compared == 100
    assert "controller: tick 100, command.torque[3]: logged" in result.describe()


def test_edited_state_is_named(log: Path, tmp_path: Path) -> None:
    def change(state: RobotState) -> Model:
        return changed(state, position_measured=bumped(state.position_measured, 2, 1e-9))

    result = replay_log(rewritten(log, tmp_path / "run.mcap", at(50, RobotState, change)), "hal")
    assert result.difference is not None
    assert (result.difference.tick, result.difference.field) == (50, "state.position_measured[2]")


@pytest.mark.parametrize("part", ["hal", "plant"])
def test_edited_frame_is_named(log: Path, tmp_path: Path, part: str) -> None:
    def change(frames: BusFrames) -> Model:
        if frames.bus != "arm9-1":
            return frames
        received = bytearray(frames.received)
        received[10] ^= 1  # lowest byte of TPDO1's position
        return changed(frames, received=bytes(received))

    result = replay_log(rewritten(log, tmp_path / "run.mcap", at(30, BusFrames, change)), part)
    assert result.difference is not None
    assert result.difference.tick == 30
    expected = "bus/arm9-1.received[0]" if part == "plant" else "state.position_measured"
    assert result.difference.field.startswith(expected)


def test_edited_boot_is_found_by_the_plant(log: Path, tmp_path: Path) -> None:
    def change(frames: BusFrames) -> Model:
        received = bytearray(frames.received)
        received[-1] ^= 1
        return changed(frames, received=bytes(received))

    result = replay_log(rewritten(log, tmp_path / "run.mcap", at(-1, BusFrames, change)), "plant")
    assert result.difference is not None
    assert result.difference.tick == -1


def test_lost_command_is_a_difference_but_a_lost_tail_is_not(log: Path, tmp_path: Path) -> None:
    gap = rewritten(log, tmp_path / "gap.mcap", at(40, JointCommand, lambda _: None))
    result = replay_log(gap, "controller")
    assert result.difference is not None
    assert (result.difference.tick, result.difference.field) == (40, "command")

    def shorten(topic: str, message: Model) -> Model | None:
        late = getattr(message, "sequence", 0) > (60 if topic in {"state", "bus/arm9-0"} else 50)
        return None if late else message

    tail = rewritten(log, tmp_path / "tail.mcap", shorten)
    for part in PARTS:
        assert replay_log(tail, part).passed


@pytest.mark.parametrize("part", PARTS)
def test_other_arithmetic_means_tolerances(log: Path, tmp_path: Path, part: str) -> None:
    here = LogReader(log).fingerprint
    nudged: dict[type[Model], Callable[[Any], Model]] = {
        JointCommand: lambda m: changed(m, position=bumped(m.position, 0, 1e-7)) if m.position else m,
        RobotState: lambda m: changed(m, position_measured=bumped(m.position_measured, 0, 1e-10)),
    }

    def edit(_topic: str, message: Model) -> Model:
        return nudged.get(type(message), lambda m: m)(message)

    path = rewritten(log, tmp_path / "run.mcap", edit, here | {"numpy": "0.1"})
    result = replay_log(path, part)
    assert result.passed, result.describe()
    assert not result.exact
    assert result.reasons == (f"numpy: 0.1 → {here['numpy']}",)


def test_tolerances_still_find_what_is_wrong(log: Path, tmp_path: Path) -> None:
    def change(state: RobotState) -> Model:
        return changed(state, position_measured=bumped(state.position_measured, 1, 0.01))

    path = rewritten(log, tmp_path / "run.mcap", at(70, RobotState, change), {"numpy": "0.1"})
    for part in ("hal", "plant"):
        result = replay_log(path, part)
        assert result.difference is not None
        assert (result.difference.tick, result.difference.field) == (70, "state.position_measured[1]")


@pytest.mark.parametrize("part", PARTS)
def test_a_cut_log_is_replayed_up_to_where_it_ends(log: Path, tmp_path: Path, part: str) -> None:
    cut = tmp_path / "cut.mcap"
    with LogWriter(cut, LogReader(log).run, LogReader(log).fingerprint) as writer:
        for record in LogReader(log).records():
            writer.write_bytes(record.topic, record.data, record.sequence, record.time_ns)
            if record.topic == "state" and record.sequence in (40, 80):
                writer.flush()
                flushed = cut.stat().st_size
    data = cut.read_bytes()
    for end, least, most in ((len(data) - 40, CYCLES, CYCLES + HELD), (flushed + 20, 39, CYCLES - 1)):
        cut.write_bytes(data[:end])
        assert not LogReader(cut).complete
        result = replay_log(cut, part)
        assert result.exact
        assert result.passed, result.describe()
        assert least <= result.compared <= most


def test_nothing_to_replay_is_an_error(log: Path, tmp_path: Path) -> None:
    empty = rewritten(log, tmp_path / "run.mcap", lambda _topic, _message: None)
    for part in PARTS:
        with pytest.raises(ReplayError, match=f"nothing to replay for the {part}"):
            replay_log(empty, part)
    with pytest.raises(UsageError, match="no part 'brain'"):
        replay_log(log, "brain")


def test_command_line_exits_0_and_1(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(log), "--all"]) == 0
    assert capsys.readouterr().out.count("come out the same") == len(PARTS)
    commands = {command.sequence: command for command in LogReader(log).messages(JointCommand)}
    before = commands[90].torque
    assert before is not None
    edited = rewritten(
        log, tmp_path / "run.mcap", at(90, JointCommand, lambda m: changed(m, torque=bumped(before, 0, 1.0)))
    )
    assert main(["replay", str(edited)]) == 1
    assert f"tick 90, command.torque[0]: logged {before[0] + 1.0}, replayed {before[0]}" in capsys.readouterr().out
