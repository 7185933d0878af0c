from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from deploy.cli import main
from deploy.doctor import examine, show
from schemas.load import load_robot


def test_timing_of_arm9_by_hand() -> None:
    # Slowest bus: SYNC 55, 3 × (TPDO1 135 + TPDO2 85), 2 × F/T 135 = 985 bit; 3 × RPDO of 7 bytes (125) = 375 bit.
    diagnosis = examine(load_robot("arm9").description)
    assert diagnosis.report_time_s == pytest.approx(985e-6)
    assert diagnosis.command_time_s == pytest.approx(375e-6)
    assert diagnosis.needed_s == pytest.approx(985e-6 + 375e-6 + diagnosis.robot.compute_budget_s)
    assert diagnosis.available_s == pytest.approx(diagnosis.robot.command_delay_cycles * 0.002)


def test_tables_name_every_joint_bus_and_sensor() -> None:
    robot = load_robot("arm9").description
    console = Console(file=io.StringIO(), width=140)
    show(robot, examine(robot), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO, by the line above
    for name in (*robot.joint_names, *(bus.name for bus in robot.buses), *(s.name for s in robot.force_torque_sensors)):
        assert name in text
    assert "bit in 2 ms at 1 Mbit/s" in text


def test_a_budget_that_does_not_fit_exits_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--robot", "arm9", "--set", "compute_budget_s=0.0019"]) == 1
    assert "does not fit" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("rate_hz: 500", "rate_hz: 500\ncolour: red", "colour"),
        ("rate_hz: 500", "rate_hz: .nan", "rate_hz"),
        ("rate_hz: 500", "rate_hz: 1000", "overloaded"),
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
