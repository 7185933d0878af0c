"""What the comparison of torque and position control measures, on runs that never were and on a short one that was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest, ExperimentResult
from deploy.series import RunSeries
from deploy.variation import varied
from experiments import torque_vs_position as experiment
from experiments.figures import torque_vs_position_figure
from experiments.hand_runs import perform
from experiments.leg_tables import (
    GAINS,
    PAPER_TABLES,
    gain_name,
    paper_ratio,
    paper_ratios,
    ratios,
    table_average,
    tables,
)
from experiments.torque_vs_position import KICK_AFTER_S, KICK_S, SCENARIO, compared_joints, motions_of, open_loop
from schemas.load import Run, load_run
from tests.experiments.figure_checks import check_figure
from tests.experiments.made_up_runs import made_up_leg

SHARES = {"position": 1.0, "k6_1": 0.2, "k6_0.5": 0.25, "k6_0.25": 0.5, "k6_0.1": 2.0, "late": 0.3}
"""Errors of the runs, in those of the position control."""
YAW = 2


@pytest.fixture(scope="module")
def scenario() -> Run:
    return load_run(SCENARIO)


def desired(run: Run) -> Any:
    time_s = np.arange(run.cycles) * run.robot.description.period_s
    wave = np.where((time_s > 1.0) & (time_s < 3.1), 0.5 * np.sin(3.0 * (time_s - 1.0)) ** 2, 0.0)
    motion = np.tile(wave[:, np.newaxis], (1, 6))
    motion[:, YAW] = 0.0
    return motion


def follows(run: Run, share: float, **truth: Any) -> RunSeries:
    """A run whose error is a share of 5 mrad and 0.02 q^d."""
    asked = desired(run)
    return made_up_leg(run, asked, asked - share * (0.005 + 0.02 * asked), **truth)


def dying(run: Run, after_s: float, growth: float = 1.0, rate: float = -3.0) -> Any:
    """Kinetic energy [J] that is 2 at a time, grows a little later until 0.2 s after it and then dies away."""
    since_s = np.arange(run.cycles) * run.robot.description.period_s - after_s
    return np.where(since_s < 0.01, 2.0, np.where(since_s < 0.2, 2.0 * growth, 2.0 * np.exp(rate * since_s)))


def made_up_runs(run: Run, growth: float = 1.0, rate: float = -3.0, **shares: float) -> dict[str, RunSeries]:
    kick_s = 1.0 + KICK_AFTER_S + KICK_S
    runs = {name: follows(run, share) for name, share in {**SHARES, **shares}.items()}
    runs["open"] = follows(run, 10.0, kinetic_energy=dying(run, 2.0))
    runs["kicked"] = follows(run, 10.0, kinetic_energy=dying(run, kick_s, growth, rate))
    return runs


def measured(run: Run, runs: dict[str, RunSeries]) -> ExperimentResult:
    return experiment.evaluate(ExperimentRequest(3), run, runs)


def failing(result: ExperimentResult) -> set[str]:
    return {bar.name for bar in result.bars if not bar.holds}


def test_the_average_is_that_of_the_papers_table() -> None:
    error = np.array([[3.0, 1.0], [-4.0, 1.0], [0.0, 1.0], [0.0, 1.0]])
    assert_allclose(table_average(error), (5.0 / 4.0, 2.0 / 4.0))


def test_the_papers_ratios_are_those_that_the_text_speaks_of() -> None:
    """All better with K₆ = 1, none worse with 0.5, 0.80, 1.14, 0.58, 0.98, 2.03 with 0.25, with 0.1 only the knee."""
    joints = ("R_HIP_R", "R_HIP_P", "R_KNEE", "R_ANKLE_P", "R_ANKLE_R")
    assert all(paper_ratio(m, j, 1.0) < 1.0 for m in PAPER_TABLES for j in joints)
    assert all(paper_ratio(m, j, 0.5) <= 1.0 for m in PAPER_TABLES for j in joints)
    assert_allclose([paper_ratio("avg", j, 0.25) for j in joints], (0.80, 1.14, 0.58, 0.98, 2.03), atol=0.006)
    assert [j for j in joints if paper_ratio("avg", j, 0.1) < 1.0] == ["R_KNEE"]


def test_ratios_are_those_of_the_errors_and_the_still_joint_is_left_out(scenario: Run) -> None:
    result = measured(scenario, made_up_runs(scenario))
    assert failing(result) == set()
    for name in ("k6_1", "k6_0.25", "late"):
        for measure in ("avg", "max", "rms"):
            of = result.metrics[f"{name}_{measure}_ratio"]
            assert isinstance(of, dict)
            assert set(of) == set(PAPER_TABLES["avg"])
            assert_allclose([float(value) for value in of.values()], SHARES[name])
    assert result.metrics["k6_0.25_worse_than_paper"] == 0
    assert result.metrics["k6_0.1_worse_than_position"] == 10
    assert result.metrics["reference_agreement_rad"] == 0.0


@pytest.mark.parametrize(
    ("share", "fails"),
    [
        ({"k6_1": 1.1}, {"k6_1_avg_ratio_max", "k6_1_max_ratio_max", "k6_1_worse_than_paper"}),
        ({"k6_1": 0.255}, {"k6_1_worse_than_paper"}),
        ({"k6_0.5": 0.31}, {"k6_0.5_worse_than_paper"}),
    ],
)
def test_worse_than_position_control_or_than_the_paper_fails(
    scenario: Run, share: dict[str, float], fails: set[str]
) -> None:
    assert failing(measured(scenario, made_up_runs(scenario, **share))) == fails


def test_what_is_worse_than_the_paper_is_named(scenario: Run) -> None:
    result = measured(scenario, made_up_runs(scenario, **{"k6_1": 0.255}))
    named = str(result.metrics["k6_1_worse_than_paper_which"]).split(", ")
    assert sorted(named) == ["avg of R_HIP_R", "max of R_ANKLE_P"]


def test_open_loop_counts_speed_beyond_what_is_asked_and_energy_that_stays(scenario: Run) -> None:
    runs = made_up_runs(scenario)
    fast = np.zeros((scenario.cycles, 6))
    fast[2000, 4] = -3.0
    runs["open"] = follows(scenario, 10.0, velocity=fast, kinetic_energy=dying(scenario, 2.0, rate=-0.1))
    of = open_loop(runs)
    assert of["open_speed_ratio"] == pytest.approx(3.0 / 1.5, rel=1e-3)
    assert of["open_energy_left"] > 0.5
    assert failing(measured(scenario, runs)) == {"open_speed_ratio", "open_energy_left"}


@pytest.mark.parametrize(
    ("growth", "rate", "fails"),
    [(1.04, -3.0, set()), (1.1, -3.0, {"kicked_energy_growth"}), (1.0, -0.5, {"kicked_energy_left"})],
)
def test_a_kick_whose_energy_grows_or_stays_fails(scenario: Run, growth: float, rate: float, fails: set[str]) -> None:
    assert failing(measured(scenario, made_up_runs(scenario, growth, rate))) == fails


def test_every_run_differs_by_what_its_name_says(scenario: Run) -> None:
    variants = experiment.overrides_of(scenario)
    changed = {name: load_run(SCENARIO, overrides).scenario for name, overrides in variants.items()}
    assert not any(phase.torque_control for phase in changed["position"].controller.phases)
    for name, of in changed.items():
        config = of.controller.position_torque
        assert config is not None
        if name in map(gain_name, GAINS):
            assert gain_name(config.position_gain) == name
            assert config.predict_velocity
    for name in ("open", "kicked"):
        config = changed[name].controller.position_torque
        assert config is not None
        assert (config.position_gain, config.velocity_gain, config.torque_gain, config.force_gain) == (0, 0, 0, 0)
    late = changed["late"].controller.position_torque
    assert late is not None
    assert not late.predict_velocity
    assert changed["kicked"].controller.phases[2].joint_path is None
    assert [event.name for event in changed["kicked"].plant.world.events] == ["kicked"]
    assert changed["open"].plant.world.events == ()


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("controller.position_torque.position_gain", 1.0, "the experiment sets it itself"),
        ("controller.phases.2.duration_s", 3.0, "the experiment sets it itself"),
        ("plant.world.events", [], "the experiment sets it itself"),
        ("seed", 1, "the experiment sets it itself"),
        ("duration_s", 3.0, "is too short"),
    ],
)
def test_what_it_sets_itself_is_refused_before_anything_runs(path: str, value: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        experiment.run(ExperimentRequest(0, {path: value}))


def test_figure_and_tables_have_all_joints_and_both_sides(scenario: Run) -> None:
    runs = made_up_runs(scenario)
    motions, joints = motions_of(runs), compared_joints(runs)
    of, paper = ratios(scenario, motions, joints), paper_ratios(scenario, joints)
    figure = torque_vs_position_figure(runs, motions, of, paper)
    check_figure(figure)
    average = next(axis for axis in figure.axes if axis.get_title(loc="left").startswith("Average"))
    drawn = {str(line.get_label()): np.asarray(line.get_ydata()) for line in average.lines}
    assert_allclose(drawn["K₆ = 0.5, here"], 0.25)
    assert_allclose(drawn["K₆ = 0.5, paper"], [paper["avg"]["k6_0.5"][joint] for joint in of["avg"]["k6_1"]])
    text = tables(scenario, motions, joints)
    assert "| hip roll |" in text
    assert "0.20 (0.25)" in text
    assert len([line for line in text.splitlines() if line.startswith("| knee")]) == 2


def test_torque_control_with_packaged_motors_beats_position_control(tmp_path: Path, scenario: Run) -> None:
    variants = experiment.overrides_of(scenario)
    request = ExperimentRequest(21, varied({}, 21))
    runs = {name: perform(request, SCENARIO, tmp_path / name, variants[name]) for name in ("position", "k6_1")}
    runs |= dict.fromkeys([*map(gain_name, GAINS[1:]), "late"], runs["k6_1"])
    of = ratios(scenario, motions_of(runs), compared_joints(runs))
    assert max(of[measure]["k6_1"][joint] for measure in of for joint in of[measure]["k6_1"]) < 0.6


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(22, 26))
def test_every_bar_holds_on_many_plants(seed: int) -> None:
    result = experiment.run(ExperimentRequest(seed, varied({}, seed)))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
