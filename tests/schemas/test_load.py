"""A bad file is refused in one message that names file, field and reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from schemas.errors import ConfigurationError
from schemas.load import load_robot, load_run


def _set(path: str, value: Any) -> Callable[[Any], None]:
    def change(files: Any) -> None:
        node = {"robot": files.robot, "scenario": files.scenario}
        *parents, leaf = path.split(".")
        for part in parents:
            node = node[int(part)] if part.isdigit() else node[part]
        node[int(leaf) if leaf.isdigit() else leaf] = value

    return change


BAD = [
    (_set("robot.colour", "red"), "pendulum.yaml: colour: Extra inputs are not permitted"),
    (_set("robot.joints.0.gear_ratoi", 1.0), "joints.0.gear_ratoi: Extra"),
    (_set("robot.joints.1.torque_limit", float("nan")), "joints.1.torque_limit"),
    (_set("robot.rate_hz", float("inf")), "rate_hz"),
    (_set("robot.rate_hz", -1.0), "rate_hz: Input should be greater than 0"),
    (_set("robot.joints.1.drive.node_id", 1), "node id on bus can0: 1 is used by shoulder and by elbow"),
    (_set("robot.joints.1.drive.node_id", 128), "joints.1.drive.node_id"),
    (_set("robot.force_torque_sensors.0.can_id", 0x80), "CAN identifier on bus can1: 128 is used by CANopen itself"),
    (_set("robot.force_torque_sensors.0.command_id", 0x101), "CAN identifier on bus can1: 257 is used by wrist"),
    (_set("robot.joints.0.drive.rated_motor_torque", 0.5004), "rated_motor_torque 0.5004 must be whole mN·m"),
    (_set("robot.joints.1.name", "shoulder"), "joint 'shoulder' is given twice"),
    (_set("robot.joints.1.name", "knee"), "joints.1.name: pendulum.urdf has no joint 'knee'"),
    (_set("robot.joints.1.name", "wrist"), "joints.1: wrist is fixed in pendulum.urdf"),
    (_set("robot.joints.1.drive.bus", "can7"), "elbow: unknown bus 'can7'; the buses are can0, can1"),
    (_set("robot.joints.0.position_min", 2.0), "position_min 2.0 must lie below position_max 1.5"),
    (_set("robot.joints.0.encoder_counts", 2**31), "32 bits"),
    (_set("robot.joints.0.torque_limit", 1e4), "16 bits"),
    (_set("robot.hand_frame", "glove"), "hand_frame: pendulum.urdf has no link 'glove'"),
    (_set("robot.force_torque_sensors.0.frame", "sole"), "force_torque_sensors.0.frame"),
    (_set("robot.urdf", "other.urdf"), "urdf: no file at"),
    (_set("robot.urdf", "package://no_such_package/a.urdf"), "'no_such_package' is not installed"),
    (_set("robot.rate_hz", 4000.0), "bus can0 is overloaded"),
    (_set("robot.compute_budget_s", 0.002), "commands miss their SYNC: reports 0.495 ms + compute 2.000 ms"),
    (_set("scenario.robot", "no-such-robot"), "no robot 'no-such-robot'"),
    (_set("scenario.plant", {"initial_posture": {"knee": 0.0}}), "plant.initial_posture: robot pendulum has no joint"),
    (_set("scenario.plant", {"substep_s": 0.0007}), "plant.substep_s: 0.0007 s does not divide the period 0.002 s"),
    (_set("scenario.controller.lambda", 200.0), "controller.lambda: λT = 0.4"),
    (_set("scenario.controller.phases", []), "controller.phases"),
    (_set("scenario.clock", "sundial"), "clock: Input should be 'lockstep' or 'realtime'"),
]


@pytest.mark.parametrize(("change", "expected"), BAD, ids=[expected for _, expected in BAD])
def test_bad_file_is_refused_in_one_clear_message(files: Any, change: Callable[[Any], None], expected: str) -> None:
    change(files)
    with pytest.raises(ConfigurationError) as caught:
        files.load()
    text = str(caught.value)
    assert expected in text
    assert ".yaml" in text or "no-such-robot" in text
    assert "\n" not in text
    assert caught.value.exit_code == 2


def test_overload_message_shows_the_arithmetic(files: Any) -> None:
    files.robot["rate_hz"] = 4000.0
    files.scenario["plant"] = {"substep_s": 0.00025}
    with pytest.raises(
        ConfigurationError, match=r"1×SYNC\(55 bit\) \+ 2×TPDO1\(135 bit\) .* in 0.25 ms at 1 Mbit/s = "
    ):
        files.load()


OVERLOADED = [
    {"robot.rate_hz": 4000.0, "plant.substep_s": 0.00025},
    {"robot.compute_budget_s": 0.0014},  # 75 % of the bus, yet too late for the SYNC
]


@pytest.mark.parametrize("overrides", OVERLOADED, ids=["over 100 %", "too late"])
def test_a_plan_that_does_not_fit_runs_only_when_it_is_forced_to(files: Any, overrides: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=r"To make it fit: .*; to run it all the same: --allow-overload"):
        files.load(**overrides)
    assert files.load(**overrides, allow_overload=True).scenario.allow_overload
    files.scenario["allow_overload"] = True
    run = files.load(**overrides)
    robot = {path.removeprefix("robot."): value for path, value in overrides.items() if path.startswith("robot.")}
    name = str(files.folder / "pendulum.yaml")
    assert load_robot(name, robot, allow_overload=True) == run.robot
    with pytest.raises(ConfigurationError, match="--allow-overload"):
        load_robot(name, robot)


def test_broken_yaml_names_the_file(files: Any) -> None:
    files.load()
    (files.folder / "hold.yaml").write_text("name: [")
    with pytest.raises(ConfigurationError, match=r"hold.yaml: not valid YAML"):
        load_run(str(files.folder / "hold.yaml"))
    (files.folder / "hold.yaml").write_text("- a\n- b\n")
    with pytest.raises(ConfigurationError, match=r"hold.yaml: expected a mapping"):
        load_run(str(files.folder / "hold.yaml"))


def test_broken_urdf_names_the_file(files: Any) -> None:
    files.urdf = "<robot>"
    with pytest.raises(ConfigurationError, match=r"pendulum.urdf: not valid XML"):
        files.load()


def test_unknown_names_list_what_there_is() -> None:
    with pytest.raises(
        ConfigurationError, match=r"no scenario 'no-such': give a .yaml file or one of .*arm9-transition"
    ):
        load_run("no-such")


def test_overrides_reach_robot_and_scenario(files: Any) -> None:
    run = files.load(
        **{
            "robot.rate_hz": 250.0,
            "robot.joints.elbow.torque_limit": 50.0,
            "robot.joints.0.torque_limit": 60.0,
            "plant.torque_scale": 0.8,
            "controller.phases.hold.duration_s": 2.0,
        }
    )
    assert run.robot.description.rate_hz == 250.0
    assert [joint.torque_limit for joint in run.robot.description.joints] == [60.0, 50.0]
    assert run.scenario.plant.torque_scale == 0.8
    assert run.scenario.controller.phases[0].duration_s == 2.0
    assert run.cycles == 250


@pytest.mark.parametrize("path", ["plant.torqe_scale", "controller.phases.walk.duration_s", "name.first"])
def test_override_of_what_does_not_exist_is_refused(files: Any, path: str) -> None:
    with pytest.raises(ConfigurationError, match=path.split(".")[0]):
        files.load(**{path: 1.0})


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (
            "scenario.controller.phases.0.posture",
            {"shoulder": 3.0},
            "controller.phases.0.posture.shoulder: 3 rad lies outside [-1.5, 1.5] rad",
        ),
        ("scenario.duration_s", 0.0005, "duration_s: 0.0005 s is shorter than a cycle of 0.002 s"),
        ("scenario.namespace", "a/b", "namespace: String should match"),
        ("scenario.namespace", "", "namespace: String should match"),
        ("scenario.namespace", "a*", "namespace: String should match"),
        (
            "robot.buses",
            [{"name": name, "channel": name} for name in ("can0", "can1", "can/2")],
            "buses.2.name: String should match",
        ),
        ("robot.urdf", "package://no.such.package/a.urdf", "'no.such.package' is not installed"),
        ("robot.urdf", "package:///a.urdf", "'' is not installed"),
    ],
)
def test_what_could_not_run_is_refused(files: Any, path: str, value: Any, expected: str) -> None:
    _set(path, value)(files)
    with pytest.raises(ConfigurationError) as caught:
        files.load()
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("angle", [-1.5, 1.5])
def test_a_posture_may_lie_at_a_limit(files: Any, angle: float) -> None:
    files.scenario["controller"]["phases"][0]["posture"] = {"elbow": angle}
    assert files.load().scenario.controller.phases[0].posture == {"elbow": angle}


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("hold.yaml", b"\nseed: 8\n", "'seed' is given twice"),
        ("hold.yaml", b"plant: {seed: 8, seed: 8}\n", "'seed' is given twice"),
        ("pendulum.yaml", b"\nrate_hz: 250.0\n", "'rate_hz' is given twice"),
        ("hold.yaml", b"# \xff\xfe\n", "not valid YAML"),
    ],
)
def test_doubled_fields_and_bad_bytes_name_the_file(files: Any, name: str, text: bytes, expected: str) -> None:
    files.load()
    path = files.folder / name
    path.write_bytes(path.read_bytes() + text)
    with pytest.raises(ConfigurationError, match=rf"{name}: not valid YAML") as caught:
        load_run(str(files.folder / "hold.yaml"))
    assert expected in str(caught.value)


@pytest.mark.parametrize("kind", ["prismatic", "floating", "planar"])
def test_joints_that_do_not_turn_are_refused(files: Any, kind: str) -> None:
    files.urdf = files.urdf.replace('name="elbow" type="revolute"', f'name="elbow" type="{kind}"')
    with pytest.raises(ConfigurationError, match=rf"joints\.1: elbow is {kind} in pendulum\.urdf, expected revolute"):
        files.load()
