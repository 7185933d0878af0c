"""Contacts: where they begin and end, by sequences of estimates."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.contact import ContactDetector, ContactState
from controller_service.errors import StateError
from controller_service.model import Array
from schemas.control_law import DisturbanceObserver
from schemas.errors import ConfigurationError
from schemas.load import Robot

PERIOD = 0.002


def detector(arm: Robot, **changes: object) -> ContactDetector:
    config = {"threshold_share": 0.1, "thresholds": {"joint2": 10.0}, "dwell_s": 0.02} | changes
    return ContactDetector(arm.description, DisturbanceObserver.model_validate(config))


def at(joint: int, value: float) -> Array:
    estimate = np.zeros(9)
    estimate[joint] = value
    return estimate


def feed(of: ContactDetector, joint: int, values: list[float]) -> list[ContactState]:
    return [of.update(at(joint, value), PERIOD) for value in values]


def letters(states: list[ContactState]) -> str:
    """b began, e ended, | active, . none."""
    return "".join("b" if s.began else "e" if s.ended else "|" if s.active else "." for s in states)


def test_thresholds_are_a_share_of_the_limit_or_the_joint_s_own(arm: Robot) -> None:
    assert detector(arm).thresholds == pytest.approx([25, 25, 10, 25, 25, 25, 8, 8, 8])


def test_an_unknown_joint_is_refused_with_the_known_ones(arm: Robot) -> None:
    with pytest.raises(ConfigurationError, match=r"observer\.thresholds: .* no joint 'wrist'.*joint0, .*joint8"):
        detector(arm, thresholds={"wrist": 3.0})


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("joint", "threshold"), [(0, 25.0), (2, 10.0), (8, 8.0)])
def test_a_contact_begins_above_the_threshold_of_any_joint(
    arm: Robot, joint: int, threshold: float, sign: float
) -> None:
    states = feed(detector(arm), joint, [sign * threshold * share for share in (0.0, 0.9, 0.999, 1.001, 2.0)])
    assert letters(states) == "...b|"
    assert (states[-1].joint, states[-1].value) == (joint, sign * 2.0 * threshold)


def test_it_ends_when_all_were_below_half_for_the_dwell_time(arm: Robot) -> None:
    states = feed(detector(arm), 2, [11.0, *[5.1] * 50, *[4.9] * 20])
    assert letters(states) == "b" + 60 * "|" + "e" + 9 * "."


def test_a_single_estimate_above_half_starts_the_dwell_time_again(arm: Robot) -> None:
    states = feed(detector(arm), 2, [11.0, *[4.0] * 9, 5.1, *[4.0] * 11])
    assert letters(states) == "b" + 20 * "|" + "e"


def test_another_joint_above_its_half_keeps_the_contact(arm: Robot) -> None:
    of = detector(arm)
    feed(of, 2, [11.0])
    assert letters(feed(of, 8, [-4.1] * 50)) == 50 * "|"
    assert letters(feed(of, 8, [-3.9] * 11)) == 10 * "|" + "e"


def test_a_threshold_passed_within_a_contact_does_not_begin_another(arm: Robot) -> None:
    assert letters(feed(detector(arm), 2, [11.0, 7.0, 11.0, 4.0, 11.0])) == "b||||"


def test_the_dwell_time_counts_time_and_not_estimates(arm: Robot) -> None:
    of = detector(arm)
    of.update(at(2, 11.0), PERIOD)
    assert not of.update(at(2, 0.0), 0.5).ended, "when it became quiet within that time is not known"
    assert of.update(at(2, 0.0), 0.02).ended


@pytest.mark.parametrize("cycles", [1, 3, 7, 10, 150, 1000])
def test_rounding_does_not_cost_a_cycle(arm: Robot, cycles: int) -> None:
    states = feed(detector(arm, dwell_s=cycles * PERIOD), 2, [11.0, *[0.0] * (cycles + 1)])
    assert letters(states) == "b" + cycles * "|" + "e"


def test_without_dwell_time_it_ends_at_once_and_may_begin_again(arm: Robot) -> None:
    assert letters(feed(detector(arm, dwell_s=0.0), 2, [11.0, 6.0, 4.0, 11.0, 4.0])) == "b|ebe"


def test_the_worst_joint_is_the_one_farthest_up_its_own_threshold(arm: Robot) -> None:
    state = detector(arm).update(np.array([20.0, 0, 9.0, 0, 0, 0, -7.9, 0, 1.0]), PERIOD)
    assert state == ContactState(active=False, began=False, ended=False, joint=6, value=-7.9)


def test_reset_forgets_a_contact(arm: Robot) -> None:
    of = detector(arm)
    feed(of, 2, [11.0, 0.0])
    of.reset()
    assert letters(feed(of, 2, [0.0, 6.0, 11.0])) == "..b"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_an_estimate_that_is_no_number_is_refused_with_its_joint(arm: Robot, value: float) -> None:
    estimate = at(5, value)
    estimate[0] = 1e6
    with pytest.raises(StateError, match="joint5"):
        detector(arm).update(estimate, PERIOD)
