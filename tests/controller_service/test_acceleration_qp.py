"""The QP of a tick: torque limits always, the hand's wrench, conflicts relaxed and named, failure raised."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.optimize import linprog

from controller_service.acceleration_qp import AccelerationQp, ReferenceMotion
from controller_service.collision import CollisionModel
from controller_service.constraints import JointLimits
from controller_service.daqp_solver import DaqpSolver
from controller_service.errors import QpError
from controller_service.force_tasks import WrenchVariables
from controller_service.law import inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import QpSolution
from controller_service.tasks import PoseTarget, PoseTask, PostureTarget, PostureTask, Task
from schemas.control_law import CollisionAvoidance, WrenchTask
from schemas.controller import QpConfig, TaskGains
from schemas.load import Robot
from schemas.robot import Capsule

GAINS = TaskGains(stiffness=100.0, damping=20.0, weight=1.0)
HAND_GAINS = TaskGains(stiffness=400.0, damping=40.0, weight=1000.0)
STILL = np.zeros(9)
SOLVERS = ("osqp", "daqp")
START = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
PUSH = WrenchTask(weight=3.0, force_in_world=(60.0, -40.0, 90.0), torque_in_world=(5.0, 0.0, -3.0))
CAPSULES = (
    Capsule(name="post", link="base", start_in_link=(0.25, 0, 0), end_in_link=(0.25, 0, 1.4), radius=0.05),
    Capsule(name="palm", link="hand", start_in_link=(0, 0, 0), end_in_link=(0, 0, 0.05), radius=0.04),
)


def posture(now: Configuration, to: Array) -> PostureTask:
    return PostureTask(now, PostureTarget(to, STILL, STILL), GAINS)


def reach(now: Configuration, by: Array) -> PoseTask:
    hand = now.frames["hand"]
    return PoseTask(now, "hand", PoseTarget(hand.position + by, hand.rotation, np.zeros(6), np.zeros(6)), HAND_GAINS)


def build(
    arm: Robot, solver: str = "osqp", wrench: WrenchTask | None = None, collision: CollisionModel | None = None
) -> AccelerationQp:
    variables = None if wrench is None else WrenchVariables.of("hand", 9, wrench)
    config = QpConfig.model_validate({"solver": solver, "iterations": 1000})
    return AccelerationQp(JointLimits(arm.description, 0.05), config, collision, variables)


def torque_of(now: Configuration, motion: ReferenceMotion, added: Array) -> Array:
    torque = inverse_dynamics(now, motion.acceleration) + added
    return torque if motion.wrench is None else torque - now.frames["hand"].jacobian.T @ motion.wrench


Tick = tuple[Configuration, tuple[Task, ...], Array, Array]
"""Configuration, tasks, added torque, and the part of it that drives."""


def ticks(arm: Robot, count: int, seed: int, reach_by: float = 0.3) -> Iterator[Tick]:
    model, rng = RobotModel(arm, ("hand",)), np.random.default_rng(seed)
    for _ in range(count):
        now = model.configure(rng.uniform(-1, 1, 9), 0.3 * rng.normal(size=9))
        tasks = (posture(now, rng.uniform(-2, 2, 9)), reach(now, rng.normal(scale=reach_by, size=3)))
        driving, friction = rng.normal(scale=30.0, size=9), rng.normal(scale=10.0, size=9)
        yield now, tasks, driving + friction, driving


@pytest.mark.parametrize("wrench", [None, PUSH], ids=["motion", "wrench"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_sum_of_all_torques_stays_within_limits(arm: Robot, solver: str, wrench: WrenchTask | None) -> None:
    """M q̈ʳ + h − Jᵀ Fʳ + integral + friction; some ticks are at a limit."""
    qp, at_limit = build(arm, solver, wrench), 0
    for now, tasks, added, driving in ticks(arm, 40, 21):
        motion = qp.solve(now, tasks, added, 0, driving)
        torque = torque_of(now, motion, added)
        assert (np.abs(torque) <= qp.limits.torque * (1 + 1e-5)).all()
        at_limit += int((np.abs(torque) > 0.999 * qp.limits.torque).any())
        assert (motion.wrench is None) == (wrench is None)
    assert at_limit > 10


@pytest.mark.parametrize("wrench", [None, PUSH], ids=["motion", "wrench"])
def test_both_solvers_give_the_same_motion(arm: Robot, wrench: WrenchTask | None) -> None:
    one, other = (build(arm, solver, wrench) for solver in SOLVERS)
    constrained = 0
    for now, tasks, added, driving in ticks(arm, 60, 22):
        first, second = (qp.solve(now, tasks, added, 0, driving) for qp in (one, other))
        assert np.allclose(first.acceleration, second.acceleration, atol=1e-4)
        assert first.relaxed == second.relaxed == ()
        if first.wrench is not None:
            assert np.allclose(first.wrench, second.wrench, atol=1e-3)
        constrained += first.solution.iterations > 0
    assert constrained > 20


def test_reference_and_motion_without_disturbance_keep_range_and_speed(arm: Robot) -> None:
    """q̈ʳ and q̈ʳ + M⁻¹ u_K, with only the driving part of what is added: friction compensation drives nothing."""
    qp, narrowed = build(arm), 0
    model, rng = RobotModel(arm), np.random.default_rng(25)
    for _ in range(60):
        edge = rng.choice([-1.0, 0.0, 1.0], 9, p=[0.15, 0.7, 0.15])
        left = rng.uniform(0.002, 0.03, 9)
        q = np.where(edge != 0.0, edge * (2.5 - left), rng.uniform(-1.0, 1.0, 9))
        now = model.configure(q, edge * 0.8 * left / 0.05)
        driving, friction = rng.normal(scale=25.0, size=9), rng.normal(scale=20.0, size=9)
        tasks = (posture(now, q + 0.5 * edge),)
        with_it, without = (qp.solve(now, tasks, driving + friction, 0, part) for part in (driving, None))
        caused = np.linalg.solve(now.mass, driving)
        lower, upper = qp.limits.acceleration_bounds(now)
        slack = 1e-4 * (1.0 + np.abs(lower) + np.abs(upper))
        assert with_it.relaxed == ()
        for acceleration in (with_it.acceleration, with_it.acceleration + caused, without.acceleration):
            assert (lower - slack <= acceleration).all()
            assert (acceleration <= upper + slack).all()
        free = without.acceleration + caused
        narrowed += int(((free < lower - slack) | (free > upper + slack)).any())
    assert narrowed > 5


def test_the_wrench_is_solved_as_by_a_program_written_out(arm: Robot) -> None:
    """½ Σ w‖A q̈ − b‖² + ½ w‖F − F^d‖² + ½ γ‖x‖² on [I 0; M −Jᵀ; 0 I] x, here assembled from the tasks' own A and b."""
    qp, reference = build(arm, "osqp", PUSH), DaqpSolver(15, 24, 1000, 1e-6)
    desired = np.array(PUSH.force_in_world + PUSH.torque_in_world)
    least, most = np.minimum(desired, 0.0), np.maximum(desired, 0.0)
    short = 0
    for now, tasks, added, _ in ticks(arm, 40, 23):
        J = now.frames["hand"].jacobian
        P, q = 1e-6 * np.eye(15), np.zeros(15)
        for task in tasks:
            A, b = task.linear()
            P[:9, :9] += task.weight * A.T @ A
            q[:9] -= task.weight * A.T @ b
        P[9:, 9:] += PUSH.weight * np.eye(6)
        q[9:] -= PUSH.weight * desired
        rows = np.block([[np.eye(9), np.zeros((9, 6))], [now.mass, -J.T], [np.zeros((6, 9)), np.eye(6)]])
        low, high = qp.limits.acceleration_bounds(now)
        rest = now.nonlinear + added
        lower = np.concatenate((low, -qp.limits.torque - rest, least))
        upper = np.concatenate((high, qp.limits.torque - rest, most))
        expected = reference.solve(P, q, rows, lower, upper)
        motion = qp.solve(now, tasks, added, 0)
        assert expected.solved
        assert motion.wrench is not None
        assert np.allclose(motion.acceleration, expected.x[:9], atol=1e-4)
        assert np.allclose(motion.wrench, expected.x[9:], atol=1e-3)
        short += bool(np.abs(motion.wrench - desired).max() > 0.5)
    assert short > 5


