"""What identification must find on drives whose truth is known, and what the experiment makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from controller_service.model import RobotModel
from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest
from deploy.identify import FitMethod, Identification, IdentifyOptions, identify
from deploy.inprocess import InProcess
from deploy.series import RunSeries
from experiments import identify_leg
from experiments.identify_leg import TrueMotors, qp_newton_difference, table, true_motors
from experiments.leg_runs import COLLECTIONS, identified_motors, plant_overrides
from plant_service.firmware import Firmware
from schemas.base import Model
from schemas.load import load_run
from schemas.messages import RobotState
from schemas.world import Push
from tests.deploy.leg_states import of_states
from tests.experiments.made_up_motors import RUN, made_up_identification

IDEAL: dict[str, Any] = {"plant.dead_zone_scale": 0, "plant.drive_asymmetry": {}, "plant.mass_error": 0}
VISCOUS = {"plant.friction": {"coulomb": 0, "breakaway": 0, "viscous": 0.0005}}
COULOMB = {"plant.friction": {"coulomb": 0.04, "breakaway": 0.04, "viscous": 0.0005}}
SHORT_S = {"leg6-high-torque": 9.8, "leg6-high-velocity": 7.0}
"""The first pose with its three loads, and motion up to about 40 % of the speed limits."""


def recorded(scenario: str, overrides: dict[str, Any]) -> RunSeries:
    """Run a scenario and keep the states alone."""
    run = load_run(scenario, overrides)
    states: list[RobotState] = []

    def sink(_topic: str, message: Model) -> None:
        if isinstance(message, RobotState):
            states.append(message)

    InProcess(run, sink).run()
    return of_states(run, states)


def collections(overrides: dict[str, Any], *, whole: bool) -> list[RunSeries]:
    return [
        recorded(scenario, overrides if whole else {**overrides, "duration_s": SHORT_S[scenario]})
        for scenario in COLLECTIONS.values()
    ]


def check_gains(result: Identification, truth: TrueMotors, tolerance: float) -> None:
    assert_allclose([each.fit.torque_gain for each in result.joints], truth.torque_gain[1], rtol=tolerance)
    assert_allclose([each.fit.velocity_gain for each in result.joints], truth.velocity_gain[1], rtol=tolerance)


def check_viscous(logs: list[RunSeries]) -> None:
    """A drive with viscous friction alone: within 2 %."""
    truth = true_motors(logs[0].run)
    for options in (
        IdentifyOptions(FitMethod.LEAST_SQUARES),
        IdentifyOptions(FitMethod.ASYMMETRIC),
        IdentifyOptions(FitMethod.QP),
        IdentifyOptions(FitMethod.TWO_STAGE, still_velocity=0.005),
    ):
        check_gains(identify(logs, options), truth, 0.02)


def check_coulomb(logs: list[RunSeries]) -> None:
    """A drive with Coulomb friction too, k_c fitted: within 3 %."""
    truth = true_motors(logs[0].run)
    result = identify(logs, IdentifyOptions(FitMethod.LEAST_SQUARES, coulomb=True))
    check_gains(result, truth, 0.03)
    joints = logs[0].run.robot.description.joints
    plant = logs[0].run.scenario.plant
    true_coulomb = [plant.friction.coulomb * joint.gear_ratio for joint in joints] * truth.torque_gain[1]
    assert_allclose([each.fit.coulomb for each in result.joints], true_coulomb, rtol=0.12)


def test_a_drive_with_viscous_friction_alone_is_found_within_2_percent() -> None:
    check_viscous(collections({**IDEAL, **VISCOUS, "plant.torque_scale": 0.9}, whole=False))


def test_coulomb_friction_fitted_too_leaves_the_gains_within_3_percent() -> None:
    check_coulomb(collections({**IDEAL, **COULOMB, "plant.torque_scale": 0.9}, whole=False))


@pytest.mark.nightly
@pytest.mark.parametrize("scale", [0.9, 1.0])
def test_both_laws_hold_on_the_whole_collections(scale: float) -> None:
    check_viscous(collections({**IDEAL, **VISCOUS, "plant.torque_scale": scale}, whole=True))
    check_coulomb(collections({**IDEAL, **COULOMB, "plant.torque_scale": scale}, whole=True))


@pytest.mark.nightly
def test_the_whole_experiment_holds_its_bars_and_writes_its_results(tmp_path: Path) -> None:
    result = identify_leg.run(ExperimentRequest(0, directory=tmp_path))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
    for name in ("table-1.md", "identify-leg.png", "identify-leg.svg", "identify-leg-torque.png"):
        assert (tmp_path / name).stat().st_size > 0
    motors = result.metrics["velocity_gain_s"]
    assert isinstance(motors, dict)
    packaged = load_run("leg6-stairs").scenario.controller.position_torque
    assert packaged is not None
    for joint, model in packaged.motors.items():
        assert model.velocity_gain == pytest.approx(motors[joint], rel=1e-3)


@pytest.mark.nightly
def test_motors_of_a_plant_are_a_value_for_the_controller(tmp_path: Path) -> None:
    request = ExperimentRequest(3, {"plant.torque_scale": 0.85, "controller.lambda": 1.0})
    motors = identified_motors(request, tmp_path)
    run = load_run("leg6-stairs", {"controller.position_torque.motors": motors})
    assert run.scenario.controller.position_torque is not None
    stronger = identified_motors(ExperimentRequest(3, {"plant.torque_scale": 1.0}), tmp_path)
    for joint, model in motors.items():
        assert model["torque_gain"] / stronger[joint]["torque_gain"] == pytest.approx(1.0 / 0.85, rel=0.15)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_true_motors_are_the_law_of_the_plants_drives(sign: float) -> None:
    run = load_run("leg6-high-velocity", {"plant.dead_zone_scale": 0, "plant.friction_error": 0.3, "seed": 4})
    truth, plant, joints = true_motors(run), run.scenario.plant, run.robot.description.joints
    firmware = Firmware(run.robot.description, plant, run.scenario.seed)
    for joint in range(len(joints)):
        firmware.follow_position(joint, 0, 32767)
    firmware.begin_period()
    velocity = sign * np.linspace(0.5, 1.0, len(joints))
    position = np.linspace(-3e-3, 3e-3, len(joints))
    motor = plant.torque_scale * firmware.step(0, position, velocity)
    counts = np.array([joint.encoder_counts * joint.gear_ratio for joint in joints]) / (2.0 * np.pi)
    offset = -np.rint(position * counts) / counts
    # Viscous friction of the seed, from the plant's own model
    from plant_service.model import build

    model = build(run.robot, plant, run.scenario.seed)
    viscous = model.model.dof_damping[model.dof_address]
    row = 2 if sign > 0.0 else 0
    model_offset = truth.torque_gain[row] * (motor - viscous * velocity) + truth.velocity_gain[row] * velocity
    assert_allclose(model_offset, offset, rtol=1e-9, atol=1e-12)


def test_without_asymmetry_both_signs_have_one_truth() -> None:
    truth = true_motors(load_run("leg6-high-velocity", {"plant.drive_asymmetry": {}}))
    assert_allclose(truth.torque_gain, truth.torque_gain[[1, 1, 1]])
    assert_allclose(truth.velocity_gain, truth.velocity_gain[[1, 1, 1]])


def test_pushes_load_every_joint_both_ways_within_what_the_sensor_takes() -> None:
    run = load_run("leg6-high-torque")
    robot, plant = run.robot, run.scenario.plant
    model = RobotModel(robot, ("R_ANKLE_P_S",))
    names = robot.description.joint_names
    limit = np.array([joint.torque_limit for joint in robot.description.joints])
    poses = {"bent": dict(plant.initial_posture)}
    posture = dict(plant.initial_posture)
    for phase in run.scenario.controller.phases:
        posture |= phase.posture
        poses[phase.name] = dict(posture)
    pairs: dict[str, list[Push]] = {}
    for event in plant.world.events:
        assert isinstance(event, Push)
        pairs.setdefault(event.name.rpartition("-")[0], []).append(event)
    shares = []
    for name, pushes in pairs.items():
        pose = poses[name.split("-")[0]]
        now = model.configure(np.array([pose[joint] for joint in names]), np.zeros(6))
        frame = now.frames["R_ANKLE_P_S"]
        wrench = np.zeros(6)
        for push in pushes:
            force = np.array(push.force_in_world)
            wrench += np.concatenate((force, pin.skew(frame.rotation @ np.array(push.point_in_link)) @ force))
        assert np.abs(frame.rotation.T @ wrench[:3]).max() < 1638.0
        assert np.abs(frame.rotation.T @ wrench[3:]).max() < 0.8 * 163.0
        shares.append(frame.jacobian.T @ wrench / limit)
    assert len({(push.start_s, push.duration_s) for pushes in pairs.values() for push in pushes}) == len(pairs)
    assert (np.max(shares, axis=0) > 0.5).all()
    assert (np.min(shares, axis=0) < -0.5).all()
    assert np.abs(shares).max() < 0.7


def test_a_motion_of_the_collections_is_not_the_users() -> None:
    chosen = {"plant.torque_scale": 0.9, "robot.safety.hold_ramp_s": 0.1, "plant.friction.viscous": 0.0}
    others = {"plant.world": {}, "plant.initial_posture.R_KNEE": 1.0, "controller.lambda": 1.0, "duration_s": 3}
    assert plant_overrides({**chosen, **others}) == chosen
    for path, value in others.items():
        with pytest.raises(UsageError, match=f"--set {path}"):
            identify_leg.run(ExperimentRequest(0, {path: value}))


def test_the_result_tells_every_joint_and_every_weight() -> None:
    result = made_up_identification()
    truth = true_motors(RUN)
    outcome = identify_leg._result(ExperimentRequest(7), RUN, result, truth)
    assert outcome.experiment == "identify-leg"
    names = list(RUN.robot.description.joint_names)
    for weight in ("1", "10", "100", "1000", "10000"):
        for kind in ("over_rate", "over_size", "one_stage_over_rate", "one_stage_over_size"):
            values = outcome.metrics[f"{kind}_w{weight}"]
            assert isinstance(values, dict)
            assert list(values) == names
    rate = {weight: outcome.metrics[f"over_rate_w{weight}"] for weight in ("1", "100", "10000")}
    for joint in names:
        of_joint = [rate[weight][joint] for weight in rate]  # type: ignore[index, call-overload]
        assert of_joint == sorted(of_joint, reverse=True)
    bars = {bar.name: bar.value for bar in outcome.bars}
    assert bars["over_rate_max"] == max(each.fit.statistics.over_estimation_rate for each in result.joints)
    assert bars["torque_reached_min"] == 0.6
    assert bars["qp_newton_difference_max"] == max(qp_newton_difference(result, index) for index in range(6))
    assert {bar.name: bar.limit for bar in outcome.bars} == {
        "over_rate_max": 0.10,
        "over_size_max": 0.05,
        "over_rate_to_symmetric_max": 0.5,
        "qp_newton_difference_max": 1e-6,
        "torque_reached_min": 0.4,
        "velocity_reached_min": 0.6,
    }


def test_table_1_has_the_true_values_beside() -> None:
    result, truth = made_up_identification(), true_motors(RUN)
    lines = table(result, truth).splitlines()
    assert len([line for line in lines if line.startswith("| R ")]) == 6
    assert [line.split(" | ")[0] for line in lines[-5:]] == ["| 1", "| 10", "| 100", "| 1000", "| 10000"]
    knee = next(line for line in lines if "KNEE" in line)
    assert f"{1e3 * result.joints[3].fit.torque_gain:.4f}" in knee
    assert f"{1e3 * truth.torque_gain[1, 3]:.4f} (" in knee
