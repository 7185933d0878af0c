"""A log as arrays over the cycles: what metrics and plots are computed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deploy.errors import ReportError
from deploy.offset_series import MotionSeries, OffsetSeries, motion_series, offset_series, rows
from schemas.base import ControlMode
from schemas.load import Run
from schemas.log import LogReader
from schemas.messages import (
    BusStatistics,
    ContactSample,
    ControllerTrace,
    CycleStatistics,
    Event,
    JointCommand,
    PlantTruth,
    PoseSample,
    RobotState,
)
from schemas.topics import LOAD_PREFIX, decode

__all__ = [
    "Array",
    "Integers",
    "MotionSeries",
    "OffsetSeries",
    "RunSeries",
    "StateSeries",
    "TraceSeries",
    "TruthSeries",
    "read_series",
    "state_series",
    "trace_series",
    "truth_series",
]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class StateSeries:
    """What the robot reported: K cycles, n joints."""

    sequence: Integers
    time_s: Array
    position: Array
    """(K, n) [rad], measured."""
    motor_torque: Array
    """(K, n) [N·m], measured; NaN where the drives report none."""
    wrench: Array
    """(K, 6) [N, N·m] of the first force/torque sensor, in its frame; NaN without."""
    imu: Array
    """(K, 6) angular velocity [rad/s], specific force [m/s²] of the first inertial unit, in its frame; NaN without."""
    position_applied: Array
    """(K, n) [rad] target that the drives latched at this SYNC and reach at the next; NaN in torque mode."""


@dataclass(frozen=True, slots=True)
class TraceSeries:
    """What the controller computed: K cycles, n joints."""

    sequence: Integers
    time_s: Array
    phase: tuple[str, ...]
    torque_mode: npt.NDArray[np.bool_]
    torque_reference: Array
    """uʳ (K, n) [N·m]."""
    torque_integral: Array
    """L s (K, n) [N·m]."""
    torque_windup: Array
    """u_K (K, n) [N·m] before its limit; NaN outside torque mode, as the next two."""
    torque_limited: Array
    """ũ_K (K, n) [N·m]."""
    windup_bound: Array
    """(K, n) [N·m]."""
    null_space_share: Array
    """σ (K,)."""
    admittance: npt.NDArray[np.bool_]
    torque_commanded: Array
    """u (K, n) [N·m]."""
    position_reference: Array
    """(K, n) [rad]."""
    hand_desired: Array
    """(K, 3) [m] in the world; NaN without a hand task."""
    orientation_desired: Array
    """(K, 4) quaternion (w, x, y, z); NaN without a hand task."""
    wrench_estimated: Array
    """(K, 6) [N, N·m] of the environment on the hand, world axes; NaN without."""
    wrench_reference: Array
    """(K, 6), as the above."""
    estimated: MotionSeries
    offset: OffsetSeries


@dataclass(frozen=True, slots=True)
class TruthSeries:
    """What the plant really did: K cycles, n joints, S firmware steps a cycle; K is 0 on a real robot."""

    sequence: Integers
    time_s: Array
    position: Array
    """(K, n) [rad]."""
    velocity: Array
    """(K, n) [rad/s]."""
    joint_torque: Array
    """(K, n) [N·m] motor torque and friction as they act in the substep that ended here; NaN at sequence 0."""
    mode: Integers
    """(K, n) CiA 402 mode in effect during the period that ended here; 0 when the power stage was off."""
    motor_torque_substeps: Array
    """(K, S, n) [N·m]; NaN at sequence 0."""
    hand: Array
    """(K, 3) [m] in the world; NaN without a hand frame."""
    hand_orientation: Array
    """(K, 4) quaternion (w, x, y, z); NaN without a hand frame."""
    frames: dict[str, Array]
    """(K, 3) [m] in the world of every reported frame."""
    world_forces: dict[str, Array]
    """(K, 3) [N] of every event of the world that acted, 0 while it did not."""
    contacts: tuple[tuple[ContactSample, ...], ...]
    """Of each cycle, between the robot's links and what they touch."""
    kinetic_energy: Array
    """(K,) [J]."""


@dataclass(frozen=True, slots=True)
class RunSeries:
    """All of a log that the report uses."""

    run: Run
    complete: bool
    state: StateSeries
    command_sequence: Integers
    trace: TraceSeries
    truth: TruthSeries
    events: tuple[Event, ...]
    statistics: tuple[CycleStatistics, ...]
    bus_statistics: tuple[BusStatistics, ...] = ()
    """Of all buses, in the order of writing."""


def read_series(path: Path, topics: Sequence[str] | None = None) -> RunSeries:
    """Read a log, whole or cut short.

    Args:
        path: of the log.
        topics: to read, `state` among them; what comes of the others is empty. None: all.

    Raises:
        LogError: the file is not a readable log.
        ReportError: it holds no state.

    """
    reader = LogReader(path)
    states: list[RobotState] = []
    commands: list[int] = []
    traces: list[ControllerTrace] = []
    truths: list[PlantTruth] = []
    events: list[Event] = []
    statistics: list[CycleStatistics] = []
    bus_statistics: list[BusStatistics] = []
    loads = [LOAD_PREFIX + bus.name for bus in reader.run.robot.description.buses]
    every = ("state", "command", "trace", "truth", "event", "health", *loads)
    for record in reader.records(every if topics is None else tuple(topics)):
        match record.topic:
            case "state":
                states.append(decode(RobotState, record.data))
            case "command":
                commands.append(decode(JointCommand, record.data).sequence)
            case "trace":
                traces.append(decode(ControllerTrace, record.data))
            case "truth":
                truths.append(decode(PlantTruth, record.data))
            case "event":
                events.append(decode(Event, record.data))
            case "health":
                statistics.append(decode(CycleStatistics, record.data))
            case _:
                bus_statistics.append(decode(BusStatistics, record.data))
    if not states:
        raise ReportError(f"{path}: the log holds no state; did the HAL start?")
    n = len(reader.run.robot.description.joints)
    return RunSeries(
        run=reader.run,
        complete=reader.complete,
        state=state_series(states, n),
        command_sequence=np.array(commands, np.int64),
        trace=trace_series(traces, n),
        truth=truth_series(truths, n, reader.run.robot.description.hand_frame),
        events=tuple(events),
        statistics=tuple(statistics),
        bus_statistics=tuple(bus_statistics),
    )


