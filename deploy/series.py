"""A log as arrays over the cycles: what metrics and plots are computed from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deploy.errors import ReportError
from schemas.base import ControlMode
from schemas.load import Run
from schemas.log import LogReader
from schemas.messages import (
    BusStatistics,
    ControllerTrace,
    CycleStatistics,
    Event,
    JointCommand,
    PlantTruth,
    RobotState,
)
from schemas.topics import LOAD_PREFIX, decode

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
    torque_commanded: Array
    """u (K, n) [N·m]."""
    position_reference: Array
    """(K, n) [rad]."""
    hand_desired: Array
    """(K, 3) [m] in the world; NaN without a hand task."""


@dataclass(frozen=True, slots=True)
class TruthSeries:
    """What the plant really did: K cycles, n joints, S firmware steps a cycle; K is 0 on a real robot."""

    sequence: Integers
    time_s: Array
    position: Array
    """(K, n) [rad]."""
    mode: Integers
    """(K, n) CiA 402 mode in effect during the period that ended here; 0 when the power stage was off."""
    motor_torque_substeps: Array
    """(K, S, n) [N·m]; NaN at sequence 0."""
    hand: Array
    """(K, 3) [m] in the world; NaN without a hand frame."""


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


def read_series(path: Path) -> RunSeries:
    """Read a log, whole or cut short.

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
    for record in reader.records(("state", "command", "trace", "truth", "event", "health", *loads)):
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
        position=_rows([s.position_measured for s in states], n),
        motor_torque=_rows([s.motor_torque_measured or absent for s in states], n),
    )


def trace_series(traces: list[ControllerTrace], n: int) -> TraceSeries:
    """Stack traces of n joints."""
    absent = (np.nan,) * 3
    return TraceSeries(
        sequence=np.array([t.sequence for t in traces], np.int64),
        time_s=_seconds([t.time_ns for t in traces]),
        phase=tuple(t.phase for t in traces),
        torque_mode=np.array([t.mode is ControlMode.TORQUE for t in traces], np.bool_),
        torque_reference=_rows([t.torque_reference for t in traces], n),
        torque_integral=_rows([t.torque_integral for t in traces], n),
        torque_commanded=_rows([t.torque_commanded for t in traces], n),
        position_reference=_rows([t.position_reference for t in traces], n),
        hand_desired=_rows([t.hand_desired.position_in_world if t.hand_desired else absent for t in traces], 3),
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
    return TruthSeries(
        sequence=np.array([t.sequence for t in truths], np.int64),
        time_s=_seconds([t.time_ns for t in truths]),
        position=_rows([t.position for t in truths], n),
        mode=np.array([t.mode for t in truths], np.int64).reshape(len(truths), n),
        motor_torque_substeps=torque,
        hand=_rows([hand.position_in_world if hand else absent for hand in hands], 3),
    )


def _rows(values: list[tuple[float, ...]] | list[tuple[float, float, float]], n: int) -> Array:
    return np.array(values, np.float64).reshape(len(values), n)


def _seconds(times_ns: list[int]) -> Array:
    return np.array(times_ns, np.float64) * 1e-9
