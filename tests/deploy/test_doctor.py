from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from deploy.cli import main
from deploy.doctor import Diagnosis, examine, show
from schemas.load import load_robot, rewire

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
ONE_BUS = ROBOTS / "arm9-one-bus.yaml"


def printed(diagnosis: Diagnosis) -> str:
    console = Console(file=io.StringIO(), width=140)
    show(diagnosis, console)
    return console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO, by the line above


def test_timing_of_arm9_by_hand() -> None:
    # Slowest bus: SYNC 55, 3 × (TPDO1 135 + TPDO2 85), 2 × F/T 135 = 985 bit; 3 × RPDO of 7 bytes (125) = 375 bit.
    diagnosis = examine(load_robot("arm9").description)
    plan = diagnosis.plan
    assert plan.report_time_s == pytest.approx(985e-6)
    assert plan.command_time_s == pytest.approx(375e-6)
    assert plan.needed_s == pytest.approx(985e-6 + 375e-6 + diagnosis.robot.compute_budget_s)
    assert plan.available_s == pytest.approx(diagnosis.robot.command_delay_cycles * 0.002)


def test_tables_name_every_joint_bus_and_sensor() -> None:
    robot = load_robot("arm9").description
    text = printed(examine(robot))
    for name in (*robot.joint_names, *(bus.name for bus in robot.buses), *(s.name for s in robot.force_torque_sensors)):
        assert name in text
    assert "bit in 2 ms at 1 Mbit/s" in text
    assert "timing fits: " in text


def test_the_plants_channel_is_shown_where_it_has_its_own() -> None:
    robot = load_robot("arm9")
    pairs = [{"interface": "socketcan", "channel": f"can{2 * n}", "plant_channel": f"can{2 * n + 1}"} for n in range(3)]
    assert "socketcan:can2 (plant can3)" in printed(examine(rewire(robot, pairs).description))


def test_a_budget_that_does_not_fit_exits_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", "arm9", "--set", "compute_budget_s=0.0019"]) == 1
    text = capsys.readouterr().out
    assert "timing does not fit: reports 0.985 ms + compute 1.900 ms + commands 0.375 ms = 3.260 ms > 2.000 ms" in text
    assert "overloaded" not in text


def test_arm9_on_one_bus_is_overloaded_and_diagnosed_whole(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", str(ONE_BUS)]) == 1
    text = capsys.readouterr().out
    # SYNC 55 + 9 × (TPDO1 135 + TPDO2 85 + RPDO 125) + 2 × F/T 135 = 3430 bit; 10 heartbeats of 65 bit.
    assert "= 3430 bit in 2 ms at 1 Mbit/s = 171.5%; 10×heartbeat(65 bit) in 100 ms = 0.7%; together 172.2%" in text
    assert "load does not fit: bus arm9-0 is overloaded, 172.2%" in text
    assert "timing does not fit: reports 2.305 ms" in text
    assert "wrist_roll" in text
    assert "to make it fit: lower rate_hz, move joints or sensors to another bus" in text


def test_arm9_on_one_bus_is_arm9_but_for_its_buses() -> None:
    one = load_robot(str(ONE_BUS), allow_overload=True).description.model_dump(exclude={"name", "urdf", "buses"})
    other = load_robot("arm9").description.model_dump(exclude={"name", "urdf", "buses"})
    for robot in (one, other):
        for user in (*(joint["drive"] for joint in robot["joints"]), *robot["force_torque_sensors"]):
            del user["bus"]
    assert one == other


def test_a_plan_that_does_not_fit_is_explained_in_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", str(ONE_BUS), "--json"]) == 1
    diagnosis = json.loads(capsys.readouterr().out)
    assert diagnosis["fits"] is False
    overload, timing = diagnosis["faults"]
    assert "bus arm9-0 is overloaded" in overload
    assert "commands miss their SYNC" in timing
    (bus,) = diagnosis["buses"]
    assert bus["worst_case_load"] == pytest.approx(1.7215)
    assert bus["heartbeat_bits"] == 650


def test_without_a_robot_or_a_log_there_is_nothing_to_examine(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 2
    assert "--robot" in capsys.readouterr().err


@pytest.mark.parametrize("robot", ["crane", "stilt", "feather"])
def test_other_robots_fit(robot: str) -> None:
    assert main(["doctor", "--robot", str(ROBOTS / f"{robot}.yaml")]) == 0


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("rate_hz: 500", "rate_hz: 500\ncolour: red", "colour"),
        ("rate_hz: 500", "rate_hz: .nan", "rate_hz"),
        ("channel: arm9-1", "channel: arm9-0", "'cosim:arm9-0' is given twice"),
        ("node_id: 2,", "node_id: 1,", "node id"),
        ("- name: elbow_pitch", "- name: knee", "knee"),
        ("hand_frame: hand", "hand_frame: foot", "foot"),
        ("urdf: arm9.urdf", "urdf: nosuch.urdf", "nosuch.urdf"),
        ("name: arm9", "name: [", "YAML"),
    ],
)
def test_a_bad_file_is_refused_in_one_message(
    robot_file: Path, old: str, new: str, named: str, capfd: pytest.CaptureFixture[str]
) -> None:
    text = robot_file.read_text()
    assert old in text
    robot_file.write_text(text.replace(old, new, 1))
    assert main(["doctor", "--robot", str(robot_file)]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    assert named in captured.err
    assert str(robot_file.parent) in captured.err
    assert len(captured.err.splitlines()) <= 2
