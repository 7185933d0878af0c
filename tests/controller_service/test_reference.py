"""Desired motions: derivatives, rest at the ends, closed paths."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.reference import PostureMotion, hand_motion, minimum_jerk
from schemas.controller import HandPath

STEP = 1e-5


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
