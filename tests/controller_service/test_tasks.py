"""Tasks (6)-(9): error dynamics, orientation error, the assembled objective, the posture in the metric of M."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg

from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import objective
from controller_service.tasks import (
    FRAME_TASKS,
    InertialPostureTask,
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


def test_the_inertial_posture_task_s_two_forms_agree(now: Configuration) -> None:
    """AᵀA = M, Aᵀb = M q̈^ob: what it adds is w ‖A q̈ − b‖², and alone it asks for the same q̈ as the posture task."""
    target = PostureTarget(*np.random.default_rng(9).normal(size=(3, 9)))
    plain, inertial = PostureTask(now, target, GAINS), InertialPostureTask(now, target, GAINS)
    A, b = inertial.linear()
    assert np.allclose(A.T @ A, now.mass)
    P, q = np.ones((9, 9)), np.ones(9)
    inertial.add_to(P, q)
    assert np.allclose(P, 1.0 + GAINS.weight * A.T @ A)
    assert np.allclose(q, 1.0 - GAINS.weight * A.T @ b)
    wanted = np.linalg.solve(*plain.linear())
    assert np.allclose(np.linalg.solve(A, b), wanted)
    assert np.allclose(plain.linear()[1], wanted)


def beside(now: Configuration, task: type[PostureTask], weight: float) -> tuple[Array, Array]:
    """Return q̈ of posture and pose tasks together, and q̈^ob of the posture."""
    rng = np.random.default_rng(10)
    posture = task(now, PostureTarget(*rng.normal(size=(3, 9))), GAINS.model_copy(update={"weight": 1.0}))
    gains = TaskGains(stiffness=100.0, damping=20.0, weight=weight)
    pose = PoseTask(now, "hand", PoseTarget(rng.normal(size=3), np.eye(3), *rng.normal(size=(2, 6))), gains)
    P, q = objective((posture, pose), 9, 0.0)
    return np.linalg.solve(P, -q), posture._objective()


@pytest.mark.parametrize("weight", [10.0, 1e3, 1e6])
def test_beside_a_hand_task_it_costs_a_torque_of_the_hand_alone(now: Configuration, weight: float) -> None:
    """At any weight M (q̈ − q̈^ob) = Jᵀ f: 0 is the gradient M (q̈ − q̈^ob) + w Jᵀ(J q̈ − b). In the metric I it is not."""
    J = now.frames["hand"].jacobian
    motions = scipy.linalg.null_space(J)
    for task, holds in ((InertialPostureTask, True), (PostureTask, False)):
        acceleration, wanted = beside(now, task, weight)
        torque = now.mass @ (acceleration - wanted)
        assert (np.abs(motions.T @ torque).max() < 1e-6 * np.abs(torque).max()) == holds


def test_with_a_large_weight_it_is_the_dynamically_consistent_inverse(now: Configuration) -> None:
    """q̈ → q̈^ob + M⁻¹Jᵀ(J M⁻¹Jᵀ)⁻¹(b − J q̈^ob); off by about 1/w of it."""
    hand, M = now.frames["hand"], now.mass
    plus = np.linalg.solve(M, hand.jacobian.T) @ np.linalg.inv(hand.jacobian @ np.linalg.solve(M, hand.jacobian.T))
    gap = []
    for weight in (1e3, 1e4, 1e5):
        acceleration, wanted = beside(now, InertialPostureTask, weight)
        exact, _ = beside(now, InertialPostureTask, 1e9)
        expected = wanted + plus @ (hand.jacobian @ exact - hand.jacobian @ wanted)
        assert np.allclose(exact, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
        gap.append(np.linalg.norm(acceleration - expected))
    assert gap[1] < 0.2 * gap[0]
    assert gap[2] < 0.2 * gap[1]
