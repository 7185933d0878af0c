"""Torque mode in closed loop: contacts, its end, null-space compliance, what the QP is told."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from controller_service.braking import STOP_DAMPING, STOP_DECAY_S, STOP_S
from controller_service.controller import Stage
from controller_service.errors import ContactError, QpError, StateError
from controller_service.model import Array, RobotModel
from controller_service.qp import QpSolution
from schemas.base import ControlMode
from schemas.errors import ConfigurationError
from schemas.load import Robot
from schemas.messages import Event, HalStatus
from tests.controller_service.test_wrench import with_sensor

PERIOD = 0.002
GAINS: dict[str, Any] = {
    "lambda": 20.0,
    "velocity_cutoff_hz": 80.0,
    "hand": {"stiffness": 900, "damping": 60, "weight": 1000},
    "phases": [
        {"name": "settle", "mode": "position", "duration_s": 0.1},
        {"name": "torque", "mode": "torque", "duration_s": 9.0},
    ],
}
UP = 50
"""Sequence of the change of mode."""
ROUGH = {"coulomb": 0.04, "viscous": 0.0005, "torque_scale": 0.9, "mass_scale": 1.0 + 0.1 * np.resize([1, -1], 9)}
KNOWN = {"coulomb": 0.0, "viscous": 0.0, "thresholds": {"joint5": 20.0}, "dwell_s": 0.1}
"""An observer of a robot without friction."""
SHOVE = np.where(np.arange(9) == 5, 45.0, 0.0)

LoopOf = Callable[..., Any]


def kinds(events: list[Event]) -> list[str]:
    return [event.kind for event in events]


def shove(
    loop_of: LoopOf, cycles: int = 150, config: dict[str, Any] = GAINS, **observer: Any
) -> tuple[Any, list[Event], list[Array]]:
    """Make a rest, a shove at joint 5 for `cycles`, and half a second without it; positions from the shove on."""
    loop = loop_of(config | {"observer": KNOWN | observer}).go(UP + 150)
    loop.plant.external = SHOVE
    loop.go(cycles)
    loop.plant.external = np.zeros(9)
    loop.go(250)
    return loop, loop.controller.drain_events(), loop.positions[UP + 149 :]


def test_a_contact_is_told_once_with_its_joint_and_again_when_it_is_over(loop_of: LoopOf) -> None:
    loop, events, _ = shove(loop_of)
    began, ended = events
    assert kinds(events) == ["contact", "contact_ended"]
    assert (began.joint, began.severity, began.service) == ("joint5", "warning", "controller")
    # The observer's 15 1/s: 45 N·m pass 20 N·m after ln(45/25)/15 s
    assert began.sequence == pytest.approx(UP + 150 + math.log(45.0 / 25.0) / 15.0 / PERIOD, abs=4)
    assert loop.traces[began.sequence].torque_external_estimated[5] > 20.0
    assert loop.traces[began.sequence - 1].torque_external_estimated[5] <= 20.0
    assert loop.traces[UP + 299].torque_external_estimated[5] == pytest.approx(45.0, rel=0.05)
    assert [trace.contact for trace in loop.traces] == [
        began.sequence <= trace.sequence < ended.sequence for trace in loop.traces
    ]
    assert ended.sequence > UP + 300 + 50
    assert all(trace.mode is ControlMode.TORQUE for trace in loop.traces[UP + 1 :])


def test_with_reaction_none_a_contact_is_seen_in_the_trace_alone(loop_of: LoopOf) -> None:
    loop, events, positions = shove(loop_of, reaction="none")
    assert not events
    assert any(trace.contact for trace in loop.traces)
    _, _, told = shove(loop_of, reaction="event")
    assert np.array_equal(positions, told)


def test_a_compliant_robot_gives_way_while_touched_and_then_stays_where_it_is(loop_of: LoopOf) -> None:
    """The integral goes back to what it was before the shove, so nothing drives the arm back after it."""
    config = GAINS | {"anti_windup": {"back_calculation": 50.0}}
    _, _, stiff = shove(loop_of, 400, config)
    loop, events, soft = shove(loop_of, 400, config, reaction="compliant")
    assert kinds(events) == ["contact", "contact_ended"]
    untouched = events[0].sequence - (UP + 149)
    assert np.array_equal(soft[:untouched], stiff[:untouched])
    pushed = soft[400][5] - soft[0][5]
    assert pushed > 0.2
    assert pushed > 2.0 * (stiff[400][5] - stiff[0][5])
    assert stiff[-1][5] - stiff[0][5] < 0.1 * pushed
    stays = np.array(loop.positions[events[1].sequence :])
    assert np.abs(stays - stays[0]).max() < 0.2 * pushed
    assert stays[-1][5] - soft[0][5] > 0.8 * pushed
    assert np.abs(np.diff(loop.torques[UP:], axis=0) / loop.plant.limit).max() < 0.05


def test_a_contact_that_is_to_stop_the_robot_brings_it_to_rest_and_then_raises(loop_of: LoopOf) -> None:
    loop = loop_of(GAINS | {"observer": KNOWN | {"reaction": "stop"}}).go(UP + 150)
    loop.plant.external = SHOVE
    with pytest.raises(ContactError, match=r"joint5 feels .* threshold of 20\.0") as caught:
        loop.go(200)
    assert (caught.value.joint, caught.value.threshold) == ("joint5", 20.0)
    assert caught.value.torque > 20.0
    (event,) = loop.controller.drain_events()
    assert (event.kind, event.severity) == ("torque_mode_failed", "error")
    assert "joint5" in event.text
    assert loop.sequence - event.sequence == pytest.approx(STOP_S / PERIOD, abs=1)
    goes_to_gravity(loop, event.sequence)


def goes_to_gravity(loop: Any, failed: int) -> None:
    """Check that τ goes to g − `STOP_DAMPING` diag(M) q̇ by e^(−T/`STOP_DECAY_S`) a tick, within the rate limits."""
    rigid = RobotModel(loop.run.robot)
    torques = np.array([command.torque for command in loop.commands[failed - 1 :]])
    assert np.isfinite(torques).all()
    rates = np.array([joint.torque_rate_limit for joint in loop.run.robot.description.joints])
    assert (np.abs(np.diff(torques, axis=0)) <= PERIOD * rates).all()
    for before, command, trace in zip(torques[:-1], loop.commands[failed:], loop.traces[failed:], strict=True):
        velocity = np.array(trace.velocity_estimated)
        now = rigid.configure(np.array(trace.position_estimated), velocity)
        gravity = now.gravity - STOP_DAMPING * now.mass.diagonal() * velocity
        expected = gravity + math.exp(-PERIOD / STOP_DECAY_S) * (before - gravity)
        assert np.allclose(command.torque, expected)
        assert command.mode is ControlMode.TORQUE
        assert trace.qp_status == "not solved: stopping"


class Failing:
    """A solver that gives up, with nothing in its hands."""

    def solve(self, P: Array, q: Array, A: Array, lower: Array, upper: Array) -> QpSolution:
        return QpSolution(np.full(len(q), np.nan), np.full(len(lower), np.nan), 500, "maximum iterations", 9.0, 9.0)


def fail(loop: Any) -> None:
    loop.controller._qp._solver = loop.controller._qp._relaxing = Failing()


def test_a_qp_that_fails_in_torque_mode_ends_in_gravity_s_torque_and_then_raises(loop_of: LoopOf) -> None:
    """While the arm moves fast, at torques well away from gravity's."""
    config = GAINS | {"posture": {"stiffness": 300, "damping": 20, "weight": 1}}
    fling = {"name": "fling", "mode": "torque", "duration_s": 0.4, "posture": {"joint5": 0.5, "joint3": 0.8}}
    loop = loop_of(config | {"phases": [GAINS["phases"][0], fling]}, **ROUGH).go(UP + 60)
    failed = loop.sequence
    fail(loop)
    with pytest.raises(QpError, match=f"state {failed}: .*'maximum iterations'"):
        loop.go(200)
    assert loop.controller.stage is Stage.STOPPING
    assert loop.sequence - failed == pytest.approx(STOP_S / PERIOD, abs=1)
    (event,) = loop.controller.drain_events()
    assert (event.kind, event.severity, event.sequence) == ("torque_mode_failed", "error", failed)
    assert "maximum iterations" in event.text
    goes_to_gravity(loop, failed)
    speeds = [np.abs(trace.velocity_estimated).max() for trace in loop.traces[failed:]]
    assert speeds[-1] < 0.5 * max(speeds)


