"""Phases by sequence, and references without jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from controller_service.controller import Controller
from controller_service.model import RobotModel
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
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description, CONFIG)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    postures, hands = [], []
    for k in range(220):
        tasks = references.tasks(schedule.at(k), now)
        assert len(tasks) == (1 if k < 50 else 2)
        assert references.posture_target is not None
        postures.append(references.posture_target.position)
        hands.append(None if references.hand_target is None else references.hand_target.position)
    assert np.abs(np.diff(postures, axis=0)).max() < 0.03
    assert postures[-1][5] == pytest.approx(-0.5)
    assert np.abs(np.diff(np.array(hands[50:]), axis=0)).max() < 0.01
    assert np.allclose(hands[50], now.frames["hand"].position)
    assert np.allclose(hands[-1], hands[50])


def test_a_phase_entered_too_late_is_held(arm: Robot) -> None:
    schedule, references = Schedule(arm.description, CONFIG.phases), References(arm.description, CONFIG)
    now = RobotModel(arm, ("hand",)).configure(np.zeros(9), np.zeros(9))
    references.tasks(schedule.at(60), now)
    start = references.hand_target
    references.tasks(schedule.at(100), now)
    assert start is not None
    assert references.hand_target is not None
    assert np.array_equal(start.position, references.hand_target.position)


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
