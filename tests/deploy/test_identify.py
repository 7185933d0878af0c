from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from controller_service.motor_samples import Fault, IdentificationError, MotorSamples
from deploy.cli import main
from deploy.errors import ReportError, UsageError
from deploy.identify import FitMethod, IdentifyError, IdentifyOptions, fit_joint, fit_pieces, identify
from deploy.identify_ft import identify_ft
from deploy.motor_data import LIMIT_SHARE, motor_data, read_states, together
from deploy.motor_file import DIGITS, read_payload, rounded, write_motors
from deploy.series import Array, RunSeries
from schemas.control_law import SavitzkyGolayFilter
from schemas.load import load_run
from schemas.messages import Event, RobotState
from tests.deploy.leg_states import (
    COULOMB,
    TORQUE_GAIN,
    VELOCITY_GAIN,
    LegMotion,
    leg_motion,
    leg_run,
    leg_states,
    of_states,
    state,
    write_log,
)

FILTER = SavitzkyGolayFilter()
SHARP = SavitzkyGolayFilter(window=10)
LEAST_SQUARES = IdentifyOptions(FitMethod.LEAST_SQUARES, filter=SHARP)
JOINTS = leg_run().robot.description.joints


@pytest.fixture(scope="module")
def motion() -> LegMotion:
    return leg_motion()


@pytest.fixture(scope="module")
def states(motion: LegMotion) -> list[RobotState]:
    return leg_states(motion)


@pytest.fixture(scope="module")
def series(states: list[RobotState]) -> RunSeries:
    return of_states(leg_run(), states)


@pytest.fixture(scope="module")
def log(states: list[RobotState], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "run.mcap", states)


def event(sequence: int) -> Event:
    return Event(
        sequence=sequence, time_ns=sequence, service="hal", kind="safe_stop", severity="error", text="a drive failed"
    )


def test_samples_are_those_of_the_same_instant(series: RunSeries, motion: LegMotion) -> None:
    data = motor_data(series, SHARP)
    inner = slice(1 + 5, len(motion.time_s) - 5)  # row 0 has no target before it, half a window at both ends
    assert_allclose(data.offset, motion.offset[inner], atol=1e-12)
    assert_allclose(data.velocity, motion.velocity[inner], atol=0.02)
    assert_allclose(data.torque, motion.torque[inner], atol=3.0)


def test_an_exact_drive_is_found_exactly_but_for_the_filter(series: RunSeries) -> None:
    result = identify([series], LEAST_SQUARES)
    assert_allclose([each.fit.torque_gain for each in result.joints], TORQUE_GAIN, rtol=1e-3)
    assert_allclose([each.fit.velocity_gain for each in result.joints], VELOCITY_GAIN, rtol=1e-3)


def test_a_target_taken_one_cycle_late_would_be_seen(series: RunSeries) -> None:
    applied = series.state.position_applied
    late = replace(series, state=replace(series.state, position_applied=np.vstack((applied[:1], applied[:-1]))))
    result = identify([late], LEAST_SQUARES)
    error = [each.fit.velocity_gain for each in result.joints] - VELOCITY_GAIN
    assert_allclose(error, -1e-3, atol=2e-4)  # a cycle of 1 ms at q̇ is q̇ · 1 ms


def test_coulomb_friction_is_found_with_the_rest() -> None:
    states = leg_states(leg_motion(coulomb=COULOMB))
    result = identify([of_states(leg_run(), states)], replace(LEAST_SQUARES, coulomb=True))
    assert_allclose([each.fit.coulomb for each in result.joints], COULOMB, rtol=0.05)
    assert_allclose([each.fit.torque_gain for each in result.joints], TORQUE_GAIN, rtol=0.03)
    assert_allclose([each.fit.velocity_gain for each in result.joints], VELOCITY_GAIN, rtol=0.03)


