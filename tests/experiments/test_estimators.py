"""What is said of the estimators, on estimates that never were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller_service.errors import ControllerError
from deploy.experiment import ExperimentRequest
from deploy.offset_series import MotionSeries
from deploy.series import RunSeries
from deploy.variation import varied
from experiments import estimators as experiment
from experiments.estimators import ESTIMATORS, STAIRS, estimates_of, evaluate, of_estimates, of_force, of_motion, table
from experiments.figures import estimators_figure
from schemas.load import Run, load_run
from tests.experiments.figure_checks import check_figure
from tests.experiments.made_up_runs import made_up_leg

DELAY_S = 0.0395
STILL = 2
"""Joint that does not move."""


@pytest.fixture(scope="module")
def scenario() -> Run:
    return load_run(STAIRS)


def swing(time_s: Any) -> Any:
    """Position of all joints [rad]: at rest but for the swing."""
    wave = np.where((time_s > 1.0) & (time_s < 3.0), 0.4 * np.sin(np.pi * (time_s - 1.0)) ** 4, 0.0)
    position = np.tile(wave[:, np.newaxis], (1, 6))
    position[:, STILL] = 0.0
    return position


def run_of(run: Run, late_s: float, noise: float = 0.0, error_rad: float = 0.0) -> RunSeries:
    """A run whose estimates are the truth, late and noisy; torques are 100 times the velocities."""
    time_s = np.arange(run.cycles) * run.robot.description.period_s
    step = 1e-6
    velocity, late = ((swing(t + step) - swing(t - step)) / (2.0 * step) for t in (time_s, time_s - late_s))
    told = late + noise * np.random.default_rng(4).standard_normal(late.shape)
    position = swing(time_s)
    series = made_up_leg(run, position + error_rad, position, velocity=velocity, joint_torque=100.0 * velocity)
    estimated = MotionSeries(late_s, position, told, 0.0 * told, 100.0 * told)
    return replace(series, trace=replace(series.trace, estimated=estimated))


@pytest.mark.parametrize("late_s", [DELAY_S, 0.0, -0.004])
def test_delay_is_found_and_taken_away(scenario: Run, late_s: float) -> None:
    series = run_of(scenario, late_s)
    each = estimates_of(series)
    of = of_estimates(each, series)
    acceleration = np.gradient(each.true_velocity, 1e-3, axis=0)
    late = abs(late_s) * float(np.sqrt(np.mean(acceleration**2)))
    for name, unit, scale in (("velocity", "rad_s", 1.0), ("torque", "nm", 100.0)):
        assert of[f"{name}_delay_s"] == pytest.approx(late_s, abs=1e-4)
        assert of[f"{name}_error_aligned_{unit}"] < 2e-3 * scale
        assert of[f"{name}_error_late_{unit}"] == pytest.approx(late * scale, rel=0.03)
        assert of[f"{name}_noise_rest_{unit}"] == 0.0


def test_noise_is_that_of_the_estimate_at_rest_and_in_motion(scenario: Run) -> None:
    series = run_of(scenario, 0.0, noise=0.05)
    of = of_estimates(estimates_of(series), series)
    assert of["velocity_noise_rest_rad_s"] == pytest.approx(0.05, rel=0.05)
    assert of["velocity_noise_motion_rad_s"] == pytest.approx(0.05, rel=0.05)
    assert of["torque_noise_rest_nm"] == pytest.approx(5.0, rel=0.05)


def test_joints_that_stand_still_are_left_out(scenario: Run) -> None:
    joints = estimates_of(run_of(scenario, 0.0)).joints
    names = scenario.robot.description.joint_names
    assert joints == tuple(name for index, name in enumerate(names) if index != STILL)


def test_control_errors_are_of_the_swing_and_of_whole_periods(scenario: Run) -> None:
    of = of_motion(run_of(scenario, 0.0, error_rad=-3e-3))
    assert (of["position_error_rms_rad"], of["position_error_max_rad"]) == pytest.approx((3e-3, 3e-3))
    force = load_run(experiment.FORCE, {"plant.world.events": [], "duration_s": experiment.FORCE_S})
    still = np.zeros((force.cycles, 6))
    series = made_up_leg(force, still, still)
    wrench = np.zeros((force.cycles, 6))
    wrench[2000:6000, 2] = 30.0
    wrench[6000:, 2] = 1e3
    of_wrench = of_force(replace(series, trace=replace(series.trace, wrench_reference=wrench)))
    assert (of_wrench["force_error_rms_ratio"], of_wrench["force_error_max_ratio"]) == pytest.approx((0.2, 0.2))


def metrics(scenario: Run, **late_s: float) -> dict[str, dict[str, float]]:
    found = {}
    for name in ESTIMATORS:
        series = run_of(scenario, late_s.get(name, DELAY_S))
        found[name] = {"finished": 1.0, **of_estimates(estimates_of(series), series), **of_motion(series)}
    return found


@pytest.mark.parametrize(
    ("late_s", "fails"),
    [
        (0.0415, set()),
        (0.0435, {"centre_velocity_delay_difference_s", "centre_torque_delay_difference_s"}),
    ],
)
def test_a_delay_that_is_not_the_windows_fails(scenario: Run, late_s: float, fails: set[str]) -> None:
    result = evaluate(ExperimentRequest(3), scenario, metrics(scenario, centre=late_s))
    assert {bar.name for bar in result.bars if not bar.holds} == fails
    assert result.metrics["kalman_finished"] == 1.0


def test_a_run_that_stops_is_no_result_but_the_others_are(
    scenario: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def perform(_request: Any, name: str, _directory: Path, overrides: dict[str, Any]) -> RunSeries:
        if overrides.get(f"{experiment.CONFIG}.estimator") == "kalman" and name == STAIRS:
            raise ControllerError("R_KNEE moves at 9 rad/s")
        if name == STAIRS:
            return run_of(scenario, DELAY_S)
        force = load_run(name, {"plant.world.events": [], "duration_s": experiment.FORCE_S})
        still = np.zeros((force.cycles, 6))
        return made_up_leg(force, still, still)

    monkeypatch.setattr(experiment, "perform", perform)
    monkeypatch.setattr(experiment, "identified_motors", lambda _request, _directory: {})
    result = experiment.run(ExperimentRequest(0, {}, tmp_path))
    assert [bar.name for bar in result.bars if not bar.holds] == ["kalman_finished"]
    assert "kalman_velocity_delay_s" not in result.metrics
    assert "kalman_force_error_rms_ratio" in result.metrics
    row = next(line for line in (tmp_path / "estimators.md").read_text().splitlines() if "velocity delay" in line)
    assert row == "| velocity delay | ms | 39.5 | 39.5 | 39.5 | – |"
    assert (tmp_path / "estimators.png").exists()


def test_the_table_writes_rounding_errors_as_zero() -> None:
    assert "| velocity noise at rest | mrad/s | 0 |" in table({"centre": {"velocity_noise_rest_rad_s": 3e-27}})


def test_the_figure_compares_all(scenario: Run) -> None:
    estimates = {name: estimates_of(run_of(scenario, DELAY_S)) for name in ESTIMATORS}
    figure = estimators_figure(estimates, metrics(scenario, kalman=0.0))
    check_figure(figure)
    delays = next(axis for axis in figure.axes if axis.get_title(loc="left").startswith("Delay"))
    assert [text.get_text() for text in delays.texts][:3] == ["39.5", "39.5", "39.5"]


def test_each_estimator_is_the_one_of_its_name() -> None:
    for name, overrides in ESTIMATORS.items():
        config = load_run(STAIRS, overrides).scenario.controller.position_torque
        assert config is not None
        assert (config.estimator == "kalman") is (name == "kalman")
        assert (config.savitzky_golay.evaluate_at == "end") is (name == "end")
        assert config.predict_velocity is not (name == "unpredicted")


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(21, 24))
def test_every_bar_holds_on_many_plants(seed: int) -> None:
    result = experiment.run(ExperimentRequest(seed, varied({}, seed)))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
