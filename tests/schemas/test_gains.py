"""Sets of gains: what a scenario says wins, and nothing is switched on that it does not name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from schemas.controller import OPTIONAL_PARTS, ControllerConfig
from schemas.errors import ConfigurationError
from schemas.load import load_run


def scenario(directory: Path, controller: dict[str, Any]) -> str:
    data = {
        "name": "t",
        "robot": "arm9",
        "duration_s": 1,
        "controller": {"phases": [{"name": "a", "mode": "position", "duration_s": 1}], **controller},
    }
    path = directory / "t.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


def test_the_paper_s_set_has_the_paper_s_values(tmp_path: Path) -> None:
    """Table I and section IV-A."""
    parts = {"null_space": {}, "hand_force": {"sensor": "wrist"}}
    found = load_run(scenario(tmp_path, {"gains": "paper", **parts})).scenario.controller
    assert (found.lambda_, found.anti_windup.torque_share) == (2.0, 0.1)
    assert found.leak is not None
    assert (found.leak.slow_rate, found.leak.fast_rate, found.leak.fast_share) == (0.1, 100.0, 0.5)
    assert (found.posture.stiffness, found.posture.damping, found.posture.weight) == (0.0, 5.0, 10.0)
    assert (found.hand.stiffness, found.hand.damping, found.hand.weight) == (900.0, 50.0, 10000.0)
    assert found.hand_force is not None
    assert found.hand_force.wrench_task is not None
    assert found.hand_force.wrench_task.weight == 10.0
    admittance = found.hand_force.admittance
    assert (admittance.force_gain, admittance.force_rate_gain, admittance.weight) == (5e-3, 1e-7, 10000.0)
    assert (admittance.torque_gain, admittance.torque_rate_gain) == (5e-3, 1e-7)


@pytest.mark.parametrize("gains", ["paper", "tuned"])
def test_parts_stay_off_until_they_are_named(tmp_path: Path, gains: str) -> None:
    found = load_run(scenario(tmp_path, {"gains": gains})).scenario.controller
    assert found.gains == gains
    assert [part for part in OPTIONAL_PARTS if getattr(found, part) is not None] == []
    assert set(OPTIONAL_PARTS) < set(ControllerConfig.model_fields)


def test_a_scenario_s_own_values_win_at_every_depth(tmp_path: Path) -> None:
    own = {"gains": "paper", "lambda": 7, "hand": {"damping": 80}, "anti_windup": {"method": "scaling"}}
    found = load_run(scenario(tmp_path, own)).scenario.controller
    assert (found.lambda_, found.hand.stiffness, found.hand.damping) == (7.0, 900.0, 80.0)
    assert (found.anti_windup.method, found.anti_windup.torque_share) == ("scaling", 0.1)


def test_a_set_can_be_chosen_on_the_command_line_and_be_a_file_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("lambda: 3\nhand: {stiffness: 77, damping: 5, weight: 1}\n", encoding="utf-8")
    path = scenario(tmp_path, {"gains": "paper"})
    assert load_run(path, {"controller.gains": "tuned"}).scenario.controller.hand.stiffness == 2500.0
    found = load_run(path, {"controller.gains": "mine.yaml", "controller.hand.damping": 9}).scenario.controller
    assert (found.lambda_, found.hand.stiffness, found.hand.damping) == (3.0, 77.0, 9.0)


def test_a_set_that_is_not_there_or_wrong_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"no gains 'papper': give a \.yaml file or one of paper, tuned"):
        load_run(scenario(tmp_path, {"gains": "papper"}))
    (tmp_path / "bad.yaml").write_text("lamda: 3\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"controller\.lamda: Extra"):
        load_run(scenario(tmp_path, {"gains": "bad.yaml"}))


def test_parts_that_need_a_hand_are_refused_without_one(tmp_path: Path) -> None:
    for part, value in (("null_space", {}), ("hand_force", {"sensor": "wrist"})):
        with pytest.raises(ConfigurationError, match=f"controller.{part}: robot arm9 has no hand_frame"):
            load_run(scenario(tmp_path, {part: value}), {"robot.hand_frame": None})