@pytest.mark.parametrize("method", [FitMethod.ASYMMETRIC, FitMethod.QP, FitMethod.TWO_STAGE])
def test_every_method_finds_an_exact_drive(series: RunSeries, method: FitMethod) -> None:
    result = identify([series], replace(LEAST_SQUARES, method=method, still_velocity=0.003))
    assert_allclose([each.fit.torque_gain for each in result.joints], TORQUE_GAIN, rtol=0.02)
    assert_allclose([each.fit.velocity_gain for each in result.joints], VELOCITY_GAIN, rtol=0.02)
    assert all(each.fit.samples == 1000 for each in result.joints) == (method is FitMethod.QP)


def test_nothing_is_taken_from_beside_a_lost_cycle(states: list[RobotState]) -> None:
    lost = of_states(leg_run(), states[:1000] + states[1001:2000])
    data = motor_data(lost, FILTER)
    assert data.rows == 1999
    # Rows 0 and 1001 have no row before them; half a window of 40 falls away at four ends
    assert data.left_out == {
        "without a position target, or beside a lost cycle": 2,
        "within half a window of these or of the ends": 160,
    }
    assert len(data.offset) == 1999 - 162


def test_nothing_is_taken_from_a_stretch_in_torque_mode(states: list[RobotState]) -> None:
    free = [state(k, np.zeros(6), np.zeros(6), None) for k in range(900, 1100)]
    data = motor_data(of_states(leg_run(), states[:900] + free + states[1100:2000]), FILTER)
    whole = motor_data(of_states(leg_run(), states[:2000]), FILTER)
    assert len(whole.offset) - len(data.offset) == 200 + 1 + 2 * 40
    kept = np.concatenate((whole.offset[: 900 - 81], whole.offset[-(900 - 81) :]))
    assert_allclose(data.offset, kept, atol=1e-15)


def test_nothing_is_taken_from_after_a_safe_stop(states: list[RobotState]) -> None:
    data = motor_data(of_states(leg_run(), states[:2000], events=[event(1500)]), FILTER)
    assert data.left_out["after a safe stop"] == 500
    assert len(data.offset) == 1500 - 1 - 80


def test_phases_can_be_chosen(series: RunSeries) -> None:
    count = len(series.state.sequence)
    phase = tuple("sines" if k < 3000 else "rest" for k in range(count))
    trace = replace(series.trace, sequence=series.state.sequence, phase=phase)
    chosen = motor_data(replace(series, trace=trace), FILTER, phases=("rest",))
    assert chosen.left_out["in other phases"] == 2999  # row 0 is out already
    assert len(chosen.offset) == count - 3000 - 80
    with pytest.raises(UsageError, match="--phase walk: no log has it; there are rest, settle, sines"):
        identify([series], replace(LEAST_SQUARES, phases=("walk",)))


def test_what_a_drive_may_have_cut_off_is_left_out(series: RunSeries) -> None:
    data = motor_data(series, SHARP)
    for index, joint in enumerate(JOINTS):
        samples, drive = data.of(index), joint.drive
        effort = drive.position_gain * samples.offset - drive.velocity_gain * samples.velocity
        assert np.abs(effort).max() - drive.dead_zone < LIMIT_SHARE * joint.torque_limit
        assert len(samples) == len(data.offset) - data.limited[:, index].sum()
    assert data.limited.any()
    assert not data.limited.all(axis=0).any()


def test_logs_add_up(states: list[RobotState]) -> None:
    parts = [motor_data(of_states(leg_run(), states[:4000]), FILTER) for _ in range(2)]
    both = together(parts)
    assert len(both.offset) == 2 * len(parts[0].offset)
    assert both.rows == 8000
    assert both.left_out == {reason: 2 * count for reason, count in parts[0].left_out.items()}


def test_logs_of_different_robots_are_refused(series: RunSeries) -> None:
    other = replace(series, run=load_run("leg6-high-velocity", {"robot.joints.R_KNEE.torque_limit": 200}))
    with pytest.raises(UsageError, match="different robots"):
        identify([series, other], LEAST_SQUARES)
    with pytest.raises(UsageError, match="no log"):
        identify([], LEAST_SQUARES)


