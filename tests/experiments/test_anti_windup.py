"""What the anti-windup experiment measures, on runs that never were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, RunSeries
from experiments import anti_windup
from experiments.anti_windup import (
    GROWTH,
    METHODS,
    PERSON,
    RANGE_MARGIN_RAD,
    RATIO,
    SCENARIO,
    SMALLEST_M,
    excess,
    force_swing,
    measure,
    push_times,
)
from experiments.hand_runs import WINDOW_S, stiction_band
from schemas.load import load_run
from tests.experiments.made_up_runs import made_up

RUN = load_run(SCENARIO)
PUSH = push_times(RUN)
START, RELEASE = PUSH
JOINTS = RUN.robot.description.joints
LOW = np.array([joint.position_min for joint in JOINTS])
HIGH = np.array([joint.position_max for joint in JOINTS])
LIMIT = RUN.scenario.controller.anti_windup.torque_share * np.array([joint.torque_limit for joint in JOINTS])
BAND = stiction_band(RUN)
MADE = made_up(SCENARIO)
TIME = MADE.truth.time_s
HELD = np.where((TIME > START + 0.5) & (TIME < RELEASE + 0.3), 1.0, 0.0)
"""1 from when the hand is away until it comes back."""
PLACE = np.array((0.4, 0.1, 0.2))
SATURATED, FREE = 2, 5
IN_TORQUE = MADE.trace.torque_mode


def swing(size: float) -> Array:
    """Beyond the rest by 0.4 of a size and then by 0.6 to the other side, after the way back."""
    since = TIME - RELEASE
    return size * (
        np.where((since > 0.31) & (since < 0.6), -0.4, 0.0) + np.where((since > 0.6) & (since < 0.9), 0.6, 0)
    )


@dataclass(frozen=True)
class Held:
    """A run in which the hand is held 3 cm away; `windup` is |u_K| of one joint over its limit, 0.5 in the others.

    The hand swings by `hand` [m], every joint by `joint` times its band of stiction.
    """

    windup: float = 1.0
    hand: float = 0.002
    joint: float = 0.5

    def series(self) -> RunSeries:
        share = np.full(len(JOINTS), 0.5)
        share[SATURATED] = self.windup
        limited = np.where(IN_TORQUE[:, None], -share * LIMIT, np.nan)
        away = np.outer(HELD, (0.0, 0.018, 0.024)) + np.outer(swing(self.hand), (0.0, 0.0, 1.0))
        position = 0.5 * (LOW + HIGH) + 0.02 * HELD[:, None] + np.outer(swing(self.joint), BAND)
        wrench = np.outer(np.where(TIME <= RELEASE, 60.0, swing(4.0 + 1000.0 * self.hand)), (0, 1, 0, 0, 0, 0))
        truth = replace(MADE.truth, hand=PLACE + away, position=position)
        trace = replace(
            MADE.trace,
            torque_limited=limited,
            windup_bound=np.tile(np.maximum(share, 1.0) * LIMIT, (len(TIME), 1)),
            hand_desired=np.tile(PLACE, (len(TIME), 1)),
        )
        return replace(MADE, truth=truth, trace=trace, state=replace(MADE.state, wrench=wrench))


QP = Held().series()


def of(series: RunSeries) -> dict[str, Any]:
    return measure(series, PUSH, LIMIT)


def at(time_s: float) -> int:
    """Index of the sample at a time."""
    return int(np.argmin(np.abs(TIME - time_s)))


def limited(series: RunSeries, when: float, joint: int, value: float) -> RunSeries:
    """The same run, but with one value of ũ_K [N·m]."""
    torque = series.trace.torque_limited.copy()
    torque[at(when), joint] = value
    return replace(series, trace=replace(series.trace, torque_limited=torque))


def placed(series: RunSeries, when: float, joint: int, value: float) -> RunSeries:
    """The same run, but with one value of a joint's true position [rad]."""
    position = series.truth.position.copy()
    position[at(when), joint] = value
    return replace(series, truth=replace(series.truth, position=position))


def bounded(series: RunSeries, factor: float) -> RunSeries:
    """The same run with other bounds."""
    return replace(series, trace=replace(series.trace, windup_bound=factor * series.trace.windup_bound))


def result(**others: RunSeries) -> ExperimentResult:
    """What comes of runs that keep all bars, but for those given."""
    held = {"none": Held(1.5 * GROWTH, 2.0 * RATIO * 0.002).series(), "scaling": Held().series()}
    runs = {method: others.get(method, held.get(method, QP)) for method in METHODS}
    return anti_windup._result(ExperimentRequest(3), RUN, runs)


