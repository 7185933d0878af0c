"""All parts of torque mode together: entry, terms, dual compliance, repeatability, a full trace."""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np
import pytest

from controller_service.model import RobotModel
from schemas.base import ControlMode
from schemas.load import Robot
from schemas.messages import ControllerTrace, JointCommand
from tests.controller_service.test_collision import CAPSULES, PAIRS
from tests.controller_service.test_torque_mode import GAINS, ROUGH, SHOVE, UP, LoopOf, kinds
from tests.controller_service.test_wrench import TrueSensor, with_sensor

BAR = {"name": "bar", "start_in_world": [0.3, -2, 0.7], "end_in_world": [0.4, 2, 0.9], "radius": 0.02}
PUSHED = (UP + 100, UP + 160)


def everything(robot: Robot, loop_of: LoopOf, **changes: Any) -> Any:
    """All parts of the controller on an arm with friction, sensor and capsules."""
    config = GAINS | {
        "leak": {},
        "anti_windup": {"back_calculation": 20.0},
        "null_space": {"fade_s": 0.1},
        "friction_compensation": {"smoothing_velocity": 0.4},
        "observer": {"reaction": "event", "thresholds": {"joint5": 25.0}},
        "hand_force": {
            "sensor": "wrist",
            "wrench_task": {},
            "admittance": {"force_gain": 0.5},
            "dual_compliance": {},
        },
        "collision": {"obstacles": [BAR], "influence_m": 0.3},
    }
    loop = loop_of(config | changes, description=robot.description, urdf=robot.urdf, **ROUGH)
    sensor, push = TrueSensor(robot), np.array([0.0, 14.0, -14.0, 0.0, 0.0, 0.0])

    def read(sequence: int) -> tuple[Any, ...]:
        external = push if PUSHED[0] <= sequence < PUSHED[1] else None
        return (sensor.read(loop.plant.position, loop.plant.velocity, np.zeros(9), external),)

    loop.wrenches = read
    return loop


@pytest.fixture(scope="module")
def equipped(arm: Robot) -> Robot:
    robot = with_sensor(arm)
    changes = {"capsules": CAPSULES, "collision_pairs": PAIRS}
    return Robot(robot.description.model_copy(update=changes), robot.urdf)


def test_everything_together_is_bumpless_within_limits_and_without_a_false_alarm(
    equipped: Robot, loop_of: LoopOf
) -> None:
    loop = everything(equipped, loop_of).go(UP + 400)
    steps = np.abs(np.diff(loop.torques, axis=0) / loop.plant.limit).max(axis=1)
    assert steps[UP - 1 : PUSHED[0]].max() < 0.01
    events = loop.controller.drain_events()
    assert kinds(events) == ["admittance_on", "admittance_off"]
    on, off = (event.sequence for event in events)
    assert PUSHED[0] < on < PUSHED[1] < off
    assert [trace.admittance for trace in loop.traces] == [on <= trace.sequence < off for trace in loop.traces]
    assert all(trace.qp_status == "solved" and trace.relaxed == () for trace in loop.traces)
    heights = [trace.hand_estimated.position_in_world[2] for trace in loop.traces]
    assert heights[off] < heights[PUSHED[0]] - 1e-3  # it has given way downwards, and stays there
    assert heights[-1] == pytest.approx(heights[off], abs=2e-3)
    assert loop.traces[-1].hand_desired.position_in_world[2] == pytest.approx(heights[off], abs=2e-3)


def test_the_terms_of_a_tick_are_the_law_s_and_add_up(equipped: Robot, loop_of: LoopOf) -> None:
    """uʳ = M q̈ʳ + C q̇ + g − Jᵀ Fʳ, Fʳ from the trace of the next tick; friction helps motion; the sum is commanded."""
    force = {"sensor": "wrist", "wrench_task": {"force_in_world": [8.0, -6.0, 20.0]}, "dual_compliance": {}}
    loop = everything(equipped, loop_of, hand_force=force).go(UP + 170)
    rigid = RobotModel(equipped, ("hand",))
    traces = loop.traces[UP + 2 :]
    for trace, after in itertools.pairwise(traces):
        now = rigid.configure(np.array(trace.position_estimated), np.array(trace.velocity_estimated))
        reference = now.mass @ np.array(trace.acceleration_reference) + now.nonlinear
        reference = reference - now.frames["hand"].jacobian.T @ np.array(after.wrench_reference)
        assert np.allclose(trace.torque_reference, reference)
        total = np.add(trace.torque_reference, trace.torque_integral) + trace.torque_friction
        assert np.allclose(total, trace.torque_commanded)
        assert (np.multiply(trace.torque_friction, trace.velocity_estimated) >= 0.0).all()
        assert (np.abs(trace.torque_limited) <= np.array(trace.windup_bound)).all()
    assert np.allclose(traces[-1].wrench_reference[:3], [8.0, -6.0, 20.0], atol=1e-3)
    assert np.abs([trace.torque_friction for trace in traces]).max() > 0.05


