"""Two messages differ where their first field differs, and nowhere within a tolerance."""

from __future__ import annotations

import pytest

from deploy.compare import CONTROLLER, Difference, compare
from schemas.base import ControlMode
from schemas.messages import JointCommand, RobotState

LOGGED = JointCommand(session="s", sequence=5, time_ns=10, mode=ControlMode.TORQUE, torque=(1.0, -2.0, 3.0))


def _changed(**fields: object) -> JointCommand:
    return JointCommand.model_validate(LOGGED.model_dump() | fields)


def test_equal_messages_do_not_differ() -> None:
    assert compare(5, "command", LOGGED, _changed(), None) is None


@pytest.mark.parametrize(
    ("fields", "where", "logged", "replayed"),
    [
        ({"torque": (1.0, -2.0, 3.0000000000000004)}, "command.torque[2]", 3.0, 3.0000000000000004),
        ({"torque": (1.0, 2.0, 4.0)}, "command.torque[1]", -2.0, 2.0),
        ({"torque": (1.0, -2.0)}, "command.torque", [1.0, -2.0, 3.0], [1.0, -2.0]),
        ({"torque": None}, "command.torque", [1.0, -2.0, 3.0], None),
        ({"mode": ControlMode.POSITION, "torque": (9.0, 9.0, 9.0)}, "command.mode", "torque", "position"),
        ({"sequence": 6}, "command.sequence", 5, 6),
    ],
)
def test_first_field_is_named(fields: dict[str, object], where: str, logged: object, replayed: object) -> None:
    assert compare(5, "command", LOGGED, _changed(**fields), None) == Difference(5, where, logged, replayed)


def test_sign_of_zero_counts_when_exact() -> None:
    zero, negative = _changed(torque=(0.0, 0.0, 0.0)), _changed(torque=(0.0, -0.0, 0.0))
    difference = compare(5, "command", zero, negative, None)
    assert difference is not None
    assert difference.field == "command.torque[1]"
    assert compare(5, "command", zero, negative, CONTROLLER) is None


def test_tolerance_belongs_to_its_field() -> None:
    near = CONTROLLER["torque"] * 0.9
    assert compare(5, "command", LOGGED, _changed(torque=(1.0 + near, -2.0 - near, 3.0)), CONTROLLER) is None
    assert compare(5, "command", LOGGED, _changed(torque=(1.0 + 2 * near, -2.0, 3.0)), CONTROLLER) is not None
    assert compare(5, "command", LOGGED, _changed(position=(near,)), CONTROLLER) is not None


def test_message_of_a_difference() -> None:
    assert str(Difference(7, "command.torque[0]", 1.0, 2.0)) == "tick 7, command.torque[0]: logged 1.0, replayed 2.0"


def test_tolerance_names_are_fields() -> None:
    assert set(CONTROLLER) <= set(JointCommand.model_fields)
    assert "position_measured" in RobotState.model_fields