def test_a_joint_that_is_not_moved_is_refused_by_name(states: list[RobotState]) -> None:
    with pytest.raises(IdentificationError, match=r"R_\w+ in motion: 0 samples") as caught:
        identify([of_states(leg_run(), states[6000:])], IdentifyOptions())
    assert caught.value.reason is Fault.TOO_FEW


def test_a_joint_that_is_not_loaded_is_refused_by_name(states: list[RobotState]) -> None:
    with pytest.raises(IdentificationError, match=r"R_\w+"):
        identify([of_states(leg_run(), states[:3000])], IdentifyOptions())


def test_a_log_too_short_for_the_window_is_refused(states: list[RobotState]) -> None:
    with pytest.raises(IdentificationError, match="0 samples") as caught:
        identify([of_states(leg_run(), states[:60])], IdentifyOptions())
    assert caught.value.joint == "R_HIP_P"


def made_samples(torque_gain: float, velocity_gain: float, coulomb: float = 0.0) -> MotorSamples:
    phase = np.linspace(0.0, 40.0, 4000)
    torque, velocity = 120.0 * np.sin(phase), 3.0 * np.cos(0.7 * phase)
    offset = torque_gain * torque + velocity_gain * velocity + coulomb * np.sign(velocity)
    return MotorSamples(offset, torque, velocity)


@pytest.mark.parametrize(
    ("gains", "name"), [((-5e-5, 0.02), "k_τ"), ((5e-5, -0.02), "k_v"), ((5e-5, 0.02, -1e-3), "k_c")]
)
def test_a_gain_of_the_wrong_sign_is_refused(gains: tuple[float, ...], name: str) -> None:
    options = IdentifyOptions(FitMethod.LEAST_SQUARES, coulomb=True)
    with pytest.raises(IdentifyError, match=f"R_HIP_P: {name} comes out as -") as caught:
        fit_joint(JOINTS[0], made_samples(*gains), options)
    assert "Check the signs" in str(caught.value)


def dead_zone_samples() -> MotorSamples:
    """A drive with a dead zone, at rest but for the sign of its creep."""
    torque = 100.0 * np.sin(np.linspace(0.0, 60.0, 6001))
    velocity = 1e-3 * np.where(np.arange(6001) % 2, 1.0, -1.0)
    offset = 5e-5 * (torque + 3.0 * np.tanh(torque / 2.0))
    return MotorSamples(offset, torque, velocity)


def test_a_piecewise_model_with_bends_is_found() -> None:
    pieces = fit_pieces(JOINTS[0], dead_zone_samples(), IdentifyOptions(slip_velocity=0.0))
    assert pieces.positive.converged
    assert pieces.negative.converged
    lines = pieces.positive.lines
    assert lines is not None
    assert_allclose((lines.slopes[0], lines.slopes[2]), 5e-5, rtol=0.02)
    assert lines.slopes[1] > 1.5 * lines.slopes[0]


def test_a_joint_that_sticks_has_gains_but_no_piecewise_model(series: RunSeries) -> None:
    result = identify([series], replace(LEAST_SQUARES, piecewise=True, slip_velocity=0.04))
    for each in result.joints:
        assert each.piecewise is not None
        assert each.piecewise.positive.lines is None
        assert each.piecewise.positive.samples < 50
        piecewise = each.as_json()["piecewise"]["positive"]
        assert piecewise["slopes"] is piecewise["rms_residual"] is None


def test_a_scenario_loads_the_written_motors(series: RunSeries, tmp_path: Path) -> None:
    result = identify([series], replace(LEAST_SQUARES, coulomb=False), names=["a/run.mcap"])
    path = tmp_path / "motors.yaml"
    write_motors(result, path)
    header = path.read_text().splitlines()[:3]
    assert "`cosim identify motors` from a/run.mcap" in header[0]
    assert "least-squares" in header[1]
    run = load_run("leg6-stairs", {"controller.position_torque.motors_from": str(path)})
    config = run.scenario.controller.position_torque
    assert config is not None
    assert list(config.motors) == list(run.robot.description.joint_names)
    for each in result.joints:
        assert config.motors[each.joint].torque_gain == pytest.approx(each.fit.torque_gain, rel=10.0 ** (1 - DIGITS))
        assert config.motors[each.joint].velocity_gain == pytest.approx(
            each.fit.velocity_gain, rel=10.0 ** (1 - DIGITS)
        )


