"""Tasks (6)-(9): error dynamics, orientation error, the assembled objective."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import objective
from controller_service.tasks import (
    FRAME_TASKS,
    PoseTarget,
    PoseTask,
    PostureTarget,
    PostureTask,
    orientation_error,
)
from schemas.controller import TaskGains
from schemas.load import Robot

GAINS = TaskGains(stiffness=100.0, damping=20.0, weight=7.0)


@pytest.fixture
def now(arm: Robot) -> Configuration:
    rng = np.random.default_rng(5)
    return RobotModel(arm, ("hand",)).configure(rng.uniform(-1, 1, 9), rng.normal(size=9))


def test_the_orientation_error_turns_the_current_into_the_desired_in_world_axes() -> None:
    current = pin.exp3(np.array([0.3, -0.2, 0.9]))
    axis = np.array([0.0, 0.0, 0.4])
    error = orientation_error(pin.exp3(axis) @ current, current)
    assert np.allclose(error, axis)


def test_pose_task_asks_for_the_pd_acceleration(now: Configuration) -> None:
    frame = now.frames["hand"]
    vectors = np.random.default_rng(6).normal(size=(6, 3))
    turn = 0.5 * vectors[0]
    target = PoseTarget(vectors[1], pin.exp3(turn) @ frame.rotation, vectors[2:4].ravel(), vectors[4:6].ravel())
    A, b = PoseTask(now, "hand", target, GAINS).linear()
    acceleration = np.linalg.lstsq(A, b, rcond=None)[0]
    reached = frame.jacobian @ acceleration + frame.drift
    error = np.concatenate((target.position - frame.position, turn))
    assert np.allclose(reached, 100 * error + 20 * (target.velocity - frame.velocity) + target.acceleration)


def test_position_and_orientation_are_the_two_halves_of_a_pose(now: Configuration) -> None:
    vectors = np.random.default_rng(8).normal(size=(5, 3))
    target = PoseTarget(vectors[0], np.eye(3), vectors[1:3].ravel(), vectors[3:5].ravel())
    halves = [FRAME_TASKS[name](now, "hand", target, GAINS).linear() for name in ("position", "orientation")]
    A, b = FRAME_TASKS["pose"](now, "hand", target, GAINS).linear()
    assert [half[0].shape for half in halves] == [(3, 9), (3, 9)]
    assert np.array_equal(np.vstack([half[0] for half in halves]), A)
    assert np.array_equal(np.concatenate([half[1] for half in halves]), b)
    alone = np.linalg.lstsq(*halves[0], rcond=None)[0]
    assert not np.allclose(A[3:] @ alone, b[3:]), "the orientation stays free"


def test_objective_is_the_weighted_sum_of_squares(now: Configuration) -> None:
    rng = np.random.default_rng(7)
    posture = PostureTask(now, PostureTarget(*rng.normal(size=(3, 9))), GAINS)
    pose = PoseTask(
        now,
        "hand",
        PoseTarget(rng.normal(size=3), np.eye(3), *rng.normal(size=(2, 6))),
        TaskGains(stiffness=1.0, damping=2.0, weight=1000.0),
    )
    P, q = objective((posture, pose), 9, 1e-6)

    def cost(x: Array) -> float:
        squares = [task.weight * np.sum((task.linear()[0] @ x - task.linear()[1]) ** 2) for task in (posture, pose)]
        return float(0.5 * sum(squares) + 0.5e-6 * np.sum(x**2))

    x = rng.normal(size=9)
    assert np.isclose(0.5 * x @ P @ x + q @ x, cost(x) - cost(np.zeros(9)))
