from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from deploy.metrics import missed_commands, mode_changes, tracking_error
from deploy.offset_series import MotionSeries, OffsetSeries
from deploy.series import TraceSeries, TruthSeries


def truth(mode: list[int], substeps: list[list[float]], position: list[float]) -> TruthSeries:
    k = len(mode)
    return TruthSeries(
        sequence=np.arange(k),
        time_s=np.arange(k) * 0.002,
        position=np.array(position)[:, None],
        velocity=np.zeros((k, 1)),
        joint_torque=np.zeros((k, 1)),
        mode=np.array(mode)[:, None],
        motor_torque_substeps=np.array(substeps)[:, :, None],
        hand=np.zeros((k, 3)),
        hand_orientation=np.tile([1.0, 0.0, 0.0, 0.0], (k, 1)),
        frames={},
        world_forces={},
        contacts=((),) * k,
        kinetic_energy=np.zeros(k),
    )


def trace(phase: list[str], torque_mode: list[bool], desired: list[list[float]]) -> TraceSeries:
    k = len(phase)
    empty = np.zeros((k, 1))
    return TraceSeries(
        sequence=np.arange(k),
        time_s=np.arange(k) * 0.002,
        phase=tuple(phase),
        torque_mode=np.array(torque_mode),
        torque_reference=empty,
        torque_integral=empty,
        torque_windup=empty,
        torque_limited=empty,
        windup_bound=empty,
        null_space_share=np.zeros(k),
        admittance=np.zeros(k, np.bool_),
        torque_commanded=empty,
        position_reference=empty,
        hand_desired=np.array(desired),
        orientation_desired=np.tile([1.0, 0.0, 0.0, 0.0], (k, 1)),
        wrench_estimated=np.zeros((k, 6)),
        wrench_reference=np.zeros((k, 6)),
        estimated=MotionSeries(0.0, *[empty] * (len(fields(MotionSeries)) - 1)),
        offset=OffsetSeries(*[empty] * len(fields(OffsetSeries))),
    )


def test_the_step_is_first_torque_in_the_new_mode_less_last_in_the_old_over_the_limit() -> None:
    series = truth([8, 8, 10, 10], [[1.0, 1.0], [1.0, 3.0], [5.0, 9.0], [9.0, 9.0]], [0.0, 0.1, 0.15, 0.1])
    (change,) = mode_changes(series, np.array([100.0]))
    assert (change.from_mode, change.to_mode) == (8, 10)
    assert change.torque_step == pytest.approx((0.02,))
    assert change.deviation_rad == pytest.approx((0.05,))
    assert change.time_s == pytest.approx(0.002)


def test_switching_the_power_stage_on_is_no_change_of_mode() -> None:
    series = truth([0, 8, 8], [[0.0, 0.0], [50.0, 50.0], [50.0, 50.0]], [0.0, 0.0, 0.0])
    assert mode_changes(series, np.array([100.0])) == ()


def test_tracking_counts_torque_mode_phases_whose_path_moves() -> None:
    moving = [[0.1, 0.0, 0.0], [0.3, 0.4, 0.0]]
    desired = trace(
        ["reach", "reach", "rest", "rest", "track", "track"],
        [False, False, True, True, True, True],
        [*moving, [9.0, 0.0, 0.0], [9.0, 0.0, 0.0], *moving],
    )
    true = truth([10] * 6, [[0.0]] * 6, [0.0] * 6)
    assert tracking_error(desired, true) == pytest.approx([0.1, 0.5])


def test_tracking_pairs_by_sequence_and_passes_over_gaps() -> None:
    desired = trace(["track"] * 3, [True] * 3, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    true = truth([10] * 3, [[0.0]] * 3, [0.0] * 3)
    later = replace(true, sequence=np.array([2, 3, 4]))
    assert tracking_error(desired, later) == pytest.approx([2.0])


def test_a_state_in_the_middle_without_command_is_missed_the_last_one_is_not() -> None:
    assert missed_commands(np.array([0, 1, 2, 3]), np.array([0, 2])) == 1
    assert missed_commands(np.array([0, 1, 2, 3]), np.array([0, 1, 2])) == 0
    assert missed_commands(np.array([0]), np.array([], np.int64)) == 0
