"""Robots unlike arm9, from a robot file, a URDF and a scenario alone: position-only, servo and torque drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from deploy.experiment import ExperimentRequest
from deploy.inprocess import InProcess
from deploy.metrics import mode_changes, tracking_error
from deploy.series import trace_series, truth_series
from experiments import transition
from schemas.base import ControlMode, Model
from schemas.load import Run, load_run
from schemas.topics import encode

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
SCENARIOS = {"stilt": "stilt-step", "feather": "feather-wave", "crane": "crane-transition"}
HALF_DEGREE = np.radians(0.5)
G = 9.81


def load(name: str, **overrides: object) -> Run:
    return load_run(str(ROBOTS / f"{SCENARIOS[name]}.yaml"), overrides)


class Played:
    """A run in one process and all its messages."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.robot = run.robot.description
        self.messages: dict[str, list[Model]] = {}
        InProcess(run, lambda topic, message: self.messages.setdefault(topic, []).append(message)).run()
        count = len(self.robot.joints)
        self.truth = truth_series(self.messages["truth"], count, self.robot.hand_frame)
        self.trace = trace_series(self.messages["trace"], count)

    def bytes(self) -> dict[str, list[bytes]]:
        return {topic: [encode(message) for message in messages] for topic, messages in self.messages.items()}


@pytest.fixture(scope="module")
def played() -> dict[str, Played]:
    return {}


def play(played: dict[str, Played], name: str) -> Played:
    if name not in played:
        played[name] = Played(load(name))
    return played[name]


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_loop_runs_to_its_end_without_a_complaint(played: dict[str, Played], name: str) -> None:
    it = play(played, name)
    states, commands = it.messages["state"], it.messages["command"]
    assert len(states) == len(commands) == it.run.cycles
    assert [(event.kind, event.text) for event in it.messages["event"] if event.severity != "info"] == []
    assert {trace.qp_status for trace in it.messages["trace"]} == {"solved"}
    # Every command is latched, at the SYNC that the robot's delay says.
    delay = it.robot.command_delay_cycles
    assert [state.applied.sequence for state in states[delay:]] == list(range(len(states) - delay))


@pytest.mark.parametrize("name", SCENARIOS)
def test_measured_is_true_within_a_count(played: dict[str, Played], name: str) -> None:
    """Directions, zero offsets, node ids and the order of the joints all come out where they went in."""
    it = play(played, name)
    count = [2.0 * np.pi / (joint.encoder_counts * joint.gear_ratio) for joint in it.robot.joints]
    measured = np.array([state.position_measured for state in it.messages["state"]])
    assert (np.abs(measured - it.truth.position[: len(measured)]) <= 0.51 * np.array(count)).all()


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_postures_are_reached(played: dict[str, Played], name: str) -> None:
    it = play(played, name)
    end = 0.0
    for phase in it.run.scenario.controller.phases:
        end += phase.duration_s
        if phase.posture:
            k = round(end * it.robot.rate_hz) - 1
            reached = dict(zip(it.robot.joint_names, it.truth.position[k], strict=True))
            for joint, angle in phase.posture.items():
                assert reached[joint] == pytest.approx(angle, abs=HALF_DEGREE), (phase.name, joint)


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_run_repeats_bit_for_bit_and_another_seed_does_not(name: str) -> None:
    first, second, other = (Played(load(name, duration_s=0.1, seed=seed)).bytes() for seed in (1, 1, 2))
    assert first == second
    assert first["truth"] != other["truth"]


def test_position_drives_report_no_torque_and_servos_and_torque_drives_do(played: dict[str, Played]) -> None:
    assert play(played, "stilt").messages["state"][-1].motor_torque_measured is None
    for name in ("feather", "crane"):
        torque = np.array([state.motor_torque_measured for state in play(played, name).messages["state"][1:]])
        assert np.abs(torque).max() > 1.0


def test_servos_stay_within_their_torque_limit_and_take_it_every_cycle(played: dict[str, Played]) -> None:
    it = play(played, "feather")
    limits = np.array([joint.torque_limit for joint in it.robot.joints])
    applied = [state.applied for state in it.messages["state"]]
    servo = [each for each in applied if each.mode is ControlMode.SERVO]
    assert len(servo) == round(1.1 * it.robot.rate_hz)
    assert all(each.torque_limit == tuple(limits) for each in servo)
    assert (np.abs(it.truth.motor_torque_substeps[1:]) <= limits).all()


def test_foot_sensor_reads_the_weight_beyond_it(played: dict[str, Played]) -> None:
    it = play(played, "stilt")
    state, truth = it.messages["state"][-1], it.messages["truth"][len(it.messages["state"]) - 1]
    (wrench,) = state.wrenches
    w, x, y, z = truth.frames["sole"].orientation_to_world
    to_world = pin.Quaternion(w, x, y, z).matrix()
    error = it.run.scenario.plant.mass_error
    force = to_world @ np.array(wrench.force_in_sensor)
    assert force[:2] == pytest.approx([0.0, 0.0], abs=0.05)
    assert min(abs(force[2] - (1.0 + sign * error) * G) for sign in (-1, 1)) < 0.05  # the sole weighs 1 kg
    # It lies 80 mm along the sole: the moment about the sensor is that lever's.
    lever = np.cross([0.08, 0.0, 0.0], wrench.force_in_sensor)
    assert wrench.torque_in_sensor == pytest.approx(lever, abs=0.01)


def test_imu_reads_gravity_in_its_tilted_frame(played: dict[str, Played]) -> None:
    (imu,) = play(played, "stilt").messages["state"][-1].imus
    tilt = 0.3
    assert imu.acceleration_in_imu == pytest.approx([-G * np.sin(tilt), 0.0, G * np.cos(tilt)], abs=2**-8)
    assert imu.angular_velocity_in_imu == (0.0, 0.0, 0.0)
    assert imu.orientation_imu_to_world == pytest.approx([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0], abs=1e-4)


def test_torque_robot_switches_without_a_jump_and_follows_the_path(played: dict[str, Played]) -> None:
    it = play(played, "crane")
    limits = np.array([joint.torque_limit for joint in it.robot.joints])
    to_torque, to_position = mode_changes(it.truth, limits)
    assert (to_torque.to_mode, to_position.to_mode) == (10, 8)
    for change in (to_torque, to_position):
        assert change.largest_step <= 0.01
    assert max(to_torque.deviation_rad) <= HALF_DEGREE
    errors = tracking_error(it.trace, it.truth)
    assert len(errors) == round(1.2 * it.robot.rate_hz)
    assert np.sqrt(np.mean(errors**2)) < 5e-3


def test_the_transition_experiment_takes_any_torque_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transition, "RANGE_SHARES", {"middle": 0.5})
    result = transition.run(ExperimentRequest(0, {"robot": str(ROBOTS / "crane.yaml")}, None, False))
    assert result.robot == "crane"
    assert [bar.name for bar in result.bars if not bar.holds] == []
