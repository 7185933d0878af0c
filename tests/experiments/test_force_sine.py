"""What the force experiment measures, on contacts that never were."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest, ExperimentResult
from deploy.variation import varied
from experiments import force_sine as experiment
from experiments.figures import force_sine_figure
from experiments.force_sine import EVENT, SCENARIO, event, flights, sine, swing
from experiments.leg_signals import Contact, sine_spans
from schemas.load import Run, load_run
from tests.experiments.figure_checks import check_figure

AMPLITUDE, MEAN = 150.0, 300.0
LIFTED = (8.5, 8.9)


@pytest.fixture(scope="module")
def scenario() -> Run:
    return load_run(SCENARIO)


def forces(run: Run, ratio: float = 1.0, late_s: float = 0.0, **columns: Any) -> Contact:
    """A vertical force that follows its reference by ratio and lag, and is gone while the foot is lifted."""
    time_s = np.arange(run.cycles) * run.robot.description.period_s

    def wave(of_s: Any) -> Any:
        return np.sin(np.pi * (of_s - 2.0))

    wrench = np.zeros((run.cycles, 6))
    wrench[:, 2] = MEAN + AMPLITUDE * wave(time_s)
    force = np.zeros_like(wrench)
    force[:, 2] = MEAN + ratio * AMPLITUDE * wave(time_s - late_s)
    for name, values in columns.items():
        force[:, "xyz".index(name[1]) + (3 if name[0] == "m" else 0)] += values
    force[(time_s >= LIFTED[0] + 0.05) & (time_s < LIFTED[1])] = 0.0
    return Contact(time_s, force, force.copy(), wrench)


def during(run: Run, begin_s: float, end_s: float, value: float) -> Any:
    time_s = np.arange(run.cycles) * run.robot.description.period_s
    return np.where((time_s >= begin_s) & (time_s < end_s), value, 0.0)


def measured(run: Run, with_: Contact) -> ExperimentResult:
    contacts = {"with": with_, "without": forces(run, 0.2)}
    return experiment.evaluate(ExperimentRequest(3), run, contacts, sine_spans(run, EVENT))


def failing(result: ExperimentResult) -> set[str]:
    return {bar.name for bar in result.bars if not bar.holds}


def test_the_experiments_force_is_the_scenarios(scenario: Run) -> None:
    wrench = scenario.scenario.controller.phases[1].wrench
    assert wrench is not None
    assert (wrench.amplitude[2], wrench.mean[2], wrench.frequency_hz) == (AMPLITUDE, MEAN, 0.5)
    lifted = scenario.scenario.plant.world.events[0]
    assert (lifted.name, lifted.start_s, lifted.duration_s) == (EVENT, 8.5, 0.4)


@pytest.mark.parametrize(("ratio", "late_s"), [(1.05, 0.0), (0.9, 0.06), (1.0, -0.02)])
def test_ratio_lag_and_overshoot_are_those_of_the_sine(scenario: Run, ratio: float, late_s: float) -> None:
    of = sine(scenario, forces(scenario, ratio, late_s), sine_spans(scenario, EVENT))
    assert of["periods"] == 3
    assert of["amplitude_ratio"] == pytest.approx(ratio, rel=1e-6)
    assert of["lag_s"] == pytest.approx(late_s, abs=1e-3)
    assert of["overshoot"] == pytest.approx(ratio - 1.0, abs=1e-5)
    error = abs(ratio * np.exp(-1j * np.pi * late_s) - 1.0) / np.sqrt(2.0)
    assert of["rms_error_ratio"] == pytest.approx(error, rel=1e-3)
    assert of["error_ratio_first_touch"] == pytest.approx(1.0, rel=1e-6)


def test_a_force_that_is_too_low_at_the_trough_overshoots_too(scenario: Run) -> None:
    low = forces(scenario, fz=during(scenario, 3.4, 3.6, -30.0))
    of = sine(scenario, low, sine_spans(scenario, EVENT))
    assert of["overshoot_apex"] == pytest.approx(0.0, abs=1e-6)
    assert of["overshoot"] == of["overshoot_trough"] == pytest.approx(30.0 / AMPLITUDE, rel=1e-3)
    assert failing(measured(scenario, low)) >= {"with_overshoot"}


def test_coupling_is_the_larger_horizontal_force_before_the_event(scenario: Run) -> None:
    sideways = forces(scenario, 0.95, 0.02, fx=during(scenario, 4.0, 5.0, -12.0), fy=during(scenario, 9.0, 9.4, 80.0))
    result = measured(scenario, sideways)
    assert result.metrics["with_coupling"] == result.metrics["with_coupling_x"] == pytest.approx(0.08)
    assert (result.metrics["with_coupling_y"], result.metrics["coupling_aim_reached"]) == (0.0, False)
    assert failing(result) == set()
    worse = forces(scenario, 0.95, 0.02, fy=during(scenario, 4.0, 5.0, 16.0))
    assert failing(measured(scenario, worse)) == {"with_coupling"}


def test_the_centre_of_pressure_is_the_moment_over_the_force(scenario: Run) -> None:
    of = sine(scenario, forces(scenario, 0.99, my=during(scenario, 2.9, 3.1, -6.0)), sine_spans(scenario, EVENT))
    assert of["moment_max_nm"] == {"x": 0.0, "y": 6.0, "z": 0.0}
    assert of["cop_shift_max_m"] == pytest.approx(6.0 / (MEAN - 0.99 * AMPLITUDE * np.sin(0.099 * np.pi)), rel=1e-6)


def test_smoothed_and_raw_forces_are_told_apart(scenario: Run) -> None:
    force = forces(scenario, 0.99)
    spiky = replace(force, raw=force.raw + np.outer(during(scenario, 2.5, 2.501, 60.0), (1.0, 0.0, 1.0, 0.0, 0.0, 0.0)))
    of = sine(scenario, spiky, sine_spans(scenario, EVENT))
    assert of["coupling"] == 0.0
    assert of["coupling_raw"] == pytest.approx(0.4)
    assert of["overshoot_raw"] == pytest.approx(0.99 + 0.4 - 1.0)


def test_a_landing_with_rebounds_is_described(scenario: Run) -> None:
    force = forces(scenario, 0.95, 0.02, fz=during(scenario, 9.1, 9.11, 1000.0) + during(scenario, 9.0, 9.6, 60.0))
    time_s = force.time_s
    hop = ((time_s >= 9.2) & (time_s < 9.22)) | ((time_s >= 9.3) & (time_s < 9.303))
    force.raw[hop] = 0.0
    of = event(scenario, force, sine_spans(scenario, EVENT))
    assert of["airborne_s"] == pytest.approx(0.35 + 0.02 + 0.003)
    assert of["rebounds"] == 1
    assert of["landing_force_ratio"] == pytest.approx(of["landing_force_max_n"] / 450.0)
    assert of["landing_force_max_n"] == pytest.approx(MEAN - 0.95 * AMPLITUDE * np.sin(np.pi * 0.08) + 1060.0, rel=0.01)
    assert of["settling_s"] == pytest.approx(9.6 - LIFTED[1], abs=2e-3)
    assert of["error_ratio_after_landing"] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    ("span", "fails"),
    [((10.0, 12.0), {"with_swing_ratio_after_landing"}), ((2.0, 4.0), {"with_error_ratio_first_touch"})],
)
def test_an_error_that_grows_after_contact_fails(scenario: Run, span: tuple[float, float], fails: set[str]) -> None:
    """50 N of oscillation beside a steady error of 7 N."""
    time_s = np.arange(scenario.cycles) * scenario.robot.description.period_s
    swinging = during(scenario, *span, 50.0) * np.sin(40.0 * np.pi * time_s)
    assert failing(measured(scenario, forces(scenario, 0.95, 0.0))) == set()
    assert fails <= failing(measured(scenario, forces(scenario, 0.95, 0.0, fz=swinging)))


def test_a_foot_that_lands_elsewhere_is_off_and_no_instability(scenario: Run) -> None:
    """40 N too little and four fifths of the amplitude, steadily; and a foot that still leaves the block."""
    period = scenario.robot.description.period_s
    time_s = np.arange(scenario.cycles) * period
    fundamental = -0.2 * AMPLITUDE * np.sin(np.pi * (time_s - 2.0))
    off = forces(scenario, 0.95, 0.02, fz=during(scenario, 9.5, 12.0, 1.0) * (fundamental - 40.0))
    result = measured(scenario, off)
    assert result.metrics["with_error_ratio_after_landing"] > 1.5
    assert result.metrics["with_swing_after_landing_n"] == pytest.approx(0.0, abs=0.5)
    assert failing(result) == set()
    off.raw[(time_s >= 11.0) & (time_s < 11.01)] = 0.0
    assert {"with_airborne_after_landing_s"} <= failing(measured(scenario, off))


def test_the_swing_is_what_mean_and_fundamental_leave() -> None:
    time_s = np.arange(2000) * 0.001
    slow, fast = 30.0 + 20.0 * np.sin(np.pi * time_s + 0.3), 4.0 * np.sin(22.0 * np.pi * time_s)
    assert swing(slow, 2.0, 0.001) == pytest.approx(0.0, abs=1e-9)
    assert swing(slow + fast, 2.0, 0.001) == pytest.approx(4.0 / np.sqrt(2.0))


def test_flights_shorter_than_a_gap_are_chatter() -> None:
    touching = np.ones(100, np.bool_)
    touching[10:13] = touching[40:60] = touching[80:90] = False
    assert flights(touching, 0.001) == 2
    assert flights(np.ones(10, np.bool_), 0.001) == 0


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("controller.position_torque.motors", {}, "the experiment sets it itself"),
        ("controller.position_torque.motors_from", "leg6", "the experiment sets it itself"),
        ("plant.world.obstacles", [], "needs the block"),
        ("plant.world.events", [], "no event 'lifted'"),
        ("duration_s", 12.5, "is too short"),
    ],
)
def test_what_it_cannot_measure_with_is_refused_before_anything_runs(path: str, value: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        experiment.run(ExperimentRequest(0, {path: value}))


def test_the_figure_shows_both_runs_and_the_event(scenario: Run) -> None:
    contacts = {"with": forces(scenario), "without": forces(scenario, 0.2, 0.1)}
    figure = force_sine_figure(contacts, scenario, sine_spans(scenario, EVENT))
    check_figure(figure)
    tops = [axis for axis in figure.axes if axis.get_title(loc="left").startswith(("With ", "Feed-"))]
    assert ["error up to 0 N" in axis.get_title(loc="left") for axis in tops] == [True, False]
    assert len({axis.get_ylim() for axis in tops}) == 1
    assert all(np.ptp(np.asarray(axis.patches[0].get_extents().intervalx)) > 0.0 for axis in figure.axes)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(21, 26))
def test_every_bar_holds_on_many_plants(seed: int) -> None:
    result = experiment.run(ExperimentRequest(seed, varied({}, seed)))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