def test_with_torque_to_spare_the_wrench_is_the_desired_one_and_the_motion_knows_nothing_of_it(arm: Robot) -> None:
    small = WrenchTask(force_in_world=(3.0, -2.0, 1.0))
    now = RobotModel(arm, ("hand",)).configure(START, STILL)
    tasks = (posture(now, START + 0.01), reach(now, np.full(3, 1e-3)))
    with_it, without = (build(arm, wrench=wrench).solve(now, tasks, STILL, 0) for wrench in (small, None))
    assert with_it.wrench is not None
    assert np.allclose(with_it.wrench, [3.0, -2.0, 1.0, 0.0, 0.0, 0.0], atol=1e-5)
    assert np.allclose(with_it.acceleration, without.acceleration)
    assert without.wrench is None


@pytest.mark.parametrize("wrench", [None, PUSH], ids=["motion", "wrench"])
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("thrown", [(5,), (2, 7)])
def test_joints_thrown_at_their_limits_brake_with_all_their_torque_and_are_named(
    arm: Robot, solver: str, wrench: WrenchTask | None, thrown: tuple[int, ...]
) -> None:
    qp = build(arm, solver, wrench)
    q, v = np.zeros(9), np.zeros(9)
    q[list(thrown)], v[list(thrown)] = 2.49, 3.0
    now = RobotModel(arm, ("hand",)).configure(q, v)
    motion = qp.solve(now, (posture(now, q),), STILL, 0)
    assert motion.relaxed == tuple(f"range or speed of joint{i}" for i in thrown)
    assert motion.solution.solved
    torque = torque_of(now, motion, STILL)
    assert (np.abs(torque) <= qp.limits.torque * (1 + 1e-5)).all()
    assert torque[list(thrown)] == pytest.approx(-qp.limits.torque[list(thrown)], rel=1e-3)
    assert motion.acceleration.shape == (9,)
    lower, upper = qp.limits.acceleration_bounds(now)
    kept = np.delete(np.arange(9), thrown)
    assert (motion.acceleration >= lower - 1e-2)[kept].all()
    assert (motion.acceleration <= upper + 1e-2)[kept].all()
    # The next tick with room is not relaxed
    easy = RobotModel(arm, ("hand",)).configure(START, STILL)
    assert qp.solve(easy, (posture(easy, START),), STILL, 1).relaxed == ()