def state_series(states: list[RobotState], n: int) -> StateSeries:
    """Stack states of n joints."""
    absent = (np.nan,) * n
    return StateSeries(
        sequence=np.array([s.sequence for s in states], np.int64),
        time_s=_seconds([s.time_ns for s in states]),
        position=rows([s.position_measured for s in states], n),
        motor_torque=rows([s.motor_torque_measured or absent for s in states], n),
        wrench=rows([_wrench(s) for s in states], 6),
        imu=rows([_imu(s) for s in states], 6),
        position_applied=rows([s.applied.position or absent for s in states], n),
    )


def trace_series(traces: list[ControllerTrace], n: int) -> TraceSeries:
    """Stack traces of n joints."""
    absent, nothing = (np.nan,) * 3, (np.nan,) * n
    return TraceSeries(
        sequence=np.array([t.sequence for t in traces], np.int64),
        time_s=_seconds([t.time_ns for t in traces]),
        phase=tuple(t.phase for t in traces),
        torque_mode=np.array([t.mode is ControlMode.TORQUE for t in traces], np.bool_),
        torque_reference=rows([t.torque_reference for t in traces], n),
        torque_integral=rows([t.torque_integral for t in traces], n),
        torque_windup=rows([t.torque_windup or nothing for t in traces], n),
        torque_limited=rows([t.torque_limited or nothing for t in traces], n),
        windup_bound=rows([t.windup_bound or nothing for t in traces], n),
        null_space_share=np.array([t.null_space_share for t in traces], np.float64),
        admittance=np.array([t.admittance for t in traces], np.bool_),
        torque_commanded=rows([t.torque_commanded for t in traces], n),
        position_reference=rows([t.position_reference for t in traces], n),
        hand_desired=rows([t.hand_desired.position_in_world if t.hand_desired else absent for t in traces], 3),
        orientation_desired=_orientations([t.hand_desired for t in traces]),
        wrench_estimated=rows([t.wrench_estimated or (np.nan,) * 6 for t in traces], 6),
        wrench_reference=rows([t.wrench_reference or (np.nan,) * 6 for t in traces], 6),
        estimated=motion_series(traces, n),
        offset=offset_series(traces, n),
    )


def truth_series(truths: list[PlantTruth], n: int, hand_frame: str | None) -> TruthSeries:
    """Stack truths of n joints."""
    absent = (np.nan,) * 3
    substeps = max((len(t.motor_torque_substeps) for t in truths), default=0)
    torque = np.full((len(truths), substeps, n), np.nan)
    for k, truth in enumerate(truths):
        if len(truth.motor_torque_substeps) == substeps and substeps:
            torque[k] = truth.motor_torque_substeps
    hands = [t.frames.get(hand_frame) if hand_frame else None for t in truths]
    frames = truths[0].frames if truths else {}
    forces = dict.fromkeys(name for t in truths for name in t.world_forces)
    still = (0.0,) * 3
    acting = rows([t.friction_torque for t in truths], n)
    if substeps:
        acting += torque[:, -1]
    return TruthSeries(
        sequence=np.array([t.sequence for t in truths], np.int64),
        time_s=_seconds([t.time_ns for t in truths]),
        position=rows([t.position for t in truths], n),
        velocity=rows([t.velocity for t in truths], n),
        joint_torque=acting,
        mode=np.array([t.mode for t in truths], np.int64).reshape(len(truths), n),
        motor_torque_substeps=torque,
        hand=rows([hand.position_in_world if hand else absent for hand in hands], 3),
        hand_orientation=_orientations(hands),
        frames={name: rows([t.frames[name].position_in_world for t in truths], 3) for name in frames},
        world_forces={name: rows([t.world_forces.get(name, still) for t in truths], 3) for name in forces},
        contacts=tuple(t.contacts for t in truths),
        kinetic_energy=np.array([t.kinetic_energy for t in truths], np.float64),
    )


def _wrench(state: RobotState) -> tuple[float, ...]:
    if not state.wrenches:
        return (np.nan,) * 6
    return state.wrenches[0].force_in_sensor + state.wrenches[0].torque_in_sensor


def _imu(state: RobotState) -> tuple[float, ...]:
    if not state.imus:
        return (np.nan,) * 6
    return state.imus[0].angular_velocity_in_imu + state.imus[0].acceleration_in_imu


def _orientations(poses: Sequence[PoseSample | None]) -> Array:
    return rows([pose.orientation_to_world if pose else (np.nan,) * 4 for pose in poses], 4)


def _seconds(times_ns: list[int]) -> Array:
    return np.array(times_ns, np.float64) * 1e-9


def stretches(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last + 1 of each run of rows in which a mask (K,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]
