"""leg6: drives as its file says they are, estimates that are the plant's torques, torque control from end to end."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import yaml

from controller_service.errors import ControllerError, StateError
from controller_service.model import RobotModel
from controller_service.motion_sensing import LONGEST_HOLD
from deploy.inprocess import InProcess
from deploy.series import TraceSeries, TruthSeries, trace_series, truth_series
from plant_service.sensor_device import ForceTorqueDevice, ImuDevice
from schemas.base import Model
from schemas.bus_load import cycle_plan
from schemas.load import Run, load_robot, load_run
from schemas.messages import Event, HalStatus, JointCommand
from schemas.scenario import Friction

Array = npt.NDArray[np.float64]

ROBOT = load_robot("leg6")
JOINTS = ROBOT.description.joints
LIMITS = np.array([joint.torque_limit for joint in JOINTS])
GEAR_FRICTION = Friction().viscous * 160.0**2
"""[N·m·s/rad] at the joint."""
T = ROBOT.description.period_s


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
def test_limits_lie_inside_the_stops_of_the_urdf(joint: Any) -> None:
    limit = next(
        element.find("limit").attrib
        for element in ElementTree.fromstring(ROBOT.urdf).findall("joint")
        if element.get("name") == joint.name
    )
    assert float(limit["lower"]) + 0.049 < joint.position_min < joint.position_max < float(limit["upper"]) - 0.049


def test_the_position_loops_are_well_damped() -> None:
    """The figures of the robot file: (k_d + v) / (2 √(k_p M)) on the stretched leg."""
    posture = np.array([0.05 if joint.name == "R_KNEE" else 0.0 for joint in JOINTS])
    mass = RobotModel(ROBOT).configure(posture, np.zeros(6)).mass.diagonal()
    assert mass == pytest.approx([3.73, 3.71, 0.67, 1.56, 0.39, 0.40], abs=0.006)
    stiffness = np.array([joint.drive.position_gain for joint in JOINTS])
    damping = np.array([joint.drive.velocity_gain for joint in JOINTS]) + GEAR_FRICTION
    ratio = damping / (2.0 * np.sqrt(stiffness * mass))
    assert ((ratio > 0.635) & (ratio < 0.655)).all()


def true_motors(torque_scale: float) -> dict[str, dict[str, float]]:
    """k_τ = 1/(k_p s), k_v = (k_d + v/s)/k_p of the drives as they are described, but for the scale s of the torque."""
    return {
        joint.name: {
            "torque_gain": 1.0 / (joint.drive.position_gain * torque_scale),
            "velocity_gain": (joint.drive.velocity_gain + GEAR_FRICTION / torque_scale) / joint.drive.position_gain,
        }
        for joint in JOINTS
    }


def test_the_motors_that_come_with_it_are_its_drives_and_rather_too_weak() -> None:
    """Identified so that the offset is seldom too large: below the true k_τ of torque scale 0.9, but not by much."""
    motors = yaml.safe_load((Path(__file__).parents[2] / "deploy" / "motors" / "leg6.yaml").read_text())["motors"]
    assert list(motors) == list(ROBOT.description.joint_names)
    for name, true in true_motors(0.9).items():
        assert 0.75 < motors[name]["torque_gain"] / true["torque_gain"] < 1.0, name
        assert 0.95 < motors[name]["velocity_gain"] / true["velocity_gain"] < 1.05, name


def test_the_buses_carry_a_cycle_of_a_millisecond() -> None:
    assert ROBOT.description.rate_hz == 1000
    assert ROBOT.description.command_delay_cycles == 2
    assert cycle_plan(ROBOT.description).fits


START = {"R_HIP_P": -0.25, "R_KNEE": 0.5, "R_ANKLE_P": -0.25}
NOISE = {"force": 0.3, "torque": 0.01, "angular_velocity": 0.002, "acceleration": 0.02}
PARTS = {"motors_from": "leg6", "sensor": "ankle", "imu": "base"}


def load(
    directory: Path,
    phases: list[dict[str, Any]],
    plant: dict[str, Any] | None = None,
    overrides: dict[str, Any] | None = None,
    **position_torque: Any,
) -> Run:
    scenario = {
        "name": "leg",
        "robot": "leg6",
        "duration_s": sum(phase["duration_s"] for phase in phases),
        "plant": {"initial_posture": START, "noise": NOISE} | (plant or {}),
        "controller": {"position_torque": PARTS | position_torque, "phases": phases},
    }
    path = directory / "leg.yaml"
    path.write_text(yaml.safe_dump(scenario))
    return load_run(str(path), overrides)


class Played:
    """A run in one process, step by step, with its messages."""

    def __init__(self, run: Run) -> None:
        self.messages: dict[str, list[Any]] = {}
        self.process = InProcess(run, self._keep)
        self.process.boot()

    def _keep(self, topic: str, message: Model) -> None:
        self.messages.setdefault(topic, []).append(message)

    def to(self, sequence: int) -> Played:
        while self.process.sequence < sequence:
            self.process.step()
        return self

    def alone(self, cycles: int) -> None:
        """Go on as the HAL does when the controller has died within a cycle: it holds."""
        process = self.process
        process.master.core.stop("the controller is gone")
        for _ in range(cycles):
            process.master.apply(None)
            process.sequence += 1
            process.master.sync(process.sequence)
            self._keep("state", process.master.gather(process.sequence, 0.0))
            self._keep("truth", process.plant.truth())
            process.plant.advance()

    @property
    def trace(self) -> TraceSeries:
        return trace_series(self.messages["trace"], 6)

    @property
    def truth(self) -> TruthSeries:
        return truth_series(self.messages["truth"], 6, ROBOT.description.hand_frame)

    @property
    def events(self) -> list[Event]:
        return self.messages.get("event", [])


# Estimates against the truth

SWING = {
    "R_HIP_P": (0.15, 0.5),
    "R_HIP_R": (0.08, 0.4),
    "R_HIP_Y": (0.1, 0.6),
    "R_KNEE": (0.25, 0.7),
    "R_ANKLE_R": (0.15, 0.8),
    "R_ANKLE_P": (0.2, 0.9),
}
SINES = {
    "joints": {name: {"amplitude": size, "frequency_hz": rate} for name, (size, rate) in SWING.items()},
    "fade_s": 0.6,
}
MOVING = [
    {"name": "still", "mode": "position", "duration_s": 0.2},
    {"name": "move", "mode": "position", "duration_s": 2.5, "joint_sines": SINES},
]
PUSH = {
    "kind": "push",
    "name": "push",
    "link": "R_ANKLE_P_S",
    "force_in_world": [20, 10, 40],
    "start_s": 0.8,
    "duration_s": 1.2,
    "shape": "half_sine",
}
MODEL_IS_TRUE = {
    "noise": {},
    "mass_error": 0.0,
    "torque_scale": 1.0,
    "friction": {"coulomb": 0.0, "breakaway": 0.0},
    "world": {"events": [PUSH]},
}


def fine_sensors(counts: int | None = None) -> dict[str, Any]:
    """Overrides: as many encoder counts as 31 bits hold over the range, or as given; a finer force/torque sensor."""
    fine: dict[str, Any] = {
        "robot.force_torque_sensors.0.force_resolution": 150.0 / 32767,
        "robot.force_torque_sensors.0.torque_resolution": 20.0 / 32767,
    }
    for index, joint in enumerate(JOINTS):
        turns = max(abs(joint.position_min), abs(joint.position_max)) * joint.gear_ratio / (2.0 * np.pi)
        fine[f"robot.joints.{index}.encoder_counts"] = counts or int(0.95 * 2**30 / turns)
    return fine


def estimate_errors(played: Played, delay_s: float) -> Array:
    """(K, 6) share of the torque limit: the estimate less the truth of a time before."""
    trace, truth = played.trace, played.truth
    times = trace.time_s[300:]
    then = [np.interp(times - delay_s, truth.time_s[1:], truth.joint_torque[1:, joint]) for joint in range(6)]
    return np.asarray((trace.estimated.torque[300:] - np.transpose(then)) / LIMITS)


def root_mean_square(errors: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


@functools.cache
def moving(estimator: str, dead_zone: float | None, directory: Path) -> Played:
    """The motion and the push; with a dead zone of None everything as it comes, else a true model and fine sensors."""
    if dead_zone is None:
        run = load(directory, MOVING, {"world": {"events": [PUSH]}}, estimator=estimator)
    else:
        counts = 2**18 if estimator == "kalman" else None
        plant = MODEL_IS_TRUE | {"dead_zone_scale": dead_zone}
        run = load(directory, MOVING, plant, fine_sensors(counts), estimator=estimator, motors=true_motors(1.0))
    return Played(run).to(run.cycles)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("leg6")


@pytest.mark.parametrize("estimator", ["savitzky_golay", "kalman"])
def test_with_a_true_model_and_clean_sensors_the_estimate_is_the_true_torque(directory: Path, estimator: str) -> None:
    """Within 0.5 % of the range at every instant, at the known delay, through motion and push."""
    played = moving(estimator, 0.0, directory)
    delay_s = played.trace.estimated.delay_s
    assert delay_s == pytest.approx(0.0395 if estimator == "savitzky_golay" else 0.0)
    assert np.abs(played.truth.joint_torque[300:]).max() > 15.0
    assert np.abs(estimate_errors(played, delay_s)).max() < 0.005
    # The delay is what is left out of these figures, and it is the known one.
    later, sooner = (root_mean_square(estimate_errors(played, delay_s + by)).mean() for by in (0.005, -0.005))
    assert root_mean_square(estimate_errors(played, delay_s)).mean() < min(later, sooner)


def test_what_the_dead_zone_does_faster_than_the_window_is_smoothed(directory: Path) -> None:
    """Where a torque turns round it rushes through the drive's dead zone; on average that changes little."""
    errors = estimate_errors(moving("savitzky_golay", 1.0, directory), 0.0395)
    assert root_mean_square(errors).max() < 0.0015
    assert np.abs(errors).max() < 0.011