def test_the_first_torque_is_the_one_given_whatever_moves(equipped: Robot, loop_of: LoopOf) -> None:
    """Section IV-A with friction compensation and a wrench: the law's state takes up the rest."""
    loop = everything(equipped, loop_of).go(UP)
    controller, state, given = loop.controller, loop.state(), np.linspace(40.0, -30.0, 9)
    time = controller._schedule.at(UP)
    now = controller._model.configure(loop.plant.position, np.linspace(0.5, -0.5, 9))
    tick = controller._torque_mode.start(now, time, state, given)
    assert np.abs(tick.friction).max() > 1.0
    assert np.allclose(tick.torque, given)
    naive = controller._torque_mode.start(now, time, state, None)
    assert np.allclose(naive.torque, naive.reference + naive.friction)
    assert not naive.law.integral.any()


def test_a_new_entry_into_torque_mode_remembers_no_contact_and_no_push(equipped: Robot, loop_of: LoopOf) -> None:
    phases = [
        {"name": "settle", "mode": "position", "duration_s": 0.1},
        {"name": "first", "mode": "torque", "duration_s": 0.3},
        {"name": "between", "mode": "position", "duration_s": 0.2},
        {"name": "second", "mode": "torque", "duration_s": 0.3},
    ]
    loop = everything(equipped, loop_of, phases=phases)
    loop.go(PUSHED[0])
    loop.plant.external = SHOVE
    loop.go(200 - PUSHED[0])
    loop.plant.external = np.zeros(9)
    assert loop.traces[-1].contact
    assert loop.traces[-1].admittance
    loop.go(130)
    told = [event.kind for event in loop.controller.drain_events() if event.sequence > 200]
    again = [trace for trace in loop.traces[202:] if trace.mode is ControlMode.TORQUE]
    assert len(again) == 29
    assert not told
    assert not any(trace.contact or trace.admittance for trace in again)
    assert not again[0].torque_external_estimated
    assert np.abs(again[1].torque_external_estimated).max() < 2.0
    assert not any(again[1].wrench_reference)


def test_everything_together_repeats_to_the_bit_and_goes_through_json(equipped: Robot, loop_of: LoopOf) -> None:
    one, other = (everything(equipped, loop_of).go(UP + 200) for _ in range(2))
    assert [c.model_dump_json() for c in one.commands] == [c.model_dump_json() for c in other.commands]
    assert [t.model_dump_json() for t in one.traces] == [t.model_dump_json() for t in other.traces]
    assert one.controller.drain_events() == other.controller.drain_events()
    for command, trace in zip(one.commands, one.traces, strict=True):
        assert JointCommand.model_validate_json(command.model_dump_json()) == command
        assert ControllerTrace.model_validate_json(trace.model_dump_json()) == trace


def test_in_torque_mode_with_everything_on_no_field_of_the_trace_is_empty(equipped: Robot, loop_of: LoopOf) -> None:
    loop = everything(equipped, loop_of).go(UP + 10)
    data = json.loads(loop.traces[-1].model_dump_json())
    sizes = {name: len(value) for name, value in data.items() if isinstance(value, list)}
    assert sizes.pop("relaxed") == 0
    assert {name: size for name, size in sizes.items() if size != 9} == {"wrench_estimated": 6, "wrench_reference": 6}
    assert data["hand_desired"] is not None
    assert 0.0 < data["null_space_share"] < 1.0
    still = json.loads(loop.traces[UP - 1].model_dump_json())
    own = ("torque_windup", "torque_limited", "windup_bound", "torque_friction", "torque_external_estimated")
    assert all(still[name] == [] for name in (*own, "wrench_estimated", "wrench_reference"))
