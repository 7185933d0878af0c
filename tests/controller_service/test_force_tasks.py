"""Hybrid control and the wrench task: rows, sums, a wall of springs, the program with F^r as a variable."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from controller_service.daqp_solver import DaqpSolver
from controller_service.force_tasks import HybridGains, HybridPoseTask, WrenchReference, WrenchVariables
from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import QpSolution, objective
from controller_service.tasks import FRAME_TASKS, PoseTarget, PoseTask, PostureTarget, PostureTask
from controller_service.wrench import HandWrench
from schemas.control_law import Admittance, WrenchTask
from schemas.controller import TaskGains
from schemas.errors import ConfigurationError
from schemas.load import Robot

POSE = TaskGains(stiffness=100.0, damping=20.0, weight=400.0)
ALL, NONE = (True,) * 6, (False,) * 6
MIXED = (True, False, False, False, True, False)
START = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
PERIOD = 0.002


@pytest.fixture(scope="module")
def rigid(arm: Robot) -> RobotModel:
    return RobotModel(arm, ("hand",))


@pytest.fixture(scope="module")
def now(rigid: RobotModel) -> Configuration:
    rng = np.random.default_rng(5)
    return rigid.configure(rng.uniform(-1, 1, 9), rng.normal(size=9))


@pytest.fixture(scope="module")
def target() -> PoseTarget:
    rng = np.random.default_rng(6)
    return PoseTarget(rng.normal(size=3), pin.exp3(0.5 * rng.normal(size=3)), rng.normal(size=6), rng.normal(size=6))


@pytest.fixture(scope="module")
def felt() -> HandWrench:
    rng = np.random.default_rng(7)
    return HandWrench(20.0 * rng.normal(size=6), 300.0 * rng.normal(size=6), 0)


@pytest.fixture(scope="module")
def wanted() -> WrenchReference:
    rng = np.random.default_rng(8)
    return WrenchReference(20.0 * rng.normal(size=6), 300.0 * rng.normal(size=6))


def admittance(directions: tuple[bool, ...], **changes: float) -> Admittance:
    gains = {"force_gain": 0.02, "force_rate_gain": 3e-4, "torque_gain": 0.5, "torque_rate_gain": 7e-3, "weight": 900.0}
    return Admittance.model_validate({"directions": directions} | gains | changes)


def test_without_force_directions_it_is_the_pose_task(
    now: Configuration, target: PoseTarget, wanted: WrenchReference, felt: HandWrench
) -> None:
    hybrid = HybridPoseTask(now, "hand", target, HybridGains.of(POSE, admittance(NONE)), wanted, felt)
    systems = []
    for task in (hybrid, PoseTask(now, "hand", target, POSE)):
        P, q = np.zeros((9, 9)), np.zeros(9)
        task.add_to(P, q)
        systems.append((P, q))
    assert systems[0][0] == pytest.approx(systems[1][0], rel=1e-12)
    assert systems[0][1] == pytest.approx(systems[1][1], rel=1e-12)


def test_each_direction_is_controlled_by_pose_or_by_force(
    now: Configuration, target: PoseTarget, wanted: WrenchReference, felt: HandWrench
) -> None:
    """The acceleration that meets the rows, by direction: (7), (8) or damping and (27)."""
    task = HybridPoseTask(now, "hand", target, HybridGains.of(POSE, admittance(MIXED)), wanted, felt)
    A, b = task.linear()
    frame = now.frames["hand"]
    reached = frame.jacobian @ np.linalg.lstsq(A, b, rcond=None)[0] + frame.drift
    error = np.concatenate((target.position - frame.position, pin.log3(target.rotation @ frame.rotation.T)))
    common = 20.0 * (target.velocity - frame.velocity) + target.acceleration
    kp, kv = np.array([0.02] * 3 + [0.5] * 3), np.array([3e-4] * 3 + [7e-3] * 3)
    by_force = common - kp * (wanted.wrench - felt.wrench) - kv * (wanted.rate - felt.rate)
    assert reached == pytest.approx(np.where(MIXED, by_force, common + 100.0 * error))
    assert np.linalg.norm(A, axis=1) == pytest.approx(
        np.where(MIXED, 30.0, 20.0) * np.linalg.norm(frame.jacobian, axis=1)
    )


def test_its_part_of_the_objective_is_the_square_of_its_rows(
    now: Configuration, target: PoseTarget, wanted: WrenchReference, felt: HandWrench
) -> None:
    for rows in (task.rows for task in FRAME_TASKS.values()):
        task = HybridPoseTask(now, "hand", target, HybridGains.of(POSE, admittance(MIXED)), wanted, felt, rows)
        A, b = task.linear()
        assert A.shape == (len(b), 9)
        assert len(b) == rows.stop - rows.start
        P, q = objective((task,), 9, 0.0)
        x = np.random.default_rng(1).normal(size=9)
        cost = 0.5 * task.weight * (np.sum((A @ x - b) ** 2) - b @ b)
        assert 0.5 * x @ P @ x + q @ x == pytest.approx(cost)


def test_two_tasks_on_one_jacobian_take_the_mean_where_the_hybrid_takes_the_sum(
    now: Configuration, target: PoseTarget, wanted: WrenchReference, felt: HandWrench
) -> None:
    """Pose without stiffness and admittance as rows of their own halve both; so the task sums their objectives."""
    equal = admittance(ALL, weight=POSE.weight)
    gains = HybridGains.of(POSE, equal)
    damping = replace(gains, force=np.zeros(6), force_rate=np.zeros(6))
    force = replace(gains, damping=0.0)
    still = PoseTarget(target.position, target.rotation, target.velocity, np.zeros(6))
    frame = now.frames["hand"]

    def reached(*parts: HybridGains) -> Array:
        P, q = objective([HybridPoseTask(now, "hand", still, part, wanted, felt) for part in parts], 9, 1e-9)
        return frame.jacobian @ np.linalg.solve(P, -q) + frame.drift

    d, f = reached(damping), reached(force)
    assert reached(damping, force) == pytest.approx(0.5 * (d + f), abs=1e-5)
    assert reached(gains) == pytest.approx(d + f, abs=1e-5)


def test_damping_without_weight_of_the_admittance_leaves_the_direction_free(
    now: Configuration, target: PoseTarget, wanted: WrenchReference, felt: HandWrench
) -> None:
    task = HybridPoseTask(now, "hand", target, HybridGains.of(POSE, admittance(ALL, weight=0.0)), wanted, felt)
    P, q = objective((task,), 9, 0.0)
    assert not P.any()
    assert not q.any()


def test_the_reference_of_the_next_tick_has_its_finite_difference() -> None:
    first = WrenchReference.zero().after(np.arange(6.0), 0.002)
    assert first.rate == pytest.approx(500.0 * np.arange(6.0))
    assert first.after(np.arange(6.0), 0.002).rate == pytest.approx(np.zeros(6))


def test_on_a_wall_of_springs_the_force_converges_as_the_gains_say_and_the_rest_holds(rigid: RobotModel) -> None:
    """Perfect execution of q̈ʳ: on k the error obeys ë + (K_v + K_v^f k) ė + K_p^f k e = 0."""
    stiffness, push, gain, rate_gain = 4000.0, 12.0, 0.05, 1e-3
    by_force = (True, False, False, False, False, False)
    gains = HybridGains.of(
        TaskGains(stiffness=400.0, damping=40.0, weight=1e6),
        admittance(by_force, force_gain=gain, force_rate_gain=rate_gain, weight=1e6),
    )
    still = TaskGains(stiffness=0.0, damping=5.0, weight=1e-3)
    q, v, zero = START.copy(), np.zeros(9), np.zeros(9)
    begin = rigid.configure(q, v).frames["hand"]
    wall = begin.position[0]
    """The wall pushes the hand towards +x where it is below this."""
    goal = PoseTarget(begin.position, begin.rotation, np.zeros(6), np.zeros(6))
    wanted = WrenchReference(np.array([push, 0, 0, 0, 0, 0]), np.zeros(6))
    last, forces, worst = np.zeros(6), [], 0.0
    for _ in range(1200):
        now = rigid.configure(q, v)
        frame = now.frames["hand"]
        wrench = np.array([stiffness * max(wall - frame.position[0], 0.0), 0, 0, 0, 0, 0])
        felt = HandWrench(wrench, (wrench - last) / PERIOD, 0)
        last = wrench
        tasks = (
            PostureTask(now, PostureTarget(START, zero, zero), still),
            HybridPoseTask(now, "hand", goal, gains, wanted, felt),
        )
        P, g = objective(tasks, 9, 1e-9)
        acceleration = np.linalg.solve(P, -g)
        q, v = q + PERIOD * (v + 0.5 * PERIOD * acceleration), v + PERIOD * acceleration
        forces.append(wrench[0])
        turned = np.linalg.norm(pin.log3(frame.rotation @ begin.rotation.T))
        worst = max(worst, float(np.abs(frame.position - begin.position)[1:].max()), float(turned))
    assert forces[-1] == pytest.approx(push, abs=1e-3)
    # The hand moved a push over k along x, and nowhere else
    assert worst < 1e-5
    half = 0.5 * (40.0 + rate_gain * stiffness)
    root = math.sqrt(half**2 - gain * stiffness)
    t = PERIOD * np.arange(1200)
    slow, fast = half - root, half + root
    expected = push * (1.0 - (fast * np.exp(-slow * t) - slow * np.exp(-fast * t)) / (fast - slow))
    assert np.abs(np.array(forces) - expected).max() < 0.03 * push


HAND_TASK = TaskGains(stiffness=0.0, damping=10.0, weight=1000.0)
REST = TaskGains(stiffness=0.0, damping=10.0, weight=1.0)


def solve_with_wrench(now: Configuration, config: WrenchTask, limit: float) -> tuple[QpSolution, Array, Array]:
    """(5) over x = [q̈; F^r] with torque limits and the bounds of F^r; the solution, u − h, and −Jᵀ."""
    variables, n = WrenchVariables.of("hand", 9, config), 9
    frame, zero = now.frames["hand"], np.zeros(6)
    P, q = np.zeros((n + 6, n + 6)), np.zeros(n + 6)
    P.flat[:: n + 7] = 1e-6
    rest = PostureTask(now, PostureTarget(now.position, np.zeros(n), np.zeros(n)), REST)
    hand = PoseTask(now, "hand", PoseTarget(frame.position, frame.rotation, zero, zero), HAND_TASK)
    for task in (rest, hand):
        task.add_to(P[:n, :n], q[:n])
    variables.add_to(P, q)
    coupling = variables.coupling(now)
    A = np.zeros((n + 6, n + 6))
    A[:n, :n], A[:n, n:], A[n:, n:] = now.mass, coupling, np.eye(6)
    lower = np.concatenate((-limit - now.nonlinear, variables.lower))
    upper = np.concatenate((limit - now.nonlinear, variables.upper))
    solution = DaqpSolver(n + 6, n + 6, 500, 1e-6).solve(P, q, A, lower, upper)
    assert solution.solved
    return solution, (A @ solution.x)[:n] + now.nonlinear, coupling


@pytest.fixture(scope="module")
def resting(rigid: RobotModel) -> Configuration:
    return rigid.configure(START, np.zeros(9))


def test_the_program_exerts_the_desired_wrench_where_nothing_hinders_it(resting: Configuration) -> None:
    config = WrenchTask(force_in_world=(12.0, -5.0, 30.0), torque_in_world=(1.0, 2.0, -3.0))
    solution, torque, _ = solve_with_wrench(resting, config, 250.0)
    wrench = np.array([12.0, -5.0, 30.0, 1.0, 2.0, -3.0])
    assert solution.x[9:] == pytest.approx(wrench, rel=1e-5)
    # At rest the motors carry the arm less what the environment carries: u = g − Jᵀ F^r
    assert solution.x[:9] == pytest.approx(np.zeros(9), abs=1e-5)
    assert torque == pytest.approx(resting.nonlinear - resting.frames["hand"].jacobian.T @ wrench, abs=1e-3)


def test_torque_limits_are_met_by_wrench_or_motion_as_the_weights_say(resting: Configuration) -> None:
    """A light wrench task gives way before the arm does; with Table I's weight the arm accelerates instead."""
    wanted, jacobian = 150.0, resting.frames["hand"].jacobian
    load = float(np.abs(solve_with_wrench(resting, WrenchTask(force_in_world=(0.0, 0.0, wanted)), 1e3)[1]).max())
    kept, moved = [], []
    for weight in (10.0, 1e-2):
        config = WrenchTask(weight=weight, force_in_world=(0.0, 0.0, wanted))
        solution, torque, coupling = solve_with_wrench(resting, config, 0.8 * load)
        assert np.abs(torque).max() == pytest.approx(0.8 * load)
        # Stationarity in F^r: w (F^r − F^d) + γ F^r − J y_u + y_F = 0
        pull = weight * (solution.x[9:] - np.array([0, 0, wanted, 0, 0, 0])) + 1e-6 * solution.x[9:]
        terms = coupling.T @ solution.dual[:9]
        assert pull + terms + solution.dual[9:] == pytest.approx(np.zeros(6), abs=1e-6 * np.abs(terms).max() + 1e-12)
        kept.append(solution.x[11])
        moved.append(np.linalg.norm(jacobian[:3] @ solution.x[:9]))
    assert wanted - 1.0 < kept[0] < wanted - 0.1
    assert kept[1] < wanted - 4.0
    assert moved[1] < 0.05 * moved[0]