@pytest.fixture(scope="module")
def guarded(arm: Robot) -> Robot:
    changes = {"capsules": CAPSULES, "collision_pairs": (("post", "palm"),)}
    return Robot(arm.description.model_copy(update=changes), arm.urdf)


def beside(guarded: Robot, apart: float, approach: float) -> Configuration:
    """The hand `apart` [m] from the post, coming nearer at `approach` [m/s] with the least motion."""
    rigid = RobotModel(guarded, ("hand",))
    limits = JointLimits(guarded.description, 0.05)
    collision = CollisionModel(guarded, CollisionAvoidance(influence_m=1.5), rigid, limits.response_s)
    q = START
    for _ in range(60):
        gradient = collision.rows(rigid.configure(q, STILL)).A[0]
        q = q + gradient / (gradient @ gradient) * np.clip(apart - collision.distances(q)[0], -0.05, 0.05)
    gradient = collision.rows(rigid.configure(q, STILL)).A[0]
    assert collision.distances(q)[0] == pytest.approx(apart, abs=1e-6)
    return rigid.configure(q, -approach * gradient / (gradient @ gradient))


def with_collision(
    guarded: Robot, now: Configuration, solver: str = "osqp", wrench: WrenchTask | None = None
) -> tuple[AccelerationQp, Array, float]:
    """Return the program, and the gradient and bound of its one distance at a configuration."""
    limits = JointLimits(guarded.description, 0.05)
    collision = CollisionModel(guarded, CollisionAvoidance(), RobotModel(guarded), limits.response_s)
    near = collision.rows(now)
    assert near.names == (("post", "palm"),)
    return build(guarded, solver, wrench, collision), near.A[0], near.lower[0]


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_distance_is_kept_when_the_torque_allows(guarded: Robot, solver: str) -> None:
    now = beside(guarded, 0.04, 0.05)
    qp, gradient, bound = with_collision(guarded, now, solver)
    towards = np.array([0.25, 0.0, 0.0]) - now.frames["hand"].position
    towards[2] = 0.0
    tasks = (posture(now, now.position), reach(now, towards))
    kept, not_kept = (one.solve(now, tasks, STILL, 0) for one in (qp, build(guarded, solver)))
    assert kept.relaxed == not_kept.relaxed == ()
    assert gradient @ kept.acceleration == pytest.approx(bound, rel=1e-4)
    assert gradient @ not_kept.acceleration < bound - 1.0


