"""Which tasks a tick has: the schedule's targets, without stiffness while yielding, hybrid while the hand gives way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller_service.dual_compliance import Compliance
from controller_service.force_tasks import HybridPoseTask, WrenchReference
from controller_service.hand_control import HandForces
from controller_service.model import Array, Configuration, RobotModel
from controller_service.schedule import Targets
from controller_service.task_set import TaskSet
from controller_service.tasks import (
    InertialPostureTask,
    OrientationTask,
    PoseTarget,
    PoseTask,
    PositionTask,
    PostureTarget,
    PostureTask,
)
from controller_service.wrench import HandWrench
from schemas.controller import ControllerConfig, TaskGains
from schemas.load import Robot

POSTURE = {"stiffness": 30.0, "damping": 9.0, "weight": 2.0}
HAND = {"stiffness": 400.0, "damping": 40.0, "weight": 500.0}
PUSH = np.array([12.0, -5.0, 30.0, 1.0, 0.5, -2.0])
FORCE = {"sensor": "wrist", "admittance": {"force_gain": 0.01, "directions": [False, False, True, True, True, True]}}


def task_set(frame: str | None = "hand", **changes: Any) -> TaskSet:
    data = {
        "posture": POSTURE,
        "hand": HAND,
        "phases": [{"name": "x", "mode": "torque", "duration_s": 1.0}],
    } | changes
    return TaskSet(frame, ControllerConfig.model_validate(data))


@pytest.fixture
def now(arm: Robot) -> Configuration:
    rng = np.random.default_rng(81)
    return RobotModel(arm, ("hand",)).configure(rng.uniform(-1, 1, 9), rng.normal(size=9))


@pytest.fixture
def targets(now: Configuration) -> Targets:
    rng = np.random.default_rng(82)
    hand = PoseTarget(rng.normal(size=3), np.eye(3), *rng.normal(size=(2, 6)))
    return Targets(PostureTarget(*rng.normal(size=(3, 9))), hand)


def forces(active: bool) -> HandForces:
    rng = np.random.default_rng(83)
    measured = HandWrench(PUSH, rng.normal(size=6), 0)
    return HandForces(measured, WrenchReference(*rng.normal(size=(2, 6))), Compliance(active, False, False), active)


def same(one: tuple[Array, Array], other: tuple[Array, Array]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_posture_and_hand_with_the_configured_gains(now: Configuration, targets: Targets) -> None:
    posture, hand = task_set().make(now, targets)
    assert (type(posture), type(hand)) == (PostureTask, PoseTask)
    assert same(posture.linear(), PostureTask(now, targets.posture, TaskGains.model_validate(POSTURE)).linear())
    assert targets.hand is not None
    assert same(hand.linear(), PoseTask(now, "hand", targets.hand, TaskGains.model_validate(HAND)).linear())
    assert (posture.weight, hand.weight) == (2.0, 500.0)


def test_without_a_hand_target_or_a_hand_the_posture_is_alone(now: Configuration, targets: Targets) -> None:
    assert len(task_set().make(now, replace(targets, hand=None))) == 1
    assert len(task_set(None).make(now, targets)) == 1
    assert task_set().jacobian(now, replace(targets, hand=None)) is None
    assert task_set(None).jacobian(now, targets) is None


@pytest.mark.parametrize(
    ("name", "kind", "rows"),
    [
        ("pose", PoseTask, slice(0, 6)),
        ("position", PositionTask, slice(0, 3)),
        ("orientation", OrientationTask, slice(3, 6)),
    ],
)
def test_the_jacobian_has_the_hand_task_s_rows(
    now: Configuration, targets: Targets, name: str, kind: type[PoseTask], rows: slice
) -> None:
    tasks = task_set(hand_task=name)
    _, hand = tasks.make(now, targets)
    found = tasks.jacobian(now, targets)
    assert type(hand) is kind
    assert found is not None
    assert np.array_equal(found.jacobian, now.frames["hand"].jacobian[rows])
    assert np.array_equal(found.rate, now.frames["hand"].jacobian_rate[rows])
    assert np.array_equal(found.jacobian, hand.linear()[0])


def test_with_null_space_the_posture_is_met_in_the_metric_of_the_configuration(
    now: Configuration, targets: Targets
) -> None:
    for null_space, kind in (
        ({}, InertialPostureTask),
        ({"posture_metric": "joint"}, PostureTask),
        (None, PostureTask),
    ):
        posture, _ = task_set(null_space=null_space).make(now, targets)
        assert type(posture) is kind


@pytest.mark.parametrize("null_space", [None, {}])
def test_yielding_leaves_the_damping_alone(
    now: Configuration, targets: Targets, null_space: dict[str, Any] | None
) -> None:
    """K_p = 0 in all tasks and targets at rest: neither place nor path counts, while damping and weights stay."""
    tasks = task_set(null_space=null_space)
    assert targets.hand is not None
    elsewhere = Targets(
        replace(targets.posture, position=targets.posture.position + 1.0, velocity=np.ones(9)),
        replace(targets.hand, position=targets.hand.position - 1.0, rotation=now.frames["hand"].rotation),
    )
    pairs = zip(tasks.make(now, targets, yielding=True), tasks.make(now, elsewhere, yielding=True), strict=True)
    assert all(same(one.linear(), other.linear()) for one, other in pairs)
    posture, hand = tasks.make(now, targets, yielding=True)
    soft = [TaskGains.model_validate(gains | {"stiffness": 0.0}) for gains in (POSTURE, HAND)]
    still = targets.at_rest()
    assert still.hand is not None
    expected = PostureTask(now, still.posture, soft[0]).linear()[1]
    A, b = posture.linear()
    assert np.allclose(np.linalg.solve(A, b), expected)
    assert same(hand.linear(), PoseTask(now, "hand", still.hand, soft[1]).linear())
    assert (posture.weight, hand.weight) == (2.0, 500.0)
    stiff = tasks.make(now, targets)
    assert not any(same(one.linear(), other.linear()) for one, other in zip(stiff, (posture, hand), strict=True))


def test_the_hand_task_is_hybrid_while_the_hand_gives_way(now: Configuration, targets: Targets) -> None:
    """Along z force is controlled, ẍ += K_p^f (F − Fʳ) without stiffness; along x and y the pose, as with no force."""
    tasks = task_set(hand_force=FORCE)
    felt = forces(active=True)
    _, plain = tasks.make(now, targets, forces=forces(active=False))
    _, hybrid = tasks.make(now, targets, forces=felt)
    assert type(plain) is PoseTask
    assert isinstance(hybrid, HybridPoseTask)
    assert (hybrid.measured, hybrid.reference) == (felt.measured, felt.reference)
    A, b = hybrid.linear()
    J, bare = plain.linear()
    assert np.allclose(A[:2], np.sqrt(500.0) * J[:2])
    assert np.allclose(b[:2], np.sqrt(500.0) * bare[:2])
    hand, target = now.frames["hand"], targets.hand
    assert target is not None
    expected = 40.0 * (target.velocity - hand.velocity) + target.acceleration - hand.drift
    expected = expected + 0.01 * (felt.measured.wrench - felt.reference.wrench)
    expected = expected + 1e-7 * (felt.measured.rate - felt.reference.rate)
    assert np.allclose(b[2], np.sqrt(10000.0) * expected[2])


def test_the_hybrid_task_has_the_rows_of_the_hand_task(now: Configuration, targets: Targets) -> None:
    _, hybrid = task_set(hand_force=FORCE, hand_task="position").make(now, targets, forces=forces(active=True))
    _, whole = task_set(hand_force=FORCE).make(now, targets, forces=forces(active=True))
    for rows, all_rows in zip(hybrid.linear(), whole.linear(), strict=True):
        assert np.array_equal(rows, all_rows[:3])


def test_a_force_without_force_control_changes_nothing(now: Configuration, targets: Targets) -> None:
    _, hand = task_set().make(now, targets, forces=forces(active=True))
    assert type(hand) is PoseTask