def failing(**others: RunSeries) -> set[str]:
    return {bar.name for bar in result(**others).bars if not bar.holds}


def test_the_integral_term_counts_from_the_push_on_joint_by_joint() -> None:
    expected = np.full(len(JOINTS), 0.5)
    expected[SATURATED] = 1.0
    assert of(QP)["windup_over_limit"] == pytest.approx(expected.tolist())
    assert of(limited(QP, START - 0.1, 0, 7.0 * LIMIT[0]))["windup_over_limit"] == pytest.approx(expected.tolist())
    for when, sign in ((START, 1.0), (START, -1.0), (TIME[-1], 1.0)):
        found = of(limited(QP, when, 0, sign * 0.9 * LIMIT[0]))["windup_over_limit"]
        assert found == pytest.approx([0.9, *expected[1:]])


def test_the_bound_counts_in_all_of_torque_mode() -> None:
    assert of(QP)["windup_over_bound_max"] == pytest.approx(1.0)
    assert of(bounded(QP, 2.0))["windup_over_bound_max"] == pytest.approx(0.5)
    early = limited(QP, 0.52, FREE, -1.3 * LIMIT[FREE])
    assert of(early)["windup_over_bound_max"] == pytest.approx(1.3)


def test_the_hand_and_the_joints_oscillate_beyond_their_rest_not_on_the_way_back() -> None:
    joint = np.zeros(len(JOINTS))
    joint[FREE] = 1.0
    position = QP.truth.position[0] + np.outer(0.2 * HELD + swing(0.05), joint)
    hand = PLACE + np.outer(HELD, (0.03, 0.0, 0.0)) + np.outer(swing(0.01), (0.3, 1.0, 0.0))
    found = of(replace(QP, truth=replace(QP.truth, hand=hand, position=position)))
    assert found["hand_oscillation_m"] == pytest.approx(0.01)
    assert found["joint_oscillation_rad"] == pytest.approx((0.05 * joint).tolist())


def test_the_forces_swing_is_the_worst_components_in_its_window() -> None:
    def swung(when: float, component: int) -> float:
        wrench = np.zeros((len(TIME), 6))
        wrench[at(RELEASE + 0.5)] = (-2.0, -3.0, 1.0, 0.0, 0.0, 0.0)
        wrench[at(RELEASE + 0.7)] = (0.0, 4.0, 0.0, 0.0, 0.0, 0.0)
        wrench[at(when), component] = 50.0
        return force_swing(replace(QP, state=replace(QP.state, wrench=wrench)), RELEASE)

    assert swung(RELEASE, 1) == 7.0
    assert swung(RELEASE + WINDOW_S, 1) == 7.0
    assert swung(RELEASE + 1.0, 4) == 7.0
    assert swung(RELEASE + 0.02, 1) == 53.0
    assert swung(RELEASE + WINDOW_S - 0.02, 2) == 50.0
    assert of(QP)["force_oscillation_n"] == force_swing(QP, RELEASE) == pytest.approx(6.0)


def test_the_hand_is_measured_at_the_release_after_it_and_at_the_end() -> None:
    hand = QP.truth.hand.copy()
    hand[at(RELEASE) + 1 :] += (0.0, 0.0, 0.05)
    hand[at(9.0) :] = PLACE
    hand[-1] += (0.002, 0.0, 0.0)
    hand[: at(START)] += 0.3
    forces = {PERSON: np.zeros((len(TIME), 3))}
    forces[PERSON][at(6.0)] = (-30.0, 0.0, 40.0)
    found = of(replace(QP, truth=replace(QP.truth, hand=hand, world_forces=forces)))
    assert found["displacement_at_release_m"] == pytest.approx(0.03)
    assert found["hand_settling_time_s"] == pytest.approx(9.0 - RELEASE)
    assert found["hand_error_end_m"] == pytest.approx(0.002)
    assert found["push_force_max_n"] == pytest.approx(50.0)


def test_the_margin_to_a_joints_range_is_the_least_from_the_push_to_the_end() -> None:
    for when in (START, 6.0, TIME[-1]):
        assert of(placed(QP, when, 1, LOW[1] + 0.03))["range_margin_min_rad"] == pytest.approx(0.03)
        assert of(placed(QP, when, 4, HIGH[4] + 0.01))["range_margin_min_rad"] == pytest.approx(-0.01)
    before = placed(QP, START - 0.1, 1, LOW[1] + 0.03)
    assert of(before)["range_margin_min_rad"] == of(QP)["range_margin_min_rad"] > RANGE_MARGIN_RAD