@pytest.mark.parametrize(
    ("estimator", "error", "largest"), [("savitzky_golay", 0.0065, 0.045), ("kalman", 0.0135, 0.09)]
)
def test_with_noise_counts_stiction_and_wrong_masses_it_is_near(
    directory: Path, estimator: str, error: float, largest: float
) -> None:
    played = moving(estimator, None, directory)
    errors = estimate_errors(played, played.trace.estimated.delay_s)
    assert root_mean_square(errors).max() < error
    assert np.abs(errors).max() < largest


# Torque control

CHANGES = [
    {"name": "settle", "mode": "position", "duration_s": 0.3},
    {
        "name": "torque",
        "mode": "position",
        "duration_s": 1.0,
        "torque_control": True,
        "joint_sines": SINES | {"fade_s": 0.3},
    },
    {"name": "back", "mode": "position", "duration_s": 0.3},
]
UP, DOWN = 300, 1300


@pytest.mark.parametrize("estimator", ["savitzky_golay", "kalman"])
@pytest.mark.parametrize("desired", ["inverse_dynamics", "qp"])
def test_it_runs_a_second_between_two_changes_without_a_word_or_a_step(
    directory: Path, estimator: str, desired: str
) -> None:
    """Commands at a change differ no more than around it; the motors' torque does not step."""
    run = load(directory, CHANGES, estimator=estimator, desired=desired)
    played = Played(run).to(run.cycles)
    assert played.events == []
    commands = np.array([command.position for command in played.messages["command"]])
    steps = np.abs(np.diff(commands, axis=0))
    torque = played.truth.motor_torque_substeps
    jumps = np.abs(np.diff(torque[1:].reshape(-1, 6), axis=0)) / LIMITS
    substeps = torque.shape[1]
    for change in (UP, DOWN):
        around = np.r_[change - 100 : change - 2, change + 2 : change + 100]
        assert (steps[change - 2 : change + 2].max(axis=0) <= 1.1 * steps[around].max(axis=0) + 1e-7).all()
        assert jumps[substeps * (change - 1) : substeps * (change + 8)].max() < 5e-3
    controlled = played.trace.offset.position_desired[UP:DOWN]
    assert np.isfinite(controlled).all()
    if desired == "inverse_dynamics":
        error = controlled - played.truth.position[UP:DOWN]
        assert np.abs(error).max() < 0.01


