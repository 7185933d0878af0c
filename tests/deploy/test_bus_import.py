"""Captures of buses become logs: the frames of a run, taken out and put in again, are the same log."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.bus_files import ChannelMap, read_frames, write_frames
from deploy.bus_frames import BusFrame, from_zero, in_time
from deploy.bus_import import CaptureError, messages_of
from hal.profile.frames import pack
from hal.profile.objects import EMCY_STRUCT
from hal.profile.units import DriveUnits
from schemas.base import ControlMode, Model
from schemas.load import Run
from schemas.messages import BusFrames, Event, HalStatus, RobotState
from tests.deploy.bus_logs import SCENARIOS, recorded


def capture(robot: str) -> list[BusFrame]:
    description = recorded(robot).run.robot.description
    return list(from_zero(in_time(description, recorded(robot).frames), description.period_ns))


def imported(frames: Iterable[BusFrame], run: Run) -> tuple[list[BusFrames], dict[int, RobotState], list[Event]]:
    messages: list[Model] = [message for _, message in messages_of(frames, run)]
    return (
        [each for each in messages if isinstance(each, BusFrames)],
        {each.sequence: each for each in messages if isinstance(each, RobotState)},
        [each for each in messages if isinstance(each, Event)],
    )


@pytest.mark.parametrize("suffix", [".log", ".blf"])
@pytest.mark.parametrize("robot", SCENARIOS)
def test_a_log_through_another_tools_file_is_the_same_log(robot: str, suffix: str, tmp_path: Path) -> None:
    log = recorded(robot)
    description = log.run.robot.description
    channels, path = ChannelMap(description, {}), tmp_path / f"run{suffix}"
    write_frames(path, capture(robot), channels, [bus.name for bus in description.buses])
    frames, states, _ = imported(read_frames(path, channels), log.run)
    assert frames == list(log.frames)
    assert set(log.states) <= set(states)
    for sequence, original in log.states.items():
        state = states[sequence]
        for name in (
            "time_ns", "position_measured", "motor_torque_measured", "drive_state", "error_code", "wrenches", "imus",
        ):  # fmt: skip
            assert getattr(state, name) == getattr(original, name), (sequence, name)
        # A servo whose limit is the joint's own is in position mode, as far as frames tell.
        modes = {ControlMode.SERVO: ControlMode.POSITION}
        assert [modes.get(m, m) for m in state.mode] == [modes.get(m, m) for m in original.mode], sequence


@pytest.mark.parametrize("robot", SCENARIOS)
def test_what_was_applied_follows_from_the_commands(robot: str) -> None:
    log = recorded(robot)
    description = log.run.robot.description
    units = DriveUnits.of(description)
    _, states, _ = imported(capture(robot), log.run)
    torque_cycles = 0
    for sequence, original in log.states.items():
        applied, wanted = states[sequence].applied, original.applied
        assert applied.sequence == -1
        for index, joint in enumerate(description.joints):
            if wanted.position is not None:
                assert applied.position is not None
                half = 0.5 * abs(units.radian_per_count[index]) * (1.0 + 1e-6)
                assert applied.position[index] == pytest.approx(wanted.position[index], abs=half)
            if wanted.torque is not None:
                assert applied.torque is not None
                error = abs(applied.torque[index] - wanted.torque[index])
                band = 0.05 * joint.drive.dead_zone  # of the inverse's smoothing
                assert error <= band + abs(units.newton_metre_per_mille[index])
                torque_cycles += 1
    assert bool(torque_cycles) == (robot == "crane")


def test_a_limit_below_the_joints_own_shows_servo_mode() -> None:
    log = recorded("feather")
    frames = [
        replace(each, frame=pack(each.can_id, each.data[:6] + b"\x64\x00")) if each.can_id & ~0x7F == 0x200 else each
        for each in capture("feather")
    ]
    _, states, _ = imported(frames, log.run)
    assert states[1].applied.mode is ControlMode.SERVO
    assert set(states[1].mode) == {ControlMode.SERVO}
    assert states[1].applied.torque_limit is not None
    assert states[1].applied.torque_limit[0] == pytest.approx(0.6)  # 100 ‰ of 0.06 N·m by 100


def test_a_capture_that_begins_in_torque_mode_is_in_torque_mode() -> None:
    log = recorded("crane")
    whole = capture("crane")
    syncs = [index for index, each in enumerate(whole) if each.can_id == 0x080 and each.bus == "hi"]
    cut = syncs[300]
    assert log.states[300].mode[0] is ControlMode.TORQUE
    _, states, _ = imported(whole[cut:], log.run)
    assert states[0].position_measured == log.states[300].position_measured
    assert states[0].mode == log.states[300].mode
    assert states[5].motor_torque_measured == log.states[305].motor_torque_measured


def test_a_capture_may_begin_between_the_syncs_of_two_buses() -> None:
    log = recorded("arm9")
    whole = capture("arm9")
    syncs = [index for index, each in enumerate(whole) if each.can_id == 0x080]
    frames, states, _ = imported(whole[syncs[3] + 1 :], log.run)  # without the first bus's SYNC 1
    assert states[1].position_measured == log.states[2].position_measured
    later = {(each.sequence, each.bus): each.received for each in frames}
    original = {(each.sequence, each.bus): each.received for each in log.frames}
    for bus in ("arm9-0", "arm9-1", "arm9-2"):
        assert later[4, bus] == original[5, bus]


def test_the_decoders_findings_become_events() -> None:
    log = recorded("arm9")
    frames = capture("arm9")
    at = next(i for i, each in enumerate(frames) if each.can_id == 0x182 and i > len(frames) // 2)
    emergency = pack(0x082, EMCY_STRUCT.pack(0x8130, 0x11, bytes(5)))
    frames.insert(at + 1, replace(frames[at], frame=emergency))
    _, states, events = imported(frames, log.run)
    assert [(event.service, event.kind, event.joint) for event in events] == [
        ("capture", "drive_emergency", "scapula_roll")
    ]
    assert {state.status for state in states.values()} == {HalStatus.ACTIVE}


class TestRefused:
    def test_a_bus_without_frames(self) -> None:
        frames = [each for each in capture("arm9") if each.bus != "arm9-1"]
        with pytest.raises(CaptureError, match="no frames of bus arm9-1; a log needs all buses of robot arm9"):
            imported(frames, recorded("arm9").run)

    def test_no_sync(self) -> None:
        frames = [each for each in capture("arm9") if each.can_id != 0x080]
        with pytest.raises(CaptureError, match="no SYNC on any bus"):
            imported(frames, recorded("arm9").run)

    def test_a_joint_that_never_tells_its_position(self) -> None:
        silent = (0x184, 0x584)
        frames = [each for each in capture("arm9") if each.can_id not in silent]
        with pytest.raises(CaptureError, match="tells the position of joint shoulder_roll"):
            imported(frames, recorded("arm9").run)


def test_a_file_that_is_ahead_on_one_bus_gives_the_same_log() -> None:
    log = recorded("arm9")
    ordered = capture("arm9")
    queues = {bus: [each for each in ordered if each.bus == bus] for bus in ("arm9-0", "arm9-1", "arm9-2")}
    in_turn = [queue[i] for i in range(max(map(len, queues.values()))) for queue in queues.values() if i < len(queue)]
    assert in_turn != ordered
    frames, _, _ = imported(in_turn, log.run)
    assert frames == list(log.frames)
