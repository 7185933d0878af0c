"""Runs of the experiments' scenarios that never were: smooth signals of the right kind, to draw figures from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from deploy.offset_series import MotionSeries, OffsetSeries
from deploy.series import Array, RunSeries, StateSeries, TraceSeries, TruthSeries
from schemas.load import Run, load_run
from schemas.messages import ContactSample

RATE_HZ = 50
ELBOW = "elbow_pitch_link"
WITNESS = 4
"""Joint that moves in all made-up runs."""
CONTACTS = {"outer": [6.0, 10.0], "inner": [12.0]}


def made_up(scenario: str, torque: float = 10.0, way: float = 0.1, **overrides: Any) -> RunSeries:
    """A run that never was: smooth signals of the right kind over the scenario's whole time."""
    run = load_run(scenario, overrides)
    n = len(run.robot.description.joints)
    time_s = np.arange(0.0, run.scenario.duration_s, 1.0 / RATE_HZ)
    count = len(time_s)
    sequence = np.arange(count)
    swing = np.sin(2.0 * np.pi * time_s / 5.0)
    zeros, in_torque = np.zeros((count, n)), time_s >= 0.5
    hand = 0.4 + way * np.column_stack((0.0 * time_s, np.cos(2.0 * np.pi * time_s / 5.0), swing))
    position = zeros.copy()
    position[:, WITNESS] = way * swing
    upright = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    forces = {}
    for event in run.scenario.plant.world.events:
        acts = (time_s >= event.start_s) & (time_s < event.start_s + event.duration_s)
        forces[event.name] = np.outer(acts, (0.0, 20.0, 0.0))
    windup = np.where(in_torque[:, None], torque * np.abs(swing)[:, None] + zeros, np.nan)
    contacts = tuple(_contacts(time) if run.scenario.plant.world.obstacles else () for time in time_s)
    force = np.array((8.0, 0.0, 0.0)) + sum(forces.values(), start=np.zeros((count, 3)))
    trace = TraceSeries(
        sequence, time_s, tuple("hold" for _ in time_s), in_torque, zeros, zeros, windup, np.minimum(windup, 18.0),
        zeros + 18.0, np.ones(count), (time_s > 9.5) & (time_s < 12.0), zeros, zeros, hand + 0.002, upright,
        *no_position_interface(count, n),
    )  # fmt: skip
    truth = TruthSeries(
        sequence, time_s, position, zeros, zeros, zeros.astype(np.int64) + 10, np.zeros((count, 1, n)), hand, upright,
        {"hand": hand, **{name: 0.5 * hand for name in run.scenario.plant.truth_frames}}, forces, contacts, 1.0 + swing,
    )  # fmt: skip
    wrench = np.column_stack((force, np.zeros((count, 3))))
    state = StateSeries(sequence, time_s, position, zeros, wrench, wrench * np.nan, zeros * np.nan)
    return RunSeries(run, True, state, sequence, trace, truth, (), ())


def no_position_interface(count: int, n: int) -> tuple[Array, Array, MotionSeries, OffsetSeries]:
    """Wrenches, estimates and parts of Δq of a run without torque control through the position interface."""
    wrench, absent = np.full((count, 6), np.nan), np.full((count, n), np.nan)
    return wrench, wrench, MotionSeries(0.0, *(absent,) * 4), OffsetSeries(*(absent,) * 9)


def made_up_leg(run: Run, desired: Array, position: Array, **truth: Any) -> RunSeries:
    """A run of leg6 that never was, every cycle of it under torque control.

    Args:
        run: what ran.
        desired: q^d (K, n) [rad].
        position: true q (K, n) [rad].
        truth: fields of `TruthSeries` that are not zero.

    """
    count, n = desired.shape
    zeros, sequence = np.zeros((count, n)), np.arange(count)
    time_s = sequence * run.robot.description.period_s
    absent, wrench = zeros * np.nan, np.zeros((count, 6))
    upright = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    trace = TraceSeries(
        sequence, time_s, ("",) * count, np.zeros(count, np.bool_), zeros, zeros, absent, absent, absent,
        np.zeros(count), np.zeros(count, np.bool_), zeros, desired, wrench[:, :3], upright, wrench, wrench,
        MotionSeries(0.0395, *(zeros,) * 4), OffsetSeries(desired, *(zeros,) * 8),
    )  # fmt: skip
    true = TruthSeries(
        sequence, time_s, position, zeros, zeros, zeros.astype(np.int64) + 8, zeros[:, np.newaxis], wrench[:, :3],
        upright, {}, {}, ((),) * count, np.zeros(count),
    )  # fmt: skip
    state = StateSeries(sequence, time_s, position, absent, wrench, wrench, zeros)
    return RunSeries(run, True, state, sequence, trace, replace(true, **truth), (), ())


def _contacts(time_s: float) -> tuple[ContactSample, ...]:
    return tuple(
        ContactSample(link=ELBOW, other=name, force_in_world=(0.0, 300.0, 400.0), position_in_world=(0.1, -0.2, 0.3))
        for name, times in CONTACTS.items()
        if any(begin <= time_s + 1e-6 < begin + 0.2 for begin in times)
    )


def nothing_known(series: RunSeries) -> RunSeries:
    """The same run without truth and sensor, as on a robot that has neither, and not in torque mode."""
    truth, trace = series.truth, series.trace
    none = TruthSeries(
        truth.sequence[:0], truth.time_s[:0], truth.position[:0], truth.velocity[:0], truth.joint_torque[:0],
        truth.mode[:0], truth.motor_torque_substeps[:0],
        truth.hand[:0], truth.hand_orientation[:0], {}, {}, (), truth.kinetic_energy[:0],
    )  # fmt: skip
    blank = replace(
        trace,
        torque_mode=np.zeros_like(trace.torque_mode),
        admittance=np.zeros_like(trace.admittance),
        torque_windup=np.full_like(trace.torque_windup, np.nan),
        torque_limited=np.full_like(trace.torque_limited, np.nan),
        hand_desired=np.full_like(trace.hand_desired, np.nan),
    )
    return replace(series, truth=none, trace=blank, state=replace(series.state, wrench=series.state.wrench * np.nan))