def test_excess_is_the_largest_among_the_chosen_and_none_chosen_is_no_pass() -> None:
    one, other = np.array((1.0, 5.0, 2.0)), np.array((3.0, 1.0, 1.5))
    assert excess(one, other, np.array((True, False, True))) == 0.5
    assert excess(one, other, np.array((True, False, False))) == -2.0
    nobody = excess(one, other, np.zeros(3, np.bool_))
    assert np.isnan(nobody)
    assert not Bar("excess", nobody, 1.0).holds


def test_runs_within_all_limits_pass() -> None:
    found = result()
    assert found.passed
    assert found.metrics["joints_not_saturated"] == [
        joint.name for number, joint in enumerate(JOINTS) if number != SATURATED
    ]
    assert found.metrics["stiction_band_rad"] == BAND.tolist()
    bars = {bar.name: bar.value for bar in found.bars}
    assert bars["none_windup_over_limit_max"] == pytest.approx(1.5 * GROWTH)
    assert bars["hand_oscillation_none_over_qp"] == pytest.approx(2.0 * RATIO)
    assert found.metrics["force_oscillation_none_over_qp"] == pytest.approx(16.0 / 6.0)


def test_an_integral_term_over_its_limit_or_its_bound_at_one_cycle_fails() -> None:
    over = limited(QP, 6.0, FREE, -1.01 * LIMIT[FREE])
    assert failing(qp=bounded(over, 2.0)) == {"qp_windup_over_limit_max"}
    assert failing(qp=limited(bounded(QP, 1.0), 2.0, FREE, 1.01 * LIMIT[FREE])) == {"qp_windup_over_bound_max"}
    assert failing(qp=over) == {"qp_windup_over_limit_max", "qp_windup_over_bound_max"}
    assert failing(qp=bounded(QP, 0.99)) == {"qp_windup_over_bound_max"}
    assert failing(scaling=over, conditioned=over) == set()


def test_an_integral_term_that_is_no_number_fails() -> None:
    missing = limited(QP, 6.0, FREE, np.nan)
    assert failing(qp=missing) == {"qp_windup_over_limit_max", "qp_windup_over_bound_max"}
    assert failing(none=missing) >= {"none_windup_over_limit_max"}


def test_without_a_limit_it_must_grow() -> None:
    assert failing(none=Held(0.97 * GROWTH, 2.0 * RATIO * 0.002).series()) == {"none_windup_over_limit_max"}
    assert failing(none=Held(1.03 * GROWTH, 2.0 * RATIO * 0.002).series()) == set()


@pytest.mark.parametrize(("qp_m", "counted_m"), [(0.002, 0.002), (0.01 * SMALLEST_M, SMALLEST_M)])
def test_without_a_limit_the_hand_must_swing_more(qp_m: float, counted_m: float) -> None:
    def bars(ratio: float) -> set[str]:
        return failing(qp=Held(hand=qp_m).series(), none=Held(1.5 * GROWTH, ratio * counted_m).series())

    assert bars(1.03 * RATIO) == set()
    assert bars(0.97 * RATIO) == {"hand_oscillation_none_over_qp"}


@pytest.mark.parametrize("joint", [number for number in range(len(JOINTS)) if number != SATURATED])
def test_no_free_joint_may_swing_a_band_more_than_with_scaling(joint: int) -> None:
    def swung(bands: float, which: int) -> RunSeries:
        position = QP.truth.position.copy()
        position[:, which] += swing(bands * BAND[which])
        return replace(QP, truth=replace(QP.truth, position=position))

    assert failing(qp=swung(1.02, joint)) == {"free_joint_oscillation_excess"}
    assert failing(qp=swung(0.98, joint)) == set()
    assert failing(qp=swung(1.02, joint), scaling=swung(0.1, joint)) == set()
    assert failing(qp=swung(1.02, SATURATED)) == failing(scaling=swung(1.02, joint)) == set()


def test_where_all_joints_are_saturated_nothing_is_shown_of_the_free_ones() -> None:
    torque = np.where(IN_TORQUE[:, None], LIMIT, np.nan)
    found = result(qp=replace(QP, trace=replace(QP.trace, torque_limited=torque)))
    assert found.metrics["joints_not_saturated"] == []
    assert {bar.name for bar in found.bars if not bar.holds} == {"free_joint_oscillation_excess"}


@pytest.mark.parametrize("method", METHODS)
def test_a_joint_near_its_range_in_any_run_fails(method: str) -> None:
    held = Held(1.5 * GROWTH, 2.0 * RATIO * 0.002) if method == "none" else Held()
    near = placed(held.series(), 6.0, SATURATED, HIGH[SATURATED] - 0.9 * RANGE_MARGIN_RAD)
    assert failing(**{method: near}) == {"range_margin_min_rad"}
