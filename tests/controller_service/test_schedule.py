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
    ],
)
def test_phases_that_do_not_fit_are_refused(run_of: Callable[..., Run], phase: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Controller(run_of({"phases": [{"name": "x", "duration_s": 3.0} | phase]}), "s")