def test_missed_states_do_not_shake_it(directory: Path) -> None:
    """One of three states never reaches the controller: the HAL goes on with the last target."""
    run = load(directory, CHANGES)
    played = Played(run)
    process, step = played.process, played.process.controller.step
    last: list[JointCommand] = []

    def deaf(state: Any) -> Any:
        if state.sequence % 3 == 1 and last:
            command = last[-1].model_copy(update={"sequence": state.sequence, "time_ns": state.time_ns})
            return command, played.messages["trace"][-1]
        answer = step(state)
        last.append(answer[0])
        return answer

    process.controller.step = deaf  # type: ignore[method-assign]  # a controller that misses states
    played.to(run.cycles)
    assert [event for event in played.events if event.severity != "info"] == []
    heard = [k for k in range(UP + 100, DOWN) if k % 3 != 1]
    error = played.trace.offset.position_desired[heard] - played.truth.position[heard]
    assert np.abs(error).max() < 0.02


THROWN = PUSH | {"name": "throw", "force_in_world": [900, 0, 0], "start_s": 0.4, "duration_s": 0.6}
CONTROLLED = [
    {"name": "settle", "mode": "position", "duration_s": 0.2},
    {"name": "torque", "mode": "position", "duration_s": 2.0, "torque_control": True},
]


