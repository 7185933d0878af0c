"""Desired motions: derivatives, rest at the ends, closed paths."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.reference import (
    JointReference,
    JointSineMotion,
    JointSpline,
    PostureMotion,
    hand_motion,
    minimum_jerk,
)
from schemas.controller import HandPath, JointPath, JointSines

STEP = 1e-5
NAMES = ("hip", "knee", "ankle")
START = np.array([0.3, -0.2, 0.1])
PATH = JointPath.model_validate(
    {
        "points": [
            {"time_s": 0.4, "posture": {"hip": 1.0}},
            {"time_s": 0.7, "posture": {"hip": 1.1, "ankle": -0.6}},
            {"time_s": 1.5, "posture": {"hip": 0.2}},
        ]
    }
)
SINES = JointSines.model_validate(
    {
        "joints": {
            "knee": {"amplitude": 0.2, "frequency_hz": 1.3},
            "ankle": {"amplitude": 0.05, "growth": 0.1, "frequency_hz": 0.7},
        },
        "fade_s": 0.5,
    }
)


def test_minimum_jerk_goes_from_rest_to_rest() -> None:
    assert minimum_jerk(-1.0, 2.0) == (0.0, 0.0, 0.0)
    assert minimum_jerk(5.0, 2.0) == (1.0, 0.0, 0.0)
    assert minimum_jerk(1.0, 2.0) == (0.5, 15.0 / 16.0, 0.0)


@pytest.mark.parametrize("time", [0.3, 1.0, 1.9])
def test_posture_derivatives(time: float) -> None:
    motion = PostureMotion(np.zeros(2), np.array([1.0, -2.0]), 2.0)
    after, now, before = motion.at(time + STEP), motion.at(time), motion.at(time - STEP)
    assert np.allclose(now.velocity, (after.position - before.position) / (2 * STEP), atol=1e-6)
    assert np.allclose(now.acceleration, (after.velocity - before.velocity) / (2 * STEP), atol=1e-6)


@pytest.mark.parametrize("shape", ["circle", "square"])
@pytest.mark.parametrize("plane", ["xy", "yz", "xz"])
@pytest.mark.parametrize("laps", [1, 2])
def test_hand_paths(shape: str, plane: str, laps: int) -> None:
    path = HandPath.model_validate({"shape": shape, "plane": plane, "diameter_m": 0.2, "lap_s": 3.0, "laps": laps})
    start, rotation = np.array([0.4, -0.3, 0.9]), np.eye(3)
    motion = hand_motion(start, rotation, path)
    for time in (0.2, 0.9, 1.4, 2.0, 2.7, 3.0 * laps - 0.4):
        after, now, before = motion.at(time + STEP), motion.at(time), motion.at(time - STEP)
        assert np.allclose(now.velocity[:3], (after.position - before.position) / (2 * STEP), atol=1e-6)
        assert np.allclose(now.acceleration, (after.velocity - before.velocity) / (2 * STEP), atol=1e-6)
        assert not now.velocity[3:].any()
    for time in (0.0, 3.0 * laps, 3.0 * laps + 1.0):
        end = motion.at(time)
        assert np.allclose(end.position, start)
        assert np.allclose(end.velocity, 0.0)
        assert np.allclose(end.acceleration, 0.0, atol=1e-9)
    points = np.array([motion.at(time).position for time in np.linspace(0.0, 3.0, 601)])
    assert np.allclose(np.sort(np.ptp(points, axis=0)), [0.0, 0.2, 0.2], atol=1e-4)


def test_no_path_holds_the_pose() -> None:
    target = hand_motion(np.ones(3), np.eye(3), None).at(7.0)
    assert np.array_equal(target.position, np.ones(3))
    assert not target.velocity.any()


def assert_derivatives(motion: JointReference, times: list[float]) -> None:
    for time in times:
        after, now, before = motion.at(time + STEP), motion.at(time), motion.at(time - STEP)
        assert np.allclose(now.velocity, (after.position - before.position) / (2 * STEP), atol=1e-6)
        assert np.allclose(now.acceleration, (after.velocity - before.velocity) / (2 * STEP), atol=1e-6)


def assert_rest(motion: JointReference, time: float, posture: list[float]) -> None:
    target = motion.at(time)
    assert target.position == pytest.approx(posture, abs=1e-12)
    assert np.abs(target.velocity).max() < 1e-9
    assert np.abs(target.acceleration).max() < 1e-7


def test_a_spline_passes_its_points_from_rest_to_rest() -> None:
    motion = JointSpline(START, PATH, NAMES)
    for time in (-1.0, 0.0):
        assert_rest(motion, time, [0.3, -0.2, 0.1])
    assert motion.at(0.4).position == pytest.approx([1.0, -0.2, 0.1])
    assert motion.at(0.7).position == pytest.approx([1.1, -0.2, -0.6])  # a joint not named stays
    for time in (1.5 - 1e-12, 1.5, 1.5 + 1e-12, 9.0):
        assert_rest(motion, time, [0.2, -0.2, -0.6])
    assert_derivatives(motion, [0.05, 0.4, 0.55, 0.7, 1.2])
    knee = np.array([motion.at(time).position[1] for time in np.linspace(0.0, 1.5, 50)])
    assert knee == pytest.approx(np.full(50, -0.2), abs=1e-12)


def test_a_spline_is_smooth_to_its_fourth_derivative_where_pieces_meet() -> None:
    """Fourth differences on both sides of a point agree; fifth ones, its jump, need not."""
    motion, step = JointSpline(START, PATH, NAMES), 1e-3

    def fourth(time: float) -> np.ndarray:
        accelerations = [motion.at(time + k * step).acceleration for k in (-1, 0, 1)]
        return (accelerations[0] - 2.0 * accelerations[1] + accelerations[2]) / step**2

    for knot in (0.4, 0.7):
        largest = max(np.abs(fourth(time)).max() for time in np.linspace(0.1, 1.4, 40))
        across = np.abs(fourth(knot + 2.0 * step) - fourth(knot - 2.0 * step)).max()
        assert across < 0.05 * largest


def test_a_spline_of_one_point_is_the_minimum_jerk_motion() -> None:
    path = JointPath.model_validate({"points": [{"time_s": 0.8, "posture": {"hip": 1.0, "knee": 0.5, "ankle": 0.0}}]})
    spline, motion = JointSpline(START, path, NAMES), PostureMotion(START, np.array([1.0, 0.5, 0.0]), 0.8)
    for time in np.linspace(0.0, 0.8, 9):
        one, other = spline.at(time), motion.at(time)
        assert one.position == pytest.approx(other.position, abs=1e-12)
        assert one.velocity == pytest.approx(other.velocity, abs=1e-10)
        assert one.acceleration == pytest.approx(other.acceleration, abs=1e-9)


def test_sines_swing_about_the_start_and_begin_and_end_at_rest() -> None:
    motion = JointSineMotion(START, SINES, NAMES, 3.0)
    for time in (-0.5, 0.0, 3.0, 4.0):
        assert_rest(motion, time, START.tolist())
    assert_derivatives(motion, [0.1, 0.3, 0.7, 1.6, 2.4, 2.6, 2.9])
    times = np.linspace(0.5, 2.5, 400)
    swing = np.array([motion.at(time).position - START for time in times])
    assert not swing[:, 0].any()
    assert swing[:, 1] == pytest.approx(0.2 * np.sin(2.0 * np.pi * 1.3 * times), abs=1e-12)
    assert swing[:, 2] == pytest.approx((0.05 + 0.1 * times) * np.sin(2.0 * np.pi * 0.7 * times), abs=1e-12)