def test_a_qp_that_fails_before_the_drives_are_in_torque_mode_raises_at_once(loop_of: LoopOf) -> None:
    """In position mode, at the capture and at the first torque: the drives hold, no torque is commanded."""
    for ticks in (UP - 10, UP, UP + 1):
        loop = loop_of(GAINS, **ROUGH).go(ticks)
        fail(loop)
        with pytest.raises(QpError, match=f"state {ticks}"):
            loop.cycle()
        assert all(command.torque is None for command in loop.commands)
        assert not loop.controller.drain_events()


def test_a_robot_that_the_hal_holds_need_not_be_stopped(loop_of: LoopOf) -> None:
    loop = loop_of(GAINS, **ROUGH).go(UP + 50)
    fail(loop)
    loop.go(10)
    loop.status = lambda _: HalStatus.SAFE_STOP
    with pytest.raises(QpError, match=f"state {UP + 50}"):
        loop.cycle()


def test_observer_and_hand_need_what_they_measure(loop_of: LoopOf, arm: Robot) -> None:
    loop = loop_of(GAINS | {"observer": KNOWN}).go(UP + 20)
    loop.report_torque = False
    with pytest.raises(StateError, match=r"no motor torque, which controller\.observer"):
        loop.go(round(STOP_S / PERIOD) + 1)
    robot = with_sensor(arm)
    config = GAINS | {"hand_force": {"sensor": "wrist"}}
    with pytest.raises(StateError, match="wrist: no new reading"):
        loop_of(config, description=robot.description, urdf=robot.urdf).go(UP + 20 + round(STOP_S / PERIOD))


