"""Phases and the parts of the controller's configuration: what contradicts itself is refused."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from schemas.control_law import PositionTorque
from schemas.controller import OPTIONAL_PARTS, ControllerConfig, JointPath, JointSines, Phase

POSTURE = {"posture": {"knee": 0.5}}
PATH = {"joint_path": {"points": [{"time_s": 0.5, "posture": {"knee": 0.5}}]}}
SINES = {"joint_sines": {"joints": {"knee": {"amplitude": 0.1, "frequency_hz": 1.0}}}}


def phase(**fields: Any) -> Phase:
    return Phase.model_validate({"name": "a", "mode": "position", "duration_s": 1.0} | fields)


@pytest.mark.parametrize("motion", [{}, POSTURE, PATH, SINES])
def test_a_phase_may_have_one_motion_of_the_joints(motion: dict[str, Any]) -> None:
    assert phase(**motion).model_dump(exclude_defaults=True).keys() - {"name", "mode", "duration_s"} == motion.keys()


@pytest.mark.parametrize(
    ("motions", "expected"),
    [
        (POSTURE | PATH, "posture and joint_path are both given"),
        (POSTURE | SINES, "posture and joint_sines are both given"),
        (PATH | SINES, "joint_path and joint_sines are both given"),
    ],
)
def test_two_motions_in_one_phase_are_refused(motions: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValidationError, match=expected):
        phase(**motions)


@pytest.mark.parametrize("mode", ["torque", "servo"])
def test_torque_control_is_one_of_the_position_mode(mode: str) -> None:
    assert phase(torque_control=True).torque_control
    with pytest.raises(ValidationError, match=f"torque_control goes through drives in mode position, mode is {mode}"):
        phase(torque_control=True, mode=mode)


def test_a_wrench_is_one_of_torque_control() -> None:
    wrench = {"wrench": {"mean": [0, 0, 10, 0, 0, 0]}}
    assert phase(torque_control=True, **wrench).wrench is not None
    with pytest.raises(ValidationError, match="wrench: a wrench is controlled with torque_control: true only"):
        phase(**wrench)


@pytest.mark.parametrize("times", [(0.5, 0.5), (0.5, 0.2), (0.0,), (-1.0,)])
def test_points_of_a_path_follow_one_another(times: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError, match=r"does not come after|greater than 0"):
        JointPath.model_validate({"points": [{"time_s": time, "posture": {}} for time in times]})


def test_a_motion_without_points_or_joints_is_refused() -> None:
    for model, fields in ((JointPath, {"points": []}), (JointSines, {"joints": {}})):
        with pytest.raises(ValidationError, match="at least 1 item"):
            model.model_validate(fields)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"savitzky_golay": {"window": 2}}, "savitzky_golay.window"),
        ({"savitzky_golay": {"encoder_order": 1}}, "savitzky_golay.encoder_order"),
        ({"savitzky_golay": {"sensor_order": 0}}, "savitzky_golay.sensor_order"),
        ({"torque_gain": -1.0}, "torque_gain"),
        ({"feedforward": 1.2}, "feedforward"),
        ({"estimator": "guess"}, "estimator"),
        ({"desired": "guess"}, "desired"),
        ({"payload": {"mass": 0.0, "centre_in_sensor": [0, 0, 0]}}, "payload.mass"),
        ({"start_s": 0.0}, "start_s"),
    ],
)
def test_values_that_mean_nothing_are_refused(fields: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValidationError) as caught:
        PositionTorque.model_validate(fields)
    (fault,) = caught.value.errors()
    assert ".".join(map(str, fault["loc"])) == expected


def test_the_paper_s_values_are_the_defaults() -> None:
    """Sections 5.1 and 5.2: windows of 80 samples, orders 2 and 1, K_p = 2, K_f = 1."""
    config = PositionTorque()
    filters = config.savitzky_golay
    assert (filters.window, filters.encoder_order, filters.sensor_order) == (80, 2, 1)
    assert (config.torque_gain, config.force_gain, config.torque_integral) == (2.0, 1.0, 0.0)
    assert (config.estimator, config.desired, filters.evaluate_at) == ("savitzky_golay", "inverse_dynamics", "centre")


def test_every_optional_part_may_be_absent() -> None:
    config = ControllerConfig.model_validate({"phases": [{"name": "a", "mode": "position", "duration_s": 1}]})
    assert [part for part in OPTIONAL_PARTS if getattr(config, part) is not None] == []
