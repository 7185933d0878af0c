"""What a log says about a run, as numbers; plain functions of arrays. SI units stand in the names."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from deploy.loads import BusMetrics, bus_metrics
from deploy.series import Array, Integers, RunSeries, TraceSeries, TruthSeries
from schemas.bus_load import cycle_plan
from schemas.statistics import percentile

CSP = 8
CST = 10
DEVIATION_WINDOW_S = 0.3
"""After a mode change, the stretch over which the joints' deviation is taken."""


@dataclass(frozen=True, slots=True)
class ModeChange:
    """All joints' change from one mode of operation to another, from the plant's truth at the firmware's rate."""

    time_s: float
    from_mode: int
    to_mode: int
    torque_step: tuple[float, ...]
    """|first motor torque in the new mode − last in the old| over the joint's torque limit."""
    deviation_rad: tuple[float, ...]
    """Largest distance of each joint from where it stood at the change, within `DEVIATION_WINDOW_S`."""

    @property
    def largest_step(self) -> float:
        """The largest step over the joints, as a fraction of the limit."""
        return max(self.torque_step)


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """The summary of a run. Absent (None) is what the log does not hold."""

    scenario: str
    robot: str
    clock: str
    seed: int
    log_complete: bool
    states: int
    commands: int
    missed_commands: int
    """States without a command, the last one excepted when the run ended there."""
    warnings: int
    errors: int
    cycle_time_median_s: float | None
    """Wall clock, of the HAL's cycle, over the whole run, 2.3 % coarse as the two below (`schemas.statistics`)."""
    cycle_time_p99_s: float | None
    cycle_time_p99_9_s: float | None
    cycle_time_max_s: float | None
    real_time_factor: float | None
    late_cycles: int
    hand_error_rms_m: float | None
    hand_error_max_m: float | None
    mode_changes: tuple[ModeChange, ...]
    buses: tuple[BusMetrics, ...] = ()
    """Measured timing of each bus, where the plant simulates the wire."""
    plan_fits: bool = True
    """The buses can carry the robot's plan (`schemas.bus_load`)."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def summarize(series: RunSeries) -> RunMetrics:
    """All metrics of a run."""
    statistics = [each for each in series.statistics if each.service == "hal"]
    worst = [each.cycle_time_max_s for each in statistics]
    cycles = sum(each.cycles for each in statistics)
    wall_s = sum(
        each.cycles * series.run.robot.description.period_s / each.real_time_factor
        for each in statistics
        if each.real_time_factor > 0.0
    )
    errors = tracking_error(series.trace, series.truth)
    limits = np.array([joint.torque_limit for joint in series.run.robot.description.joints])
    scenario = series.run.scenario
    return RunMetrics(
        scenario=scenario.name,
        robot=series.run.robot.description.name,
        clock=str(scenario.clock),
        seed=scenario.seed,
        log_complete=series.complete,
        states=len(series.state.sequence),
        commands=len(series.command_sequence),
        missed_commands=missed_commands(series.state.sequence, series.command_sequence),
        warnings=sum(event.severity == "warning" for event in series.events),
        errors=sum(event.severity == "error" for event in series.events),
        cycle_time_median_s=percentile(statistics, 50.0),
        cycle_time_p99_s=percentile(statistics, 99.0),
        cycle_time_p99_9_s=percentile(statistics, 99.9),
        cycle_time_max_s=max(worst) if worst else None,
        real_time_factor=cycles * series.run.robot.description.period_s / wall_s if wall_s > 0.0 else None,
        late_cycles=sum(each.late_cycles for each in statistics),
        hand_error_rms_m=float(np.sqrt(np.mean(errors**2))) if errors.size else None,
        hand_error_max_m=float(errors.max()) if errors.size else None,
        mode_changes=mode_changes(series.truth, limits),
        buses=bus_metrics(series.run.robot.description, series.bus_statistics),
        plan_fits=cycle_plan(series.run.robot.description).fits,
    )


def missed_commands(states: Integers, commands: Integers) -> int:
    """Count states without a command; a last state that nobody had time to answer does not count."""
    unanswered = np.setdiff1d(states, commands)
    return int(np.count_nonzero(unanswered < states.max(initial=-1)))


def tracking_error(trace: TraceSeries, truth: TruthSeries) -> Array:
    """Distances (M,) [m] between desired and true hand at the same SYNC, while a path is followed in torque mode.

    A path is followed in the phases in which the desired position moves.
    """
    common, of_trace, of_truth = np.intersect1d(trace.sequence, truth.sequence, return_indices=True)
    if not common.size:
        return np.empty(0)
    chosen = path_phases(trace)[of_trace]
    error = np.linalg.norm(trace.hand_desired[of_trace] - truth.hand[of_truth], axis=1)
    return np.asarray(error[chosen & np.isfinite(error)], np.float64)


def path_phases(trace: TraceSeries) -> npt.NDArray[np.bool_]:
    """Mask (K,) of the ticks in torque mode whose phase moves the hand's desired position by more than 1 mm."""
    chosen = np.zeros(len(trace.sequence), np.bool_)
    phases = np.array(trace.phase)
    for phase in dict.fromkeys(trace.phase):
        ticks = (phases == phase) & trace.torque_mode & np.isfinite(trace.hand_desired).all(axis=1)
        if ticks.any() and np.ptp(trace.hand_desired[ticks], axis=0).max() > 1e-3:
            chosen |= ticks
    return chosen


def mode_changes(truth: TruthSeries, torque_limit: Array) -> tuple[ModeChange, ...]:
    """Find the changes between modes of powered drives; `torque_limit` (n,) [N·m]."""
    if len(truth.sequence) < 2:
        return ()
    before, after = truth.mode[:-1], truth.mode[1:]
    changed = (before != after) & (before != 0) & (after != 0)
    found = []
    for k in np.flatnonzero(changed.any(axis=1)):
        joints = changed[k]
        step = np.abs(truth.motor_torque_substeps[k + 1, 0] - truth.motor_torque_substeps[k, -1]) / torque_limit
        step = np.where(joints & np.isfinite(step), step, 0.0)
        window = (truth.time_s >= truth.time_s[k]) & (truth.time_s <= truth.time_s[k] + DEVIATION_WINDOW_S)
        deviation = np.abs(truth.position[window] - truth.position[k]).max(axis=0)
        first = int(np.flatnonzero(joints)[0])
        found.append(
            ModeChange(
                time_s=float(truth.time_s[k]),
                from_mode=int(before[k, first]),
                to_mode=int(after[k, first]),
                torque_step=tuple(float(value) for value in step),
                deviation_rad=tuple(float(value) for value in deviation),
            )
        )
    return tuple(found)
