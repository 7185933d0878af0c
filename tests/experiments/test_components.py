"""What is said of the parts of Δq, on parts that never were."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest
from deploy.variation import varied
from experiments import components as experiment
from experiments.components import CASES, STAIRS, TERMS, Components, components_of, evaluate, judged, lead, ranking
from experiments.figures import components_figure
from schemas.load import Run, load_run
from tests.experiments.figure_checks import check_figure
from tests.experiments.made_up_runs import made_up_leg

SIZES = {"torque": 2e-3, "friction": 8e-3, "position": 3e-3, "velocity": 1e-3, "acceleration": 5e-4, "force": 1e-4}
"""Amplitudes [rad] in motion."""
IN_FORCE = {**SIZES, "torque": 9e-3, "force": 4e-3, "friction": 1e-4}
KNEE = 3


@pytest.fixture(scope="module")
def scenario() -> Run:
    return load_run(STAIRS)


def parts(sizes: dict[str, float]) -> Components:
    """Sines of six joints; those of the last are none."""
    time_s = np.arange(0.0, 2.0, 0.001)
    wave = np.sin(np.pi * time_s)
    terms = {name: np.outer(size * wave, (1.0, 1.0, 1.0, 1.0, 1.0, 0.0)) for name, size in sizes.items()}
    return Components(time_s, terms)


def cases(**changed: Components) -> dict[str, Components]:
    return {"motion_k6_1": parts(SIZES), "motion_k6_0.1": parts(SIZES), "force": parts(IN_FORCE), **changed}


def test_the_lead_is_over_the_largest_other_term() -> None:
    assert lead(parts(SIZES), "friction", KNEE) == pytest.approx(8.0 / 3.0)
    assert lead(parts(SIZES), "position", KNEE) == pytest.approx(3.0 / 8.0)
    assert ranking(parts(SIZES), KNEE).split(", ")[:3] == ["friction 55", "position 21", "torque 14"]


def test_a_joint_without_any_term_has_no_ranking() -> None:
    assert ranking(parts(SIZES), 5) == ""


def test_rms_maximum_and_share_of_every_term(scenario: Run) -> None:
    result = evaluate(ExperimentRequest(3), scenario, cases())
    assert result.passed
    for term, size in SIZES.items():
        values = [result.metrics[f"motion_k6_1_{term}_{what}"] for what in ("rms_rad", "max_rad", "share")]
        numbers = [value["R_KNEE"] for value in values if isinstance(value, dict)]
        assert_allclose(np.array(numbers, float), (size / np.sqrt(2.0), size, size / sum(SIZES.values())), rtol=1e-6)
        shares = result.metrics[f"force_{term}_share"]
        assert isinstance(shares, dict)
        assert shares["R_ANKLE_P"] == 0.0


@pytest.mark.parametrize(
    ("case", "change", "term", "joints"),
    [
        ("motion_k6_1", {"position": 9e-3}, "friction", ("R_HIP_P", "R_KNEE")),
        ("motion_k6_0.1", {"velocity": 9e-3}, "friction", ("R_HIP_P", "R_KNEE")),
        ("force", {"force": 1e-2}, "torque", ("R_KNEE",)),
    ],
)
def test_another_term_in_the_lead_fails(
    scenario: Run, case: str, change: dict[str, float], term: str, joints: tuple[str, ...]
) -> None:
    of = parts({**(IN_FORCE if case == "force" else SIZES), **change})
    result = evaluate(ExperimentRequest(3), scenario, cases(**{case: of}))
    assert [bar.name for bar in result.bars if not bar.holds] == [f"{case}_{term}_lead_{joint}" for joint in joints]


def test_the_swing_or_whole_periods_of_the_sine_are_judged(scenario: Run) -> None:
    force = load_run("leg6-force-sine", {"plant.world.events": [], "duration_s": experiment.FORCE_S})
    for run, span in ((scenario, (1.0, 3.199)), (force, (2.0, 7.999))):
        still = np.zeros((run.cycles, 6))
        found = components_of(made_up_leg(run, still, still))
        assert_allclose(found.time_s[[0, -1]], span)
        assert list(found.terms) == list(TERMS[:-1])


def test_cycles_without_torque_control_and_an_integral_that_acts(scenario: Run) -> None:
    still = np.zeros((scenario.cycles, 6))
    trace = made_up_leg(scenario, still, still).trace
    torque = still.copy()
    torque[:1500] = np.nan
    found = judged(trace.time_s, replace(trace.offset, torque=torque, integral=still + 1e-3), (1.0, 2.0))
    assert_allclose(found.time_s[[0, -1]], (1.5, 1.999))
    assert_allclose(found.rms["integral"], 1e-3)


def test_the_cases_are_those_of_the_papers_figure() -> None:
    gains = {}
    for name, (scenario, overrides) in CASES.items():
        config = load_run(scenario, overrides).scenario.controller.position_torque
        assert config is not None
        gains[name] = config.position_gain
    assert gains == {"motion_k6_1": 1.0, "motion_k6_0.1": 0.1, "force": 0.1}


def test_six_panels_show_all_terms_in_milliradians(scenario: Run) -> None:
    figure = components_figure(cases(), scenario.robot.description.joint_names)
    check_figure(figure)
    assert [axis.get_title(loc="left")[:3] for axis in figure.axes] == [f"({letter})" for letter in "abcdef"]
    for axis in figure.axes:
        drawn = [line for line in axis.lines if not str(line.get_label()).startswith("_")]
        assert len(drawn) == len(SIZES)
    largest = {str(line.get_label()): np.max(line.get_ydata()) for line in figure.axes[4].lines}
    assert largest["feed-forward torque"] == pytest.approx(9.0)


@pytest.mark.parametrize(
    "path", ["controller.position_torque.position_gain", "plant.world.events", "plant.initial_posture", "duration_s"]
)
def test_what_is_of_one_motion_is_refused(path: str) -> None:
    value: Any = {"duration_s": 9.0, "plant.world.events": [], "plant.initial_posture": {}}.get(path, 0.5)
    with pytest.raises(UsageError, match="the experiment sets it itself"):
        experiment.run(ExperimentRequest(0, {path: value}))


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(21, 24))
def test_every_bar_holds_on_many_plants(seed: int) -> None:
    result = experiment.run(ExperimentRequest(seed, varied({}, seed)))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