@pytest.mark.parametrize("reaction", ["event", "compliant", "stop"])
def test_thresholds_that_static_friction_alone_may_hold_are_refused(loop_of: LoopOf, reaction: str) -> None:
    """c = 0.04 N·m times 250 is 10 N·m: a contact would not end below half of 20."""
    observer = {"thresholds": {"joint5": 20.0}, "reaction": reaction}
    with pytest.raises(ConfigurationError, match=r"threshold of joint5 is 20 N·m.* raise thresholds\.joint5"):
        loop_of(GAINS | {"observer": observer})
    loop_of(GAINS | {"observer": observer | {"thresholds": {"joint5": 20.1}}})
    loop_of(GAINS | {"observer": observer | {"reaction": "none"}})


def test_a_steep_friction_compensation_is_told_at_the_entry_into_torque_mode(loop_of: LoopOf) -> None:
    def told(**config: Any) -> list[Event]:
        return list(loop_of(GAINS | {"friction_compensation": config}, **ROUGH).go(UP + 20).controller.drain_events())

    (event,) = told(smoothing_velocity=0.05)
    assert (event.kind, event.severity, event.sequence) == ("friction_compensation_steep", "warning", UP + 1)
    assert "raise smoothing_velocity" in event.text
    assert not told(smoothing_velocity=0.5)


def null_space_push(rigid: RobotModel, loop: Any, size: float) -> Array:
    """A joint torque of a norm [N·m] that does not accelerate the hand: M z with J z = 0, nearest to joint 4's axis."""
    now = rigid.configure(loop.plant.position, loop.plant.velocity)
    torques = now.mass @ scipy.linalg.null_space(now.frames["hand"].jacobian)
    torque = torques @ np.linalg.lstsq(torques, np.eye(9)[4], rcond=None)[0]
    return np.asarray(size * torque / np.linalg.norm(torque))