def test_motors_that_cannot_be_written_are_one_line(series: RunSeries, tmp_path: Path) -> None:
    result = identify([series], LEAST_SQUARES)
    with pytest.raises(ReportError, match="cannot be written"):
        write_motors(result, tmp_path / "no" / "motors.yaml")


@pytest.mark.parametrize("value", [1.23456789e-5, 0.0, -17.6543219, 3e7])
def test_rounding_keeps_digits(value: float) -> None:
    assert rounded(value) == pytest.approx(value, rel=10.0 ** (1 - DIGITS))
    assert len(f"{rounded(value):g}".replace("-", "").split("e")[0].replace(".", "").strip("0")) <= DIGITS + 1


def test_the_packaged_motors_are_a_cautious_model_of_the_legs_drives() -> None:
    run = load_run("leg6-stairs")
    config = run.scenario.controller.position_torque
    assert config is not None
    viscous, scale = run.scenario.plant.friction.viscous, run.scenario.plant.torque_scale
    for joint in run.robot.description.joints:
        motor, drive = config.motors[joint.name], joint.drive
        true_torque = 1.0 / (drive.position_gain * scale)
        true_velocity = (drive.velocity_gain + viscous * joint.gear_ratio**2 / scale) / drive.position_gain
        assert 0.7 * true_torque < motor.torque_gain < true_torque
        assert motor.velocity_gain == pytest.approx(true_velocity, rel=0.04)