def test_a_joint_that_is_thrown_ends_it_and_the_hal_holds(directory: Path) -> None:
    """Too much for the drive: limits are told by name, the controller gives up, the drives keep their last target."""
    played = Played(load(directory, CONTROLLED, {"world": {"events": [THROWN]}}))
    with pytest.raises(ControllerError, match=r"R_HIP_P moves at -7\.\d+ rad/s under torque control, its limit is 6"):
        played.to(2000)
    told = {event.text.split(": torque")[0] for event in played.events if event.kind == "command_limited"}
    assert "R_HIP_P: offset limit" in told
    thrown_at = played.process.sequence
    played.alone(1500)
    states = played.messages["state"]
    assert states[-1].status is HalStatus.SAFE_STOP
    targets = np.array([state.applied.position for state in states[thrown_at + 10 :]])
    assert np.ptp(targets, axis=0).max() < 1e-9
    assert np.abs(played.truth.velocity[-1]).max() < 0.02


@pytest.mark.parametrize(("device", "name"), [(ForceTorqueDevice, "ankle"), (ImuDevice, "base")])
def test_a_sensor_that_falls_silent_ends_it_and_the_hal_holds(
    directory: Path, monkeypatch: pytest.MonkeyPatch, device: type, name: str
) -> None:
    played = Played(load(directory, CONTROLLED)).to(500)
    monkeypatch.setattr(device, "sync", lambda *_: [])
    with pytest.raises(StateError, match=f"sensor {name} has had no new reading for {LONGEST_HOLD + 1} cycles"):
        played.to(520)
    assert played.process.sequence == 500 + LONGEST_HOLD
    there = played.truth.position[-1]
    played.alone(400)
    assert played.messages["state"][-1].status is HalStatus.SAFE_STOP
    assert np.abs(played.truth.position[-1] - there).max() < np.radians(0.5)


def test_a_sensor_that_never_speaks_leaves_it_in_position_control(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No torque is ever computed without the foot's weight; the one event says why."""
    monkeypatch.setattr(ForceTorqueDevice, "sync", lambda *_: [])
    played = Played(load(directory, CONTROLLED)).to(400)
    (told,) = [event for event in played.events if event.service == "controller"]
    assert (told.kind, told.sequence) == ("torque_control_waits", 200)
    assert np.isnan(played.trace.offset.torque).all()
    assert np.isnan(played.trace.estimated.torque).all()


def test_torque_control_from_the_first_state_waits_for_a_window(directory: Path) -> None:
    run = load(directory, [{"name": "torque", "mode": "position", "duration_s": 0.4, "torque_control": True}])
    played = Played(run).to(run.cycles)
    given = np.isfinite(played.trace.offset.torque[:, 0])
    assert not given[:79].any()
    assert given[79:].all()
    assert [event.kind for event in played.events] == ["torque_control_waits"]


@pytest.mark.nightly
@pytest.mark.parametrize("scenario", ["leg6-stairs", "leg6-force-sine"])
def test_the_scenarios_run_to_their_end(scenario: str) -> None:
    run = load_run(scenario)
    played = Played(run).to(run.cycles)
    assert [event.text for event in played.events if event.severity == "error"] == []
