"""The QP of a tick: torque limits always, conflicts relaxed and reported, failure raised."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.acceleration_qp import RELAXED, AccelerationQp
from controller_service.errors import QpError
from controller_service.law import inverse_dynamics
from controller_service.model import Array, Configuration, RobotModel
from controller_service.qp import QpSolution
from controller_service.tasks import PostureTarget, PostureTask
from schemas.controller import QpConfig, TaskGains
from schemas.load import Robot

GAINS = TaskGains(stiffness=100.0, damping=20.0, weight=1.0)
STILL = np.zeros(9)


def posture(now: Configuration, to: Array) -> PostureTask:
    return PostureTask(now, PostureTarget(to, STILL, STILL), GAINS)


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_torques_with_the_integral_term_stay_within_limits(arm: Robot, solver: str) -> None:
    qp = AccelerationQp(arm.description, QpConfig(solver=solver, iterations=1000))
    model, rng = RobotModel(arm), np.random.default_rng(21)
    for _ in range(40):
        now = model.configure(rng.uniform(-1, 1, 9), 0.3 * rng.normal(size=9))
        integral = rng.normal(scale=40.0, size=9)
        solution = qp.solve(now, (posture(now, rng.uniform(-2, 2, 9)),), integral, 0)
        torque = inverse_dynamics(now, solution.x) + integral
        assert (np.abs(torque) <= qp.limits.torque * (1 + 1e-5)).all()


def test_both_solvers_give_the_same_acceleration(arm: Robot) -> None:
    one, other = (AccelerationQp(arm.description, QpConfig(solver=s, iterations=1000)) for s in ("osqp", "daqp"))
    model, rng = RobotModel(arm), np.random.default_rng(22)
    for _ in range(40):
        now = model.configure(rng.uniform(-2.4, 2.4, 9), 0.5 * rng.normal(size=9))
        tasks = (posture(now, rng.uniform(-2, 2, 9)),)
        assert np.allclose(one.solve(now, tasks, STILL, 0).x, other.solve(now, tasks, STILL, 0).x, atol=1e-4)


def test_a_joint_thrown_at_its_limit_brakes_with_all_its_torque_and_says_so(arm: Robot) -> None:
    qp = AccelerationQp(arm.description, QpConfig())
    q, v = np.zeros(9), np.zeros(9)
    q[5], v[5] = 2.49, 3.0
    now = RobotModel(arm).configure(q, v)
    solution = qp.solve(now, (posture(now, q),), STILL, 0)
    assert solution.status.startswith(RELAXED)
    torque = inverse_dynamics(now, solution.x)
    assert (np.abs(torque) <= qp.limits.torque * (1 + 1e-5)).all()
    assert torque[5] == pytest.approx(-qp.limits.torque[5], rel=1e-3)


def test_an_unsolved_program_raises(arm: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    qp = AccelerationQp(arm.description, QpConfig())
    failed = QpSolution(STILL, np.zeros(18), 7, "maximum iterations reached", 0.5, 0.25)

    class Failing:
        def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
            return failed

    monkeypatch.setattr(qp, "_solver", Failing())
    now = RobotModel(arm).configure(STILL, STILL)
    with pytest.raises(QpError, match="state 42") as caught:
        qp.solve(now, (posture(now, STILL),), STILL, 42)
    assert (caught.value.sequence, caught.value.status) == (42, "maximum iterations reached")
    assert (caught.value.primal_residual, caught.value.dual_residual) == (0.5, 0.25)
