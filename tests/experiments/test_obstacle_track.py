"""What the experiment of tracking among obstacles measures, on runs that never were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from deploy.experiment import ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments import obstacle_track
from experiments.obstacle_track import APART_S, ERROR_M, IMPACT_S, MEAN_S, SCENARIO, contact_times
from schemas.load import load_run
from schemas.messages import ContactSample
from tests.experiments.made_up_runs import ELBOW, made_up

RUN = load_run(SCENARIO)
LIMITS = np.array([joint.torque_limit for joint in RUN.robot.description.joints])
PERIOD_S = RUN.robot.description.period_s
FINE = np.arange(1000) * PERIOD_S
"""Times of 1000 cycles of the robot; the made-up run has fewer a second."""
MADE = made_up(SCENARIO, way=0.2)
TIME = MADE.truth.time_s
TRACK = (TIME > 2.0 - 1e-6) & (TIME < 22.0 - 1e-6)
Touches = Sequence[tuple[float, str]]


def sample(other: str, force: float = 100.0, link: str = ELBOW) -> ContactSample:
    return ContactSample(
        link=link, other=other, force_in_world=(0.0, 0.6 * force, 0.8 * force), position_in_world=(0.1, -0.2, 0.3)
    )


def touching(time_s: Array, touches: Touches) -> RunSeries:
    """A run of other times, in which links touch what is named at the samples nearest to the times given."""
    contacts: list[tuple[ContactSample, ...]] = [() for _ in time_s]
    for when, other in touches:
        contacts[int(np.argmin(np.abs(time_s - when)))] += (sample(other),)
    truth = replace(MADE.truth, time_s=time_s, contacts=tuple(contacts), kinetic_energy=np.zeros(len(time_s)))
    return replace(MADE, truth=truth)


def pressed(forces: Sequence[tuple[ContactSample, ...]]) -> RunSeries:
    """A run of some cycles with contacts, amid as many that have none as it takes."""
    free: tuple[tuple[ContactSample, ...], ...] = ((),) * 100
    return replace(MADE, truth=replace(MADE.truth, contacts=free + tuple(forces) + free))


def tracked() -> RunSeries:
    """A run that keeps all bars: the hand draws its circles 2 mm beside those desired."""
    phase = tuple("track" if tracks else "rest" for tracks in TRACK)
    torque, applied = np.tile(0.5 * LIMITS, (len(TIME), 1)), np.tile(0.6 * LIMITS, (len(TIME), 4, 1))
    torque[0], applied[0] = np.nan, np.nan  # there is none yet
    truth = replace(MADE.truth, motor_torque_substeps=applied)
    return replace(MADE, trace=replace(MADE.trace, phase=phase, torque_commanded=torque), truth=truth)


TRACKED = tracked()


def measured(series: RunSeries) -> ExperimentResult:
    return obstacle_track._result(ExperimentRequest(3), RUN, series)


def failing(series: RunSeries) -> set[str]:
    return {bar.name for bar in measured(series).bars if not bar.holds}


def at(time_s: float) -> int:
    return int(np.argmin(np.abs(TIME - time_s)))


def off(when: float, axis: int, error_m: float) -> RunSeries:
    """The run in which the hand is off what is desired along one axis at one cycle."""
    hand = TRACKED.truth.hand.copy()
    hand[at(when), axis] = TRACKED.trace.hand_desired[at(when), axis] + error_m
    return replace(TRACKED, truth=replace(TRACKED.truth, hand=hand))


# --- contacts


def test_touches_near_in_time_are_one_contact() -> None:
    grid = np.arange(0.0, 5.0, 0.01)
    last = 1.0 + (APART_S - 0.01)
    touches = [(1.0, "outer"), (last, "outer"), (last + APART_S + 0.01, "outer"), (4.0, "outer"), (4.0, "outer")]
    found = contact_times(touching(grid, touches))
    assert found["outer"] == pytest.approx([1.0, last + APART_S + 0.01, 4.0])
    assert found["inner"] == []


def test_each_obstacle_has_its_own_contacts_and_links_among_each_other_none() -> None:
    grid = np.arange(0.0, 5.0, 0.01)
    touches = [(0.0, "inner"), (1.0, "outer"), (1.1, "inner"), (1.3, "outer"), (2.0, "torso"), (3.0, "inner")]
    found = contact_times(touching(grid, touches))
    assert found == {"outer": pytest.approx([1.0, 1.3]), "inner": pytest.approx([0.0, 1.1, 3.0])}
    assert list(found) == ["outer", "inner"]


def test_where_nothing_is_touched_there_are_no_contacts() -> None:
    assert contact_times(touching(FINE, [])) == {"outer": [], "inner": []}


# --- laps and angles


def ring(turns: float, middle: tuple[float, float] = (0.0, 0.0)) -> Array:
    angle = 0.3 + 2.0 * np.pi * turns * np.linspace(0.0, 1.0, 2001)
    return np.column_stack((0.4 + 0.1 * np.sin(7 * angle), middle[0] + np.cos(angle), middle[1] + np.sin(angle)))


@pytest.mark.parametrize("turns", [2.5, -2.5, 0.25, 4.0])
def test_laps_are_turns_around_the_middle_in_either_direction(turns: float) -> None:
    middle = (0.5, -3.0)
    desired = ring(4.0, middle)
    assert obstacle_track._laps(ring(turns, middle), desired) == pytest.approx(abs(turns), abs=1e-3)
    assert obstacle_track._laps(ring(turns, (0.5, 3.0)), desired) < 0.1


def test_a_hand_that_stays_or_goes_to_and_fro_does_no_laps() -> None:
    desired = ring(4.0)
    assert obstacle_track._laps(np.tile(desired[0], (2001, 1)), desired) == 0.0
    there = ring(0.9)
    assert obstacle_track._laps(np.concatenate((there, there[::-1])), desired) == pytest.approx(0.0, abs=1e-9)


def test_the_angle_between_orientations_is_that_of_their_rotation_whatever_their_signs() -> None:
    turned = np.array((0.0, 1e-3, 0.5, 2.0, np.pi))
    axis = np.array((2.0, -1.0, 2.0)) / 3.0
    some = np.column_stack((np.cos(0.5 * turned), np.outer(np.sin(0.5 * turned), axis)))
    upright = np.tile((1.0, 0.0, 0.0, 0.0), (5, 1))
    for one, other in ((some, upright), (upright, some), (-some, upright), (some, -upright)):
        assert obstacle_track._angle(one, other) == pytest.approx(turned, abs=1e-9)
    same = np.tile(some[2], (5, 1)) * (1.0 + 1e-15)
    assert obstacle_track._angle(same, -same) == pytest.approx(np.zeros(5), abs=1e-7)
    # Around one axis the angles subtract.
    assert obstacle_track._angle(some[3:4], some[2:3]) == pytest.approx([1.5])


# --- forces and energy


def test_the_mean_force_is_that_of_the_worst_window() -> None:
    width = round(MEAN_S / PERIOD_S)
    lean, rest = (sample("outer", 100.0),), ()
    assert obstacle_track._largest_mean(pressed([lean] * width), "outer") == pytest.approx(100.0)
    assert obstacle_track._largest_mean(pressed([lean] * 3 * width), "outer") == pytest.approx(100.0)
    assert obstacle_track._largest_mean(pressed([lean, rest] * width), "outer") == pytest.approx(50.0, rel=0.05)
    assert obstacle_track._largest_mean(pressed([(sample("outer", 400.0),)]), "outer") == pytest.approx(400.0 / width)


def test_the_force_of_an_obstacle_is_that_on_all_links_and_of_no_other() -> None:
    width = round(MEAN_S / PERIOD_S)
    both = (sample("outer", 100.0), sample("outer", 20.0, "hand"), sample("inner", 70.0), sample("torso", 500.0))
    series = pressed([both] * width)
    assert obstacle_track._largest_mean(series, "outer") == pytest.approx(120.0)
    assert obstacle_track._largest_mean(series, "inner") == pytest.approx(70.0)
    assert obstacle_track._forces(series, "outer").max() == pytest.approx(120.0)


def energy_counted(peak_s: float, touches: Touches) -> float:
    """Energy found where it is 7 J at one instant and 1 J else."""
    series = touching(FINE, touches)
    energy = np.where(np.abs(FINE - peak_s) < 0.5 * PERIOD_S, 7.0, 1.0)
    return obstacle_track._impact_energy(replace(series, truth=replace(series.truth, kinetic_energy=energy)))


@pytest.mark.parametrize("obstacle", ["outer", "inner"])
def test_the_energy_of_impacts_is_the_largest_near_a_touch(obstacle: str) -> None:
    touches = [(0.5, obstacle), (1.5, obstacle)]
    for near in (0.5, 0.5 - IMPACT_S, 0.5 + IMPACT_S, 1.5):
        assert energy_counted(near, touches) == 7.0
    for elsewhere in (0.1, 0.5 - IMPACT_S - PERIOD_S, 0.5 + IMPACT_S + PERIOD_S, 1.0):
        assert energy_counted(elsewhere, touches) == 1.0


def test_without_an_obstacles_touch_there_is_no_impact() -> None:
    assert energy_counted(0.5, []) == 0.0
    assert energy_counted(0.5, [(0.5, "torso")]) == 0.0


# --- bars


def test_a_run_within_all_limits_passes() -> None:
    found = measured(TRACKED)
    assert found.passed
    metrics = found.metrics
    assert metrics["laps_done"] == pytest.approx(4.0, abs=0.01)
    assert metrics["error_max_xyz_m"] == pytest.approx([0.002] * 3)
    assert metrics["error_rms_xyz_m"] == pytest.approx([0.002] * 3)
    assert metrics["contacts_by_obstacle"] == {"outer": 2.0, "inner": 1.0}
    assert metrics["links_touched"] == [ELBOW]
    assert metrics["contact_force_max_n"] == pytest.approx({"outer": 500.0, "inner": 500.0})
    assert metrics["torque_commanded_over_limit_max"] == pytest.approx(0.5)
    assert metrics["torque_applied_over_limit_max"] == pytest.approx(0.6)


@pytest.mark.parametrize("when", [2.0, 9.0, 22.0 - 0.02])
@pytest.mark.parametrize(("axis", "name"), [(1, "error_max_y_m"), (2, "error_max_z_m")])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_error_at_one_cycle_of_the_track_fails(when: float, axis: int, name: str, sign: float) -> None:
    # At its ends an error along the circle takes a part of a lap as well.
    assert failing(off(when, axis, sign * 0.021)) - {"laps_done"} == {name}
    within = off(when, axis, sign * 0.95 * ERROR_M)
    assert failing(within) <= {"laps_done"}
    expected = [0.95 * ERROR_M if other == axis else 0.002 for other in range(3)]
    assert measured(within).metrics["error_max_xyz_m"] == pytest.approx(expected)


def test_before_and_after_the_track_errors_do_not_count() -> None:
    assert failing(off(2.0 - 0.02, 1, 0.5)) == failing(off(22.0, 2, 0.5)) == set()


def test_an_error_is_taken_between_the_same_cycles() -> None:
    trace = TRACKED.trace
    later = replace(
        trace,
        **{
            name: getattr(trace, name)[30:]
            for name in ("sequence", "time_s", "phase", "hand_desired", "orientation_desired", "torque_commanded")
        },
    )
    assert measured(replace(TRACKED, trace=later)).metrics == measured(TRACKED).metrics


def test_the_orientations_error_is_the_largest_on_the_track() -> None:
    orientation = TRACKED.truth.hand_orientation.copy()
    orientation[at(9.0)] = (-np.cos(0.1), 0.0, np.sin(0.1), 0.0)
    orientation[at(1.0)] = (0.0, 1.0, 0.0, 0.0)
    series = replace(TRACKED, truth=replace(TRACKED.truth, hand_orientation=orientation))
    assert measured(series).metrics["orientation_error_max_rad"] == pytest.approx(0.2)


def test_a_lap_that_is_missing_fails() -> None:
    until = at(18.0)
    hand = TRACKED.truth.hand.copy()
    hand[until:] = hand[until]
    series = replace(
        TRACKED,
        truth=replace(TRACKED.truth, hand=hand),
        trace=replace(TRACKED.trace, hand_desired=hand + 0.002),
    )
    found = measured(series)
    assert {bar.name for bar in found.bars if not bar.holds} == {"laps_done"}
    assert found.metrics["laps_done"] == pytest.approx(3.2, abs=0.01)


def touched(touches: Touches) -> set[str]:
    contacts = touching(TIME, touches).truth.contacts
    return failing(replace(TRACKED, truth=replace(TRACKED.truth, contacts=contacts)))


def test_too_few_contacts_fail() -> None:
    assert touched([(5.0, "outer"), (6.0, "inner"), (6.1, "inner"), (7.0, "torso")]) == {"contacts"}
    assert touched([]) == {"contacts"}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_over_its_limit_at_one_cycle_fails(sign: float) -> None:
    commanded = TRACKED.trace.torque_commanded.copy()
    applied = TRACKED.truth.motor_torque_substeps.copy()
    commanded[at(9.0), 3] = sign * 1.01 * LIMITS[3]
    applied[at(9.0), 2, 5] = sign * 1.01 * LIMITS[5]
    over = replace(TRACKED, trace=replace(TRACKED.trace, torque_commanded=commanded))
    assert failing(over) == {"torque_commanded_over_limit_max"}
    over = replace(TRACKED, truth=replace(TRACKED.truth, motor_torque_substeps=applied))
    assert failing(over) == {"torque_applied_over_limit_max"}