def test_no_component_is_more_than_asked_for_or_of_the_other_sign(resting: Configuration) -> None:
    config = WrenchTask(force_in_world=(20.0, -30.0, 0.0), torque_in_world=(0.0, 1.0, -2.0))
    variables = WrenchVariables.of("hand", 9, config)
    assert np.array_equal(variables.upper, [20, 0, 0, 0, 1, 0])
    assert np.array_equal(variables.lower, [0, -30, 0, 0, 0, -2])
    assert variables.coupling(resting) == pytest.approx(-resting.frames["hand"].jacobian.T)


def test_the_wrench_task_fills_its_own_block_only() -> None:
    variables = WrenchVariables.of("hand", 9, WrenchTask(weight=3.0, force_in_world=(1.0, 2.0, 3.0)))
    P, q = np.ones((15, 15)), np.ones(15)
    variables.add_to(P, q)
    expected = np.ones((15, 15))
    expected[9:, 9:] += 3.0 * np.eye(6)
    assert np.array_equal(P, expected)
    assert np.array_equal(q, np.concatenate((np.ones(9), 1.0 - 3.0 * np.array([1.0, 2.0, 3.0, 0, 0, 0]))))


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (WrenchTask(force_in_world=(0.0, -250.0, 0.0)), "force_in_world is 250, beyond force_limit 200"),
        (WrenchTask(torque_in_world=(31.0, 0.0, 0.0)), "torque_in_world is 31, beyond torque_limit 30"),
    ],
)
def test_a_wrench_beyond_its_own_bounds_is_refused(config: WrenchTask, text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        WrenchVariables.of("hand", 9, config)
