"""Torque control through positions and motions of joints that do not fit the robot are refused when they are loaded."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from schemas.check_run import check_run
from schemas.errors import ConfigurationError
from schemas.scenario import Scenario

MOTORS = {
    "shoulder": {"torque_gain": 1e-3, "velocity_gain": 0.01},
    "elbow": {"torque_gain": 2e-3, "velocity_gain": 0.02},
}


def _torque_control(files: Any, **config: Any) -> dict[str, Any]:
    """Make the scenario one of torque control through the position interface; return its only phase."""
    files.scenario["controller"]["position_torque"] = {"motors": dict(MOTORS), "sensor": "wrist"} | config
    phase: dict[str, Any] = files.scenario["controller"]["phases"][0]
    phase["torque_control"] = True
    return phase


def _refusal(files: Any) -> str:
    with pytest.raises(ConfigurationError) as caught:
        files.load()
    text = str(caught.value)
    assert "hold.yaml: " in text or "motors.yaml: " in text
    assert "\n" not in text
    return text


def test_torque_control_that_has_all_it_needs_is_taken(files: Any) -> None:
    phase = _torque_control(files)
    phase["wrench"] = {"mean": [0, 0, 10, 0, 0, 0]}
    phase["joint_path"] = {"points": [{"time_s": 0.5, "posture": {"elbow": 1.5}}]}
    config = files.load().scenario.controller
    assert config.phases[0].torque_control
    assert config.position_torque.motors["elbow"].velocity_gain == 0.02


def test_torque_control_needs_its_configuration(files: Any) -> None:
    _torque_control(files)
    del files.scenario["controller"]["position_torque"]
    assert "controller.phases.0.torque_control: needs controller.position_torque" in _refusal(files)


WRENCH = {"mean": [0, 0, 10, 0, 0, 0]}


def test_a_wrench_needs_a_sensor_and_a_hand(files: Any) -> None:
    _torque_control(files, sensor=None)["wrench"] = WRENCH
    expected = "controller.phases.0.wrench: needs the robot's hand_frame and controller.position_torque.sensor"
    assert expected in _refusal(files)
    _torque_control(files)["wrench"] = WRENCH
    files.robot["hand_frame"] = None
    assert expected in _refusal(files)


@pytest.mark.parametrize("torque_control", [False, True])
@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"motors": {"shoulder": MOTORS["shoulder"]}}, "controller.position_torque.motors: no model of elbow"),
        ({"motors": {**MOTORS, "knee": MOTORS["elbow"]}}, "position_torque.motors: robot pendulum has no joint 'knee'"),
        ({"sensor": "ankle"}, "controller.position_torque.sensor: robot pendulum has no 'ankle'; it has wrist"),
        ({"imu": "base"}, "controller.position_torque.imu: robot pendulum has no 'base'; it has none"),
        (
            {"sensor": None, "payload": {"mass": 1.0, "centre_in_sensor": [0, 0, 0]}},
            "controller.position_torque.payload: is what a force/torque sensor carries",
        ),
        ({"motors": {"elbow": {"torque_gain": 0, "velocity_gain": 0}}}, "motors.elbow.torque_gain: Input should be"),
        ({"motors": [1]}, "controller.position_torque.motors: Input should be a valid dictionary"),
    ],
)
def test_motors_and_sensors_that_do_not_fit_are_refused(
    files: Any, torque_control: bool, config: dict[str, Any], expected: str
) -> None:
    """Also where no phase uses them: the estimates need them all the same."""
    _torque_control(files, **config)["torque_control"] = torque_control
    assert expected in _refusal(files)


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        (
            {"joint_path": {"points": [{"time_s": 0.2, "posture": {"knee": 0.1}}]}},
            "controller.phases.0.joint_path.points.0.posture: robot pendulum has no joint 'knee'",
        ),
        (
            {
                "joint_path": {
                    "points": [{"time_s": 0.2, "posture": {"elbow": 0}}, {"time_s": 0.4, "posture": {"elbow": -2}}]
                }
            },
            "controller.phases.0.joint_path.points.1.posture.elbow: -2 rad lies outside [-1.5, 1.5] rad",
        ),
        (
            {"joint_sines": {"joints": {"knee": {"amplitude": 0.1, "frequency_hz": 1}}}},
            "controller.phases.0.joint_sines.joints: robot pendulum has no joint 'knee'",
        ),
    ],
)
def test_motions_that_the_joints_cannot_make_are_refused(files: Any, motion: dict[str, Any], expected: str) -> None:
    files.scenario["controller"]["phases"][0] |= motion
    assert expected in _refusal(files)


def _write_motors(files: Any, text: str) -> None:
    (files.folder / "motors.yaml").write_text(text)


def test_motors_of_a_file_stand_below_those_of_the_scenario(files: Any) -> None:
    """Field by field; the file may say more, as the identification does."""
    _write_motors(files, yaml.safe_dump({"motors": MOTORS, "samples": 1000}))
    _torque_control(files, motors={"elbow": {"torque_gain": 3e-3}}, motors_from="motors.yaml")
    motors = files.load().scenario.controller.position_torque.motors
    assert (motors["shoulder"].torque_gain, motors["shoulder"].velocity_gain) == (1e-3, 0.01)
    assert (motors["elbow"].torque_gain, motors["elbow"].velocity_gain) == (3e-3, 0.02)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "name: no motors\n",
            "motors.yaml: motors: expected a mapping of joints, as `cosim identify motors` writes it",
        ),
        ("motors: [1, 2]\n", "motors.yaml: motors: expected a mapping of joints"),
        ("motors: {elbow: {}\n", "motors.yaml: not valid YAML"),
        ("- 1\n", "motors.yaml: expected a mapping"),
        ("motors: {elbow: 3}\n", "controller.position_torque.motors.elbow"),
        ("motors: {elbow: {torque_gain: .nan, velocity_gain: 0}}\n", "motors.elbow.torque_gain: Input should be"),
        (
            "motors: {elbow: {torque_gain: 1}}\n",
            "controller.position_torque.motors.elbow.velocity_gain: Field required",
        ),
    ],
)
def test_a_bad_file_of_motors_is_refused(files: Any, text: str, expected: str) -> None:
    _write_motors(files, text)
    _torque_control(files, motors={}, motors_from="motors.yaml")
    assert expected in _refusal(files)


def test_a_file_of_motors_that_is_not_there_lists_what_there_is(files: Any) -> None:
    _torque_control(files, motors={}, motors_from="no-such-motors")
    with pytest.raises(ConfigurationError, match=r"no motors 'no-such-motors': give a .yaml file or one of .*leg6"):
        files.load()
    _torque_control(files, motors={}, motors_from="missing.yaml")
    with pytest.raises(ConfigurationError, match=r"no motors file at missing.yaml"):
        files.load()


def test_the_run_holds_the_motors_themselves(files: Any) -> None:
    """What is logged needs no file: `check_run` takes it as it is, whatever became of `motors_from`."""
    _write_motors(files, yaml.safe_dump({"motors": MOTORS}))
    _torque_control(files, motors={}, motors_from="motors.yaml")
    run = files.load()
    (files.folder / "motors.yaml").unlink()
    again = Scenario.model_validate_json(run.scenario.model_dump_json(by_alias=True))
    assert again == run.scenario
    check_run(run.robot.description, again, "log")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"torque_gain": 1.0}, "elbow.torque_gain: 1 rad/(N·m) is "),
        ({"torque_gain": 2e-6}, "expected 0.2 to 5 times. Unit: rad/(N·m)"),
        ({"velocity_gain": 20.0}, "elbow.velocity_gain: 20 s; expected at most "),
    ],
)
def test_a_motor_in_wrong_units_is_refused(files: Any, change: dict[str, float], expected: str) -> None:
    """A column of a table in 10⁻³ must not make the law a thousand times as stiff."""
    _torque_control(files, motors={**MOTORS, "elbow": MOTORS["elbow"] | change})
    assert expected in _refusal(files)


@pytest.mark.parametrize("part", ["hand_path", "collision"])
def test_what_acts_through_the_qp_alone_is_refused_without_it(files: Any, part: str) -> None:
    phase = _torque_control(files)
    if part == "hand_path":
        phase["hand_path"] = {"diameter_m": 0.1, "lap_s": 1.0}
    else:
        files.scenario["controller"]["collision"] = {}
    text = _refusal(files)
    assert part in text
    assert "set controller.position_torque.desired to qp" in text
    files.scenario["controller"]["position_torque"]["desired"] = "qp"
    files.load()


def test_a_sensor_without_a_hand_is_refused(files: Any) -> None:
    _torque_control(files)
    files.robot["hand_frame"] = None
    assert "position_torque.sensor: robot" in _refusal(files)


def test_a_sine_faster_than_its_joint_is_refused(files: Any) -> None:
    phase = files.scenario["controller"]["phases"][0]
    phase["joint_sines"] = {"joints": {"elbow": {"growth": 10.0, "frequency_hz": 5.0}}, "fade_s": 0.1}
    assert "joint_sines.joints.elbow: reaches " in _refusal(files)
