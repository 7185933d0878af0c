"""Phases by sequence, and references without jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from controller_service.controller import Controller
from controller_service.model import Configuration, RobotModel
from controller_service.schedule import References, Schedule
from schemas.controller import ControllerConfig
from schemas.errors import ConfigurationError
from schemas.load import Robot, Run

PHASES = [
    {"name": "reach", "mode": "position", "duration_s": 0.1, "posture": {"joint5": -0.5}},
    {"name": "circle", "mode": "torque", "duration_s": 0.2, "hand_path": {"diameter_m": 0.1, "lap_s": 0.2}},
    {"name": "rest", "mode": "torque", "duration_s": 0.1},
]
CONFIG = ControllerConfig.model_validate({"phases": PHASES})


def test_phases_follow_the_sequence_and_the_last_is_held(arm: Robot) -> None:
    schedule = Schedule(arm.description, CONFIG.phases)
    names = [schedule.at(k).phase.name for k in (0, 49, 50, 149, 150, 100000)]
    assert names == ["reach", "reach", "circle", "circle", "rest", "rest"]
    assert schedule.at(60).since_start_s == pytest.approx(0.02)


def test_references_are_continuous_and_the_hand_is_free_while_only_the_posture_moves(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    postures, hands = [], []
    for k in range(220):
        targets = references.advance(schedule.at(k), now)
        assert (targets.posture, targets.hand) == (references.posture_target, references.hand_target)
        assert (targets.hand is None) == (k < 50)
        postures.append(targets.posture.position)
        hands.append(None if targets.hand is None else targets.hand.position)
    assert np.abs(np.diff(postures, axis=0)).max() < 0.03
    assert postures[-1][5] == pytest.approx(-0.5)
    assert np.abs(np.diff(np.array(hands[50:]), axis=0)).max() < 0.01
    assert np.allclose(hands[50], now.frames["hand"].position)
    assert np.allclose(hands[-1], hands[50])


def test_a_phase_entered_too_late_is_held(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    start = references.advance(schedule.at(60), now).hand
    later = references.advance(schedule.at(100), now).hand
    assert start is not None
    assert later is not None
    assert np.array_equal(start.position, later.position)


ALL = (True,) * 6


def moved(arm: Robot) -> Configuration:
    return RobotModel(arm, ("hand",)).configure(np.linspace(0.3, -0.6, 9), np.ones(9))


def test_a_hand_let_go_stays_where_it_is_until_it_gets_another_motion(arm: Robot) -> None:
    """From the next tick on, at rest; the next phase goes on from there without a jump."""
    phases = (*CONFIG.phases, CONFIG.phases[1].model_copy(update={"name": "again"}))
    schedule, references = Schedule(arm.description, phases), References(arm.description)
    now, there = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9)), moved(arm)
    references.advance(schedule.at(50), now)
    references.advance(schedule.at(100), now)
    before = references.hand_target
    references.follow_hand(there, ALL)
    assert references.hand_target is before
    held = [references.advance(schedule.at(k), now).hand for k in (101, 140, 149, 150, 180, 199, 200)]
    for target in held:
        assert target is not None
        assert np.allclose(target.position, there.frames["hand"].position)
        assert np.allclose(target.rotation, there.frames["hand"].rotation)
        assert not target.velocity.any()
        assert not target.acceleration.any()
    circling = references.advance(schedule.at(240), now).hand
    assert circling is not None
    assert np.linalg.norm(circling.position - there.frames["hand"].position) > 0.01


def test_only_the_directions_that_are_led_take_the_new_place(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description)
    now, there = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9)), moved(arm)
    first = references.advance(schedule.at(160), now).hand
    references.follow_hand(there, (True, False, True, True, True, False))
    held = references.advance(schedule.at(161), now).hand
    assert first is not None
    assert held is not None
    place = there.frames["hand"].position
    assert np.allclose(held.position, [place[0], first.position[1], place[2]])
    assert np.allclose(held.rotation, first.rotation)


def test_a_hand_that_is_free_cannot_be_held(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    references.follow_hand(now, ALL)
    references.advance(schedule.at(10), now)
    references.follow_hand(moved(arm), ALL)
    assert references.advance(schedule.at(11), now).hand is None
    without = References(arm.description.model_copy(update={"hand_frame": None}))
    without.advance(schedule.at(160), now)
    without.follow_hand(now, ALL)
    assert without.advance(schedule.at(161), now).hand is None


def test_what_is_forgotten_starts_from_where_the_robot_is(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description)
    now, there = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9)), moved(arm)
    references.advance(schedule.at(160), now)
    references.forget()
    targets = references.advance(schedule.at(161), there)
    assert np.array_equal(targets.posture.position, there.position)
    assert targets.hand is not None
    assert np.array_equal(targets.hand.position, there.frames["hand"].position)
    assert np.array_equal(targets.hand.rotation, there.frames["hand"].rotation)


@pytest.mark.parametrize(
    ("phase", "message"),
    [
        ({"mode": "servo"}, "phases.0.mode: servo is not possible on joint joint0"),
        ({"mode": "torque", "hand_path": {"diameter_m": 0.1, "lap_s": 2.0, "laps": 2}}, "longer than the phase"),
        (
            {"mode": "position", "joint_path": {"points": [{"time_s": 3.5, "posture": {"joint1": 0.1}}]}},
            "phases.0.joint_path: its last point is at 3.5 s, after the phase's duration_s 3",
        ),
        (
            {
                "mode": "position",
                "joint_sines": {"joints": {"joint1": {"amplitude": 0.1, "frequency_hz": 1}}, "fade_s": 1.6},
            },
            "phases.0.joint_sines: two ramps of fade_s 1.6 s do not fit",
        ),
    ],
)
def test_phases_that_do_not_fit_are_refused(run_of: Callable[..., Run], phase: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Controller(run_of({"phases": [{"name": "x", "duration_s": 3.0} | phase]}), "s")


SPLINE = {"points": [{"time_s": 0.1, "posture": {"joint5": -0.4}}, {"time_s": 0.18, "posture": {"joint2": 0.2}}]}
SINES = {"joints": {"joint4": {"amplitude": 0.2, "frequency_hz": 20.0}}, "fade_s": 0.05}
MOTIONS = ControllerConfig.model_validate(
    {
        "phases": [
            {"name": "reach", "mode": "position", "duration_s": 0.1, "posture": {"joint5": -0.5}},
            {"name": "path", "mode": "position", "duration_s": 0.2, "joint_path": SPLINE},
            {"name": "swing", "mode": "position", "duration_s": 0.2, "joint_sines": SINES},
            {"name": "torque", "mode": "position", "duration_s": 0.1, "torque_control": True},
            {"name": "rest", "mode": "position", "duration_s": 0.1},
        ]
    }
)


def test_joint_motions_follow_one_another_without_a_jump_and_leave_the_hand_free(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, MOTIONS.phases), References(arm.description)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    targets = [references.advance(schedule.at(k), now) for k in range(350)]
    posture = np.array([each.posture.position for each in targets])
    velocity = np.array([each.posture.velocity for each in targets])
    assert np.abs(np.diff(posture, axis=0)).max() < 0.06
    assert posture[1:] - posture[:-1] == pytest.approx(0.002 * 0.5 * (velocity[1:] + velocity[:-1]), abs=2e-3)
    assert posture[150] == pytest.approx(np.where(np.arange(9) == 5, -0.4, np.where(np.arange(9) == 2, 0.2, 0.0)))
    assert np.abs(posture[150:250, 4]).max() > 0.1
    assert posture[250:] == pytest.approx(np.tile(posture[150], (100, 1)), abs=1e-9)
    assert [k for k, each in enumerate(targets) if each.hand is not None] == list(range(300, 350))
    assert references.take_dropped_path() is None


@pytest.mark.parametrize(("phase", "late", "name"), [(1, 60, "path"), (2, 160, "swing")])
def test_a_motion_of_the_joints_that_is_entered_late_is_left_out_and_told(
    arm: Robot, phase: int, late: int, name: str
) -> None:
    """After a hold: the joints stay where the robot is, until the next phase."""
    schedule, references = Schedule(arm.description, MOTIONS.phases), References(arm.description)
    now = RobotModel(arm, ("hand",)).configure(np.linspace(-0.1, 0.1, 9), np.zeros(9))
    assert schedule.at(late).index == phase
    for k in range(late, 50 * 2 * phase + 49):
        target = references.advance(schedule.at(k), now).posture
        assert np.array_equal(target.position, now.position)
        assert not target.velocity.any()
    assert references.take_dropped_path() == name
    assert references.take_dropped_path() is None
