"""The controller in closed loop through position drives: when torque control begins, how it ends, and what it tells."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from controller_service.controller import Stage
from controller_service.errors import ControllerError
from controller_service.model import Array
from schemas.base import ControlMode
from schemas.messages import HalStatus
from schemas.robot import RobotDescription

T = 0.002
WINDOW = 20
VISCOUS = 0.0005
MASSES = 1.0 + 0.1 * np.resize([1, -1], 9)
ROUGH: dict[str, Any] = {"viscous": VISCOUS, "torque_scale": 0.95, "mass_scale": MASSES}
UP, DOWN = 100, 400
"""Sequences at which torque control begins and ends in `THERE_AND_BACK`."""


def position_torque(description: RobotDescription, **fields: Any) -> dict[str, Any]:
    """Models of drives that are as described, with the gears' viscous friction."""
    motors = {
        joint.name: {
            "torque_gain": 1.0 / joint.drive.position_gain,
            "velocity_gain": (joint.drive.velocity_gain + VISCOUS * joint.gear_ratio**2) / joint.drive.position_gain,
        }
        for joint in description.joints
    }
    return {"motors": motors, "savitzky_golay": {"window": WINDOW}} | fields


THERE_AND_BACK = [
    {"name": "settle", "mode": "position", "duration_s": 0.2},
    {"name": "torque", "mode": "position", "duration_s": 0.6, "torque_control": True},
    {"name": "back", "mode": "position", "duration_s": 0.6},
]
SWING = {"joint1": {"amplitude": 0.05, "frequency_hz": 1.0}, "joint5": {"amplitude": 0.1, "frequency_hz": 0.8}}
START, END = 300, 900
"""Sequences at which torque control begins and ends in `MOVING`."""
MOVING = [
    {
        "name": name,
        "mode": "position",
        "duration_s": duration,
        "joint_sines": {"joints": SWING, "fade_s": 0.3},
        "torque_control": torque,
    }
    for name, duration, torque in (("settle", 0.6, False), ("torque", 1.2, True), ("back", 0.8, False))
]


class Played:
    """A loop and what its controller did at every state."""

    def __init__(self, loop: Any) -> None:
        self.loop = loop
        self.stages: list[Stage] = []
        self.events: list[Any] = []

    def go(self, cycles: int) -> Played:
        for _ in range(cycles):
            self.loop.cycle()
            self.stages.append(self.loop.controller.stage)
            self.events += self.loop.controller.drain_events()
        return self

    def miss(self, cycles: int) -> Played:
        """Let states pass that the controller does not see: the drives go on with what they have."""
        loop = self.loop
        for _ in range(cycles):
            loop.plant.advance(T, np.array(loop.applied.position), None)
            loop.sequence += 1
        return self

    @property
    def commands(self) -> Array:
        """(K, 9) [rad]."""
        return np.array([command.position for command in self.loop.commands])

    @property
    def steps(self) -> Array:
        """Largest change of any joint's command from each state to the next [rad]; entry k from k to k + 1."""
        return np.abs(np.diff(self.commands, axis=0)).max(axis=1)


@pytest.fixture
def play(loop_of: Callable[..., Any], arm: Any) -> Callable[..., Played]:
    def build(phases: list[dict[str, Any]], rough: dict[str, Any] | None = None, **fields: Any) -> Played:
        config = {"position_torque": position_torque(arm.description, **fields), "phases": phases}
        return Played(loop_of(config, **(ROUGH if rough is None else rough)))

    return build


@pytest.mark.parametrize("desired", ["inverse_dynamics", "qp"])
def test_it_goes_into_torque_control_and_back_without_a_step(play: Callable[..., Played], desired: str) -> None:
    played = play(THERE_AND_BACK, desired=desired).go(700)
    assert played.stages == [Stage.POSITION] * UP + [Stage.INTERFACE] * (DOWN - UP) + [Stage.POSITION] * (700 - DOWN)
    assert all(command.mode is ControlMode.POSITION for command in played.loop.commands)
    steps, torque = played.steps, np.abs(np.diff(played.loop.torques, axis=0) / played.loop.plant.limit).max(axis=1)
    for change in (UP, DOWN):
        around = max(steps[change - 50 : change - 2].max(), steps[change + 3 : change + 150].max())
        assert steps[change - 2 : change + 3].max() <= around  # the change is not to be seen among the commands
        assert torque[change - 2 : change + 4].max() < 5e-3
    assert np.abs(np.array(played.loop.positions) - played.loop.positions[UP - 1])[UP:].max() < np.radians(0.5)
    assert played.events == []