def test_the_command_prints_json_and_writes_the_file(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "motors.yaml"
    arguments = ["identify", "motors", str(log), "--method", "least-squares", "--window", "10", "--out", str(out)]
    assert main([*arguments, "--piecewise", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed["joints"]) == list(leg_run().robot.description.joint_names)
    knee = printed["joints"]["R_KNEE"]
    assert knee["velocity_gain"] == pytest.approx(VELOCITY_GAIN[3], rel=1e-3)
    assert set(knee["piecewise"]) == {"positive", "negative"}
    written = yaml.safe_load(out.read_text())["motors"]["R_KNEE"]
    assert written == {name: rounded(knee[name]) for name in ("torque_gain", "velocity_gain")}
    assert main(arguments) == 0
    assert "R_ANKLE_P" in capsys.readouterr().out


def test_the_command_draws_every_joint(log: Path, tmp_path: Path) -> None:
    plots = tmp_path / "plots"
    assert main(["identify", "motors", str(log), "--still-velocity", "0.02", "--plots", str(plots)]) == 0
    names = {path.name for path in plots.iterdir() if path.suffix == ".png"}
    assert names == {f"{joint.name}-{kind}.png" for joint in JOINTS for kind in ("torque", "friction")}


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["motors", "nowhere.mcap"], 2, "no log at nowhere.mcap"),
        (["ft", "nowhere.mcap"], 2, "no log at nowhere.mcap"),
        (["motors", "LOG", "--method", "guess"], 2, "--method guess: expected one of least-squares"),
        (["motors", "LOG", "--phase", "walk"], 2, "--phase walk: no log has it"),
        (["motors", "LOG", "--payload", "none.yaml"], 2, "--payload none.yaml: cannot be read"),
        (["motors", "LOG", "--window", "9000"], 1, "R_HIP_P at rest: 0 samples"),
        (["ft", "LOG", "--sensor", "wrist"], 2, "--sensor wrist: robot leg6 has no such force/torque sensor"),
        (["ft", "LOG"], 1, "force/torque calibration"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    arguments: list[str], code: int, says: str, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", *(str(log) if each == "LOG" else each for each in arguments)]) == code
    message = capsys.readouterr().err
    assert says in message
    assert len(message.strip().splitlines()) == 1


def test_states_alone_are_the_series_that_a_whole_reading_gives(log: Path, series: RunSeries) -> None:
    read = read_states(log)
    assert_allclose(read.state.position_applied, series.state.position_applied)
    assert read.complete
    assert len(read_states(log, phases=True).trace.sequence) == 0  # this log has no controller


MASS, CENTRE_OF_MASS = 1.65, np.array([0.03, 0.01, -0.07])
FORCE_OFFSET, TORQUE_OFFSET = np.array([0.5, -1.0, 1.5]), np.array([0.06, -0.04, -0.1])
POSES = (
    (0.0, 0.0, 0.0, 0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 2.2, 0.0, 0.6), (0.0, -0.6, 0.0, 1.2, -0.5, 0.0),
    (-1.2, -0.2, 0.0, 0.2, 0.0, -1.0), (-0.6, 0.2, 0.0, 0.8, 0.65, 0.2),
)  # fmt: skip


def resting_log(path: Path, poses: tuple[tuple[float, ...], ...] = POSES) -> Path:
    """The leg for 0.6 s in each pose, another foot beyond the sensor than the URDF's, and between them in motion."""
    from controller_service.model import RobotModel

    model, gravity = RobotModel(leg_run().robot), np.array((0.0, 0.0, -9.81))
    states: list[RobotState] = []

    def add(position: Array) -> None:
        g = gravity @ model.pose(position, "R_ANKLE_P_S")[1]
        wrench = np.concatenate((FORCE_OFFSET - MASS * g, TORQUE_OFFSET + np.cross(g, MASS * CENTRE_OF_MASS)))
        states.append(state(len(states), position, wrench, position))

    before = np.array(poses[0])
    for pose in poses:
        for share in np.linspace(0.0, 1.0, 50):
            add(before + share * (np.array(pose) - before))
        for _ in range(600):
            add(np.array(pose))
        before = np.array(pose)
    return write_log(path, states)


def test_the_body_beyond_a_sensor_is_found_from_poses_at_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = resting_log(tmp_path / "run.mcap"), tmp_path / "payload.yaml"
    result = identify_ft([path], "ankle")
    assert len(result.poses) == len(POSES)
    assert result.gravity_from == "base"
    assert result.fit.payload.mass == pytest.approx(MASS, rel=1e-9)
    assert_allclose(result.fit.payload.centre_of_mass, CENTRE_OF_MASS, atol=1e-9)
    assert_allclose(result.fit.payload.wrench_offset, [*FORCE_OFFSET, *TORQUE_OFFSET], atol=1e-9)
    assert result.difference.mass == pytest.approx(MASS - 1.5, rel=1e-6)
    assert main(["identify", "ft", str(path), "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["payload"]["mass"] == pytest.approx(MASS)
    assert printed["urdf"]["mass"] == pytest.approx(1.5)
    assert main(["identify", "ft", str(path)]) == 0
    assert "1.6500" in capsys.readouterr().out
    payload = read_payload(out)
    assert payload.mass == pytest.approx(MASS, rel=1e-4)
    assert_allclose(payload.first_moment, MASS * CENTRE_OF_MASS, rtol=1e-4)


def test_a_scenario_takes_the_payload_as_it_was_written(tmp_path: Path) -> None:
    path, out = resting_log(tmp_path / "run.mcap"), tmp_path / "payload.yaml"
    assert main(["identify", "ft", str(path), "--out", str(out)]) == 0
    payload = yaml.safe_load(out.read_text())["payload"]
    config = load_run("leg6-stairs", {"controller.position_torque.payload": payload}).scenario.controller
    assert config.position_torque is not None
    assert config.position_torque.payload is not None
    assert config.position_torque.payload.mass == pytest.approx(MASS, rel=1e-4)


def test_poses_that_are_alike_are_refused(tmp_path: Path) -> None:
    path = resting_log(tmp_path / "run.mcap", POSES[:1])
    assert main(["identify", "ft", str(path)]) == 1


def test_a_payload_file_of_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "payload.yaml"
    path.write_text("mass: 1.5\n")
    with pytest.raises(UsageError, match="expected a mapping `payload:`"):
        read_payload(path)