def test_the_motion_without_disturbance_keeps_the_distance_too(guarded: Robot) -> None:
    now = beside(guarded, 0.04, 0.05)
    qp, gradient, bound = with_collision(guarded, now)
    tasks = (posture(now, now.position - 2.0 * gradient),)
    driving = -30.0 * gradient / np.linalg.norm(gradient)
    caused = gradient @ np.linalg.solve(now.mass, driving)
    assert caused < -0.5
    assert gradient @ qp.solve(now, tasks, driving, 0).acceleration == pytest.approx(bound)
    assert gradient @ qp.solve(now, tasks, driving, 0, driving).acceleration == pytest.approx(bound - caused)
    # What leads away gives no leave to go nearer
    assert gradient @ qp.solve(now, tasks, -driving, 0, -driving).acceleration == pytest.approx(bound)


@pytest.mark.parametrize("wrench", [None, PUSH], ids=["motion", "wrench"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_distance_that_no_torque_can_keep_is_relaxed_and_named(
    guarded: Robot, solver: str, wrench: WrenchTask | None
) -> None:
    now = beside(guarded, 0.022, 1.0)
    qp, gradient, bound = with_collision(guarded, now, solver, wrench)
    motion = qp.solve(now, (posture(now, now.position),), STILL, 0)
    assert motion.relaxed == ("distance post to palm",)
    assert motion.solution.solved
    assert gradient @ motion.acceleration < bound - 1.0
    torque = torque_of(now, motion, STILL)
    assert (np.abs(torque) <= qp.limits.torque * (1 + 1e-5)).all()
    # The hardest braking that torques and joints allow, as a linear program over [q̈; F]
    J, lower, upper = now.frames["hand"].jacobian, *qp.limits.acceleration_bounds(now)
    desired = wrench.force_in_world + wrench.torque_in_world if wrench else (0.0,) * 6
    force = [(min(value, 0.0), max(value, 0.0)) for value in desired]
    sides = np.vstack((np.hstack((now.mass, -J.T)), np.hstack((-now.mass, J.T))))
    room = np.concatenate((qp.limits.torque - now.nonlinear, qp.limits.torque + now.nonlinear))
    bounds = [*zip(lower, upper, strict=True), *force]
    best = linprog(np.append(-gradient, np.zeros(6)), A_ub=sides, b_ub=room, bounds=bounds)
    assert gradient @ motion.acceleration == pytest.approx(-best.fun, rel=0.05)


def test_both_solvers_relax_alike(guarded: Robot) -> None:
    now = beside(guarded, 0.022, 1.0)
    programs = [with_collision(guarded, now, solver)[0] for solver in SOLVERS]
    one, other = (qp.solve(now, (posture(now, STILL),), STILL, 0) for qp in programs)
    assert one.relaxed == other.relaxed
    assert np.allclose(one.acceleration, other.acceleration, rtol=1e-3, atol=1e-2)


def test_an_unsolved_program_raises(arm: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    qp = build(arm)
    failed = QpSolution(STILL, np.zeros(18), 7, "maximum iterations reached", 0.5, 0.25)

    class Failing:
        def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
            return failed

    monkeypatch.setattr(qp, "_solver", Failing())
    now = RobotModel(arm).configure(STILL, STILL)
    # The relaxed program is still there to answer
    assert qp.solve(now, (posture(now, STILL),), STILL, 41).solution.solved
    monkeypatch.setattr(qp, "_relaxing", Failing())
    with pytest.raises(QpError, match="state 42") as caught:
        qp.solve(now, (posture(now, STILL),), STILL, 42)
    assert (caught.value.sequence, caught.value.status) == (42, "maximum iterations reached")
    assert (caught.value.primal_residual, caught.value.dual_residual) == (0.5, 0.25)