@pytest.mark.parametrize(
    ("plant", "leak"), [({}, None), ({"viscous": 0.0005}, {}), (ROUGH, {})], ids=["bare", "viscous", "friction"]
)
def test_in_the_null_space_the_arm_gives_way_while_the_hand_stays(
    loop_of: LoopOf, plant: dict[str, Any], leak: dict[str, Any] | None
) -> None:
    """A push of 40 N·m in the null space for a second: with the law (3) integral and posture stand against it."""

    def pushed(null_space: dict[str, Any] | None) -> tuple[float, float]:
        loop = loop_of(GAINS | {"null_space": null_space, "leak": leak}, **plant).go(UP + 150)
        rigid = RobotModel(loop.run.robot, ("hand",))
        start, hand = loop.plant.position.copy(), rigid.pose(loop.plant.position, "hand")[0]
        moved, off = [], []
        for _ in range(500):
            loop.plant.external = null_space_push(rigid, loop, 40.0)
            loop.cycle()
            moved.append(np.linalg.norm(loop.plant.position - start))
            off.append(np.linalg.norm(rigid.pose(loop.plant.position, "hand")[0] - hand))
        share = loop.traces[-1].null_space_share
        assert share == (0.0 if null_space is None else 1.0)
        return float(max(moved)), float(max(off))

    (stiff, _), (soft, off) = pushed(None), pushed({"fade_s": 0.2})
    assert soft > 0.15
    assert soft > 3.0 * stiff
    assert off < 0.003


def test_the_entry_into_the_compliant_law_is_without_a_step(loop_of: LoopOf) -> None:
    """At the change of mode, while σ grows, and when it is 1."""
    config = GAINS | {"null_space": {"fade_s": 0.2}, "leak": {}, "friction_compensation": {}}
    loop = loop_of(config, **ROUGH).go(UP + 250)
    steps = np.abs(np.diff(loop.torques, axis=0) / loop.plant.limit).max(axis=1)
    assert steps[UP - 1 :].max() < 0.01
    trace = loop.traces[UP + 1]
    given = np.array(loop.torques[UP])
    assert np.abs((np.array(trace.torque_commanded) - given) / loop.plant.limit).max() < 1e-3
    shares = [trace.null_space_share for trace in loop.traces[UP + 1 :]]
    assert shares[0] == 0.0
    assert shares[1:101] == pytest.approx(np.arange(1, 101) / 100.0)
    assert shares[-1] == 1.0
    moved = np.abs(np.array(loop.positions[UP:]) - loop.positions[UP - 1]).max()
    assert np.degrees(moved) < 0.5


def test_what_is_added_leaves_the_qp_less_of_the_torque(loop_of: LoopOf) -> None:
    """The QP knows integral and friction compensation: at a torque limit the sum needs no clipping."""
    fling = {"name": "fling", "mode": "torque", "duration_s": 0.3, "posture": {"joint5": 1.5, "joint3": 1.5}}
    config = GAINS | {
        "posture": {"stiffness": 2000, "damping": 60, "weight": 1},
        "friction_compensation": {"share": 1.0},
        "qp": {"iterations": 1000},
        "phases": [GAINS["phases"][0], fling],
    }
    loop = loop_of(config, **ROUGH).go(UP + 150)
    traces = loop.traces[UP + 1 :]
    shares = np.abs([trace.torque_commanded for trace in traces]) / loop.plant.limit
    friction = np.abs([trace.torque_friction for trace in traces]) / loop.plant.limit
    assert ((shares > 0.999) & (friction > 0.01)).any()
    assert not any("clipped" in trace.qp_status for trace in traces)


def test_the_qp_is_told_what_of_the_sum_would_move_the_robot(loop_of: LoopOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """ũ_K: the rest vanishes with the velocity, or stands against friction."""
    loop = loop_of(GAINS | {"friction_compensation": {}, "null_space": {}}, **ROUGH).go(UP + 2)
    qp, told = loop.controller._qp, []
    solve = qp.solve

    def spy(now: Any, tasks: Any, added: Array, sequence: int, driving: Array) -> Any:
        told.append((added, driving))
        return solve(now, tasks, added, sequence, driving)

    monkeypatch.setattr(qp, "solve", spy)
    loop.go(30)
    for (added, driving), trace in zip(told, loop.traces[UP + 2 :], strict=True):
        assert np.array_equal(driving, trace.torque_limited)
        assert np.allclose(added, np.add(trace.torque_integral, trace.torque_friction))
    assert np.abs(told[-1][1]).max() > 1.0