def test_it_does_so_between_motions_too(play: Callable[..., Played]) -> None:
    """The robot still moves where its references rest: it was late."""
    played = play(MOVING).go(1200)
    steps, torque = played.steps, np.abs(np.diff(played.loop.torques, axis=0) / played.loop.plant.limit).max(axis=1)
    speed = np.abs(np.diff(played.loop.positions, axis=0) / T).max(axis=1)
    for change in (START, END):
        assert speed[change] > 1e-3
        assert steps[change - 2 : change + 3].max() <= 0.5 * steps[change - 200 : change + 200].max()
        assert torque[change - 2 : change + 4].max() <= torque[change - 200 : change + 200].max()
        assert torque[change - 2 : change + 4].max() < 0.01
    assert played.events == []


def test_every_term_of_the_command_is_in_the_trace(play: Callable[..., Played], arm: Any) -> None:
    played = play(MOVING, torque_integral=0.5, start_s=0.02).go(START + 250)
    trace, command = played.loop.traces[-1], played.loop.commands[-1]
    assert trace.offset is not None
    assert trace.estimated is not None
    assert trace.offset.limited == ()
    parts = ("torque", "friction", "position", "velocity", "acceleration", "force", "integral")
    offset = sum(np.array(getattr(trace.offset, part)) for part in parts)
    late = WINDOW // 2  # what was desired since, as the last state had it: the window's centre is between two states
    before, newer, older = (played.loop.traces[-k].offset for k in (2, 1 + late, 2 + late))
    since = np.array(before.velocity_desired) - 0.5 * np.add(newer.velocity_desired, older.velocity_desired)
    velocity = np.array(trace.estimated.velocity) + since
    lead_s = T * (arm.description.command_delay_cycles + 1)
    assert np.subtract(command.position, trace.position_estimated) == pytest.approx(
        offset + lead_s * velocity, abs=1e-9
    )
    gain = np.array([model["torque_gain"] for model in position_torque(arm.description)["motors"].values()])
    assert np.array(trace.torque_commanded) * gain == pytest.approx(offset - trace.offset.friction, abs=1e-12)
    assert trace.offset.position_desired == trace.position_reference
    assert trace.estimated.delay_s == pytest.approx(0.5 * (WINDOW - 1) * T)
    assert trace.qp_status == "inverse dynamics"


def test_without_torque_control_there_are_estimates_once_a_window_is_full(play: Callable[..., Played]) -> None:
    played = play(THERE_AND_BACK).go(UP)
    told = [trace.estimated is not None for trace in played.loop.traces]
    assert told == [False] * (WINDOW - 1) + [True] * (UP - WINDOW + 1)
    assert all(trace.offset is None for trace in played.loop.traces)


def test_torque_control_waits_for_a_whole_window(play: Callable[..., Played]) -> None:
    """It stays in position mode, at rest at its first target, and then begins without a step."""
    phases = [{"name": "torque", "mode": "position", "duration_s": 1.0, "torque_control": True}]
    played = play(phases).go(100)
    ((kind, severity, sequence, text),) = [(e.kind, e.severity, e.sequence, e.text) for e in played.events]
    assert (kind, severity, sequence) == ("torque_control_waits", "warning", 0)
    assert text.startswith("torque: not every sensor has been read for a whole window")
    assert played.stages == [Stage.POSITION] * (WINDOW - 1) + [Stage.INTERFACE] * (101 - WINDOW)
    assert played.steps[: WINDOW - 2].max() < 1e-9
    assert played.steps.max() < 2e-4


def held(sequence: int) -> HalStatus:
    return HalStatus.SAFE_STOP if 200 <= sequence < 230 else HalStatus.ACTIVE


def test_after_a_hold_it_starts_anew_from_the_firmware_s_target(play: Callable[..., Played]) -> None:
    played = play(THERE_AND_BACK, torque_integral=1.0)
    played.loop.status = held
    played.go(200)
    assert np.abs(played.loop.traces[-1].offset.integral).max() > 0.0
    played.go(200)
    assert played.stages[UP:DOWN] == [Stage.INTERFACE] * 100 + [Stage.HOLD] * 30 + [Stage.INTERFACE] * 170
    target = played.commands[229]
    assert played.commands[200:231] == pytest.approx(np.tile(played.commands[199], (31, 1)), abs=1e-12)
    assert played.commands[230] == pytest.approx(target, abs=1e-12)
    first = played.loop.traces[230].offset
    assert first.position_desired == pytest.approx(played.loop.traces[230].position_estimated)
    assert np.abs(first.integral).max() <= np.abs(played.loop.traces[199].offset.integral).max() / 5.0
    assert played.steps[229:233].max() <= played.steps[UP - 2 : 200].max()


