"""The controller in closed loop with a small plant: transitions, tracking, holding, refusals, repeatability."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from controller_service.controller import Stage
from controller_service.errors import StateError
from schemas.base import ControlMode
from schemas.messages import ControllerTrace, HalStatus, JointCommand

GAINS: dict[str, Any] = {
    "lambda": 20.0,
    "velocity_cutoff_hz": 80.0,
    "hand": {"stiffness": 900, "damping": 60, "weight": 1000},
}
THERE_AND_BACK = GAINS | {
    "phases": [
        {"name": "settle", "mode": "position", "duration_s": 0.2},
        {"name": "torque", "mode": "torque", "duration_s": 0.2},
        {"name": "back", "mode": "position", "duration_s": 0.2},
    ]
}
ROUGH = {"coulomb": 0.04, "viscous": 0.0005, "torque_scale": 0.9, "mass_scale": 1.0 + 0.1 * np.resize([1, -1], 9)}
UP, DOWN = 100, 200
"""Sequences at which the phases of `THERE_AND_BACK` change."""


def test_the_transition_takes_two_ticks_and_no_torque_step(loop_of: Callable[..., Any]) -> None:
    loop = loop_of(THERE_AND_BACK, **ROUGH)
    stages = []
    for _ in range(DOWN + 3):
        loop.cycle()
        stages.append(loop.controller.stage)
    assert stages[UP - 1 : UP + 2] == [Stage.POSITION, Stage.CAPTURE, Stage.TORQUE]
    capture, first = loop.commands[UP], loop.commands[UP + 1]
    assert capture.mode is ControlMode.POSITION
    assert capture.position == pytest.approx(loop.commands[UP - 1].position, abs=1e-9)
    assert (first.mode, first.position) == (ControlMode.TORQUE, None)
    given = loop.torques[UP]
    assert np.abs((np.array(first.torque) - given) / loop.plant.limit).max() < 1e-3
    trace = loop.traces[UP + 1]
    assert np.allclose(np.array(trace.torque_reference) + trace.torque_integral, trace.torque_commanded)
    assert np.abs(trace.torque_integral).max() > 1.0  # friction, masses and scale are not the model's
    steps = np.abs(np.diff(loop.torques, axis=0) / loop.plant.limit).max(axis=1)
    assert steps[UP - 1 : UP + 4].max() < 0.01
    moved = np.abs(np.array(loop.positions[UP : DOWN - 1]) - loop.positions[UP - 1]).max()
    assert np.degrees(moved) < 0.5


def test_the_naive_transition_steps_ten_times_more(loop_of: Callable[..., Any]) -> None:
    def step(config: dict[str, Any]) -> float:
        loop = loop_of(config, **ROUGH).go(UP + 4)
        return float(np.abs(np.diff(loop.torques, axis=0) / loop.plant.limit)[UP - 1 :].max())

    assert step(THERE_AND_BACK | {"initialize_integral": False}) > 10.0 * step(THERE_AND_BACK)


def test_back_to_position_the_first_target_is_the_measured_position(loop_of: Callable[..., Any]) -> None:
    loop = loop_of(THERE_AND_BACK, **ROUGH).go(DOWN + 90)
    command, trace = loop.commands[DOWN], loop.traces[DOWN]
    assert command.mode is ControlMode.POSITION
    assert command.position == trace.position_estimated
    targets = np.array([command.position for command in loop.commands[DOWN:]])
    assert np.abs(np.diff(targets, axis=0)).max() < 1e-4
    assert np.degrees(np.abs(np.array(loop.positions[DOWN:]) - loop.positions[DOWN - 1]).max()) < 0.5


def test_the_hand_tracks_a_circle_despite_friction_masses_and_torque_scale(loop_of: Callable[..., Any]) -> None:
    path = {"shape": "circle", "plane": "yz", "diameter_m": 0.2, "lap_s": 2.0}
    phases = [*THERE_AND_BACK["phases"][:2], {"name": "path", "mode": "torque", "duration_s": 2.0, "hand_path": path}]
    loop = loop_of(GAINS | {"phases": phases}, **ROUGH).go(1200)
    errors = [
        np.subtract(trace.hand_desired.position_in_world, trace.hand_estimated.position_in_world)
        for trace in loop.traces
        if trace.phase == "path"
    ]
    assert len(errors) == 1000
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 0.003
    assert all(trace.qp_status == "solved" and trace.qp_primal_residual <= 1e-6 for trace in loop.traces)


def test_position_mode_is_an_open_loop_that_reaches_the_posture(loop_of: Callable[..., Any]) -> None:
    goal = {"joint3": -0.5, "joint5": -0.9}
    phases = [
        {"name": "reach", "mode": "position", "duration_s": 0.8, "posture": goal},
        {"name": "stay", "mode": "position", "duration_s": 0.4},
    ]
    loop = loop_of(GAINS | {"phases": phases}, **ROUGH).go(600)
    reached = np.array(loop.commands[-1].position)
    assert reached[[3, 5]] == pytest.approx([-0.5, -0.9], abs=2e-3)
    assert np.allclose(loop.commands[0].position, loop.positions[0], atol=1e-2)
    targets = np.array([command.position for command in loop.commands])
    assert np.abs(np.diff(targets, n=2, axis=0)).max() / 0.002**2 < 20.0
    other = loop_of(GAINS | {"phases": phases}).go(600)
    assert all(a.position == b.position for a, b in zip(loop.commands, other.commands, strict=True))


def test_without_integral_the_error_stays(loop_of: Callable[..., Any]) -> None:
    loop = loop_of(THERE_AND_BACK | {"integral": "none"}, **ROUGH).go(DOWN)
    assert not any(any(trace.torque_integral) or any(trace.velocity_error) for trace in loop.traces)


def test_while_the_hal_holds_the_answer_is_its_own_target_and_then_it_starts_there(loop_of: Callable[..., Any]) -> None:
    loop = loop_of(THERE_AND_BACK, **ROUGH)
    loop.status = lambda k: HalStatus.SAFE_STOP if 120 <= k < 140 else HalStatus.ACTIVE
    loop.go(120)
    held = tuple(loop.plant.position.tolist())
    stages = []
    for _ in range(30):
        if 120 <= loop.sequence < 140:
            loop.applied = loop.applied.model_copy(
                update={"sequence": -1, "mode": ControlMode.POSITION, "position": held, "torque": None}
            )
        loop.cycle()
        stages.append(loop.controller.stage)
    assert all(command.position == held for command in loop.commands[120:140])
    assert all(command.mode is ControlMode.POSITION for command in loop.commands[120:140])
    assert stages[19:23] == [Stage.HOLD, Stage.CAPTURE, Stage.TORQUE, Stage.TORQUE]
    steps = np.abs(np.diff(loop.torques[140:], axis=0) / loop.plant.limit).max(axis=1)
    assert steps.max() < 0.02


def test_torque_limits_hold_whatever_the_tasks_want(loop_of: Callable[..., Any]) -> None:
    wild = THERE_AND_BACK | {"hand": {"stiffness": 900, "damping": 60, "weight": 0}}
    wild["posture"] = {"stiffness": 2000, "damping": 60, "weight": 1}
    wild["phases"] = [
        THERE_AND_BACK["phases"][0],
        {"name": "fling", "mode": "torque", "duration_s": 0.3, "posture": {"joint5": 1.5, "joint3": 1.5}},
    ]
    loop = loop_of(wild | {"qp": {"iterations": 1000}}).go(260)
    torques = np.array([command.torque for command in loop.commands if command.torque is not None])
    assert (np.abs(torques) <= loop.plant.limit).all()
    assert (np.abs(torques) > 0.99 * loop.plant.limit).any()


def test_a_limit_that_cannot_be_kept_is_in_every_trace_but_told_once_a_second(loop_of: Callable[..., Any]) -> None:
    """Somebody stronger than its motor turns joint 5 beyond its range and keeps it there."""
    phases = [THERE_AND_BACK["phases"][0], {"name": "torque", "mode": "torque", "duration_s": 9.0}]
    loop = loop_of(GAINS | {"phases": phases}).go(UP + 20)
    plant = loop.plant
    for k in range(1600):
        angle = min(-1.2 + 0.006 * k, 2.7)
        plant.external[5] = 8000.0 * (angle - plant.position[5]) - 300.0 * plant.velocity[5]
        loop.cycle()
    name = "range or speed of joint5"
    relaxed = [trace.sequence for trace in loop.traces if name in trace.relaxed]
    assert len(relaxed) > 800
    assert relaxed[-1] == loop.sequence - 1
    told = [event for event in loop.controller.drain_events() if event.text.startswith(name)]
    assert [event.sequence for event in told] == [relaxed[0], *[at for at in (relaxed[0] + 500,) if at in relaxed]]
    assert {(event.kind, event.severity) for event in told} == {("constraint_relaxed", "warning")}
    torques = np.array([command.torque for command in loop.commands if command.torque is not None])
    assert (np.abs(torques) <= plant.limit).all()
    assert np.allclose(torques[-200:, 5], -plant.limit[5], rtol=1e-3)


def test_same_states_same_answers_to_the_bit_and_valid_messages(loop_of: Callable[..., Any]) -> None:
    one, other = (loop_of(THERE_AND_BACK, **ROUGH).go(150) for _ in range(2))
    assert [c.model_dump_json() for c in one.commands] == [c.model_dump_json() for c in other.commands]
    assert [t.model_dump_json() for t in one.traces] == [t.model_dump_json() for t in other.traces]
    for command, trace in zip(one.commands, one.traces, strict=True):
        assert JointCommand.model_validate_json(command.model_dump_json()) == command
        assert ControllerTrace.model_validate_json(trace.model_dump_json()) == trace


def test_a_lost_state_does_not_disturb_the_reference(loop_of: Callable[..., Any]) -> None:
    phases = [{"name": "reach", "mode": "position", "duration_s": 0.4, "posture": {"joint5": -0.9}}]
    whole, gap = loop_of(GAINS | {"phases": phases}), loop_of(GAINS | {"phases": phases})
    whole.go(150)
    gap.go(100)
    gap.sequence += 1
    gap.go(49)
    assert gap.commands[-1].position == pytest.approx(whole.commands[-1].position, abs=1e-4)


def test_states_that_cannot_be_answered_are_refused(loop_of: Callable[..., Any]) -> None:
    loop = loop_of(THERE_AND_BACK).go(3)
    state = loop.state()
    with pytest.raises(StateError, match="state 2 came after state 2"):
        loop.controller.step(state.model_copy(update={"sequence": 2}))
    with pytest.raises(StateError, match="8 positions"):
        loop.controller.step(state.model_copy(update={"position_measured": state.position_measured[:8]}))
    with pytest.raises(StateError, match="no motor torque"):
        loop_of(THERE_AND_BACK, report_torque=False).go(UP + 2)
    with pytest.raises(StateError, match="joint0 is nan"):
        loop.controller.step(state.model_copy(update={"position_measured": (float("nan"),) * 9}))


def test_servo_robots_get_position_and_torque_limit(loop_of: Callable[..., Any], arm: Any) -> None:
    joints = [
        joint.model_copy(update={"drive": joint.drive.model_copy(update={"kind": "servo"})})
        for joint in arm.description.joints
    ]
    description = arm.description.model_copy(update={"joints": tuple(joints)})
    phases = [{"name": "reach", "mode": "servo", "duration_s": 0.2, "posture": {"joint5": -1.1}}]
    loop = loop_of(GAINS | {"phases": phases}, description=description, report_torque=False).go(20)
    assert loop.commands[-1].mode is ControlMode.SERVO
    assert loop.commands[-1].torque_limit == tuple(joint.torque_limit for joint in joints)
    assert loop.commands[-1].position is not None