@pytest.mark.parametrize("gap", [1, 3, 30])
def test_states_that_were_missed_cost_no_step(play: Callable[..., Played], gap: int) -> None:
    """Every now and then, and around both changes of law; the robot follows as before."""
    played, seen = play(MOVING), 0
    while played.loop.sequence < 1200:
        played.go(7 if gap < 10 else 49).miss(gap)
        seen = len(played.stages)
    assert set(played.stages) == {Stage.POSITION, Stage.INTERFACE}
    assert seen < 1200
    sequences = np.array([command.sequence for command in played.loop.commands])
    speed = played.steps / (np.diff(sequences) * T)
    assert speed.max() < 2.0  # joints move at up to 0.5 rad/s
    assert {event.kind for event in played.events} <= ({"path_dropped"} if gap == 30 else set())
    error = [np.subtract(trace.position_reference, trace.position_estimated) for trace in played.loop.traces]
    assert np.abs(error).max() < (0.02 if gap < 10 else 0.15)


def test_a_joint_that_runs_away_ends_it_with_an_error(play: Callable[..., Played]) -> None:
    """The model of one motor has the wrong size: the arm is thrown, and given up before it is fast."""
    played = play(THERE_AND_BACK).go(UP + 50)
    throw = np.zeros(9)
    throw[5] = -2000.0
    played.loop.plant.external = throw
    with pytest.raises(ControllerError, match=r"joint5 moves at -3\.\d+ rad/s under torque control, its limit is 3"):
        played.go(200)
    assert np.abs(played.loop.plant.velocity).max() < 8.0


def test_limits_that_act_are_told_once_a_second_by_name(play: Callable[..., Played]) -> None:
    """Held 0.5 rad away from its target by somebody, the joint asks for all that its drive has."""
    phases = [{"name": "torque", "mode": "position", "duration_s": 5.0, "torque_control": True}]
    played = play(phases, torque_gain=0.0).go(60)
    assert [event.kind for event in played.events] == ["torque_control_waits"]
    played.events.clear()
    there = played.loop.plant.position.copy()
    there[4] += 0.5
    for _ in range(1100):
        played.loop.plant.position += np.clip(there - played.loop.plant.position, -0.002, 0.002)
        played.loop.plant.velocity[:] = 0.0
        played.go(1)
    told = [(event.kind, event.severity, event.text, event.sequence) for event in played.events]
    offset = [each for each in told if "offset limit" in each[2]]
    assert offset[0][:3] == ("command_limited", "warning", "joint4: offset limit: torque control asks for more")
    assert [b[3] - a[3] for a, b in pairwise(offset)] == [500] * (len(offset) - 1)
    assert len(offset) == 3
    assert {name.split(":")[0] for _, _, name, _ in told} == {"joint4"}


MIXED = [
    {"name": "position", "mode": "position", "duration_s": 0.2},
    {"name": "true torque", "mode": "torque", "duration_s": 0.4, "posture": {"joint5": -0.7}},
    {"name": "offsets", "mode": "position", "duration_s": 0.4, "torque_control": True},
    {"name": "again", "mode": "torque", "duration_s": 0.2},
]


def test_between_torque_drives_own_mode_and_positions_it_goes_without_a_jump(play: Callable[..., Played]) -> None:
    """From torque mode the first target is the measured position, as always; to it, the command that was given."""
    played = play(MIXED).go(600)
    assert played.stages[299:301] == [Stage.TORQUE, Stage.INTERFACE]
    assert played.stages[499:502] == [Stage.INTERFACE, Stage.CAPTURE, Stage.TORQUE]
    first = played.loop.commands[300]
    assert first.position == pytest.approx(played.loop.traces[300].position_estimated, abs=1e-9)
    moved = np.abs(np.array(played.loop.positions[300:340]) - played.loop.positions[299]).max()
    assert np.degrees(moved) < 0.5
    torque = np.abs(np.diff(played.loop.torques, axis=0) / played.loop.plant.limit).max(axis=1)
    assert torque[498:506].max() < 0.01


def test_a_fade_that_has_not_ended_is_neither_dropped_nor_found_again(play: Callable[..., Played]) -> None:
    """From offsets to positions for less than `start_s`, to torque mode and back to positions."""
    phases = [
        MIXED[0],
        {"name": "offsets", "mode": "position", "duration_s": 0.4, "torque_control": True},
        {"name": "short", "mode": "position", "duration_s": 0.1},
        {"name": "torque", "mode": "torque", "duration_s": 0.2},
        {"name": "back", "mode": "position", "duration_s": 0.2},
    ]
    played = play(phases).go(530)
    assert played.stages[349:352] == [Stage.POSITION, Stage.CAPTURE, Stage.TORQUE]
    before, captured = (np.array(played.loop.commands[k].position) for k in (349, 350))
    assert captured == pytest.approx(before, abs=2e-3)  # the reference stops where it was a cycle ago
    assert played.stages[449:451] == [Stage.TORQUE, Stage.POSITION]
    back = played.loop.commands[450]
    assert back.position == pytest.approx(played.loop.traces[450].position_estimated, abs=1e-9)


def test_the_same_states_give_the_same_commands(play: Callable[..., Played]) -> None:
    first, second = (play(MOVING).go(300).commands for _ in range(2))
    assert np.array_equal(first, second)
