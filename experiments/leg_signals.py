"""What the experiments with the leg measure with: spans of phases, shifts between signals, the contact's force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from controller_service.model import Array
from controller_service.savitzky_golay import smooth
from deploy.errors import UsageError
from deploy.series import RunSeries
from experiments.hand_runs import TIME_TOLERANCE_S, common_ticks, event_of
from schemas.control_law import SineWrench
from schemas.controller import Phase
from schemas.load import Run

CONFIG: Final = "controller.position_torque"
WINDOW: Final = 80
"""Samples of the mean that smooths the true contact force: the first-order filter of section 5.1 of [Del Prete 2016],
about each sample's own time (81 samples), so without its delay."""
AFTER_S: Final = 1.0
"""From the end of an event to the sine that is judged after it."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Motion:
    """Desired and true motion of K cycles, n joints, of the same times."""

    time_s: Array
    desired: Array
    """q^d (K, n) [rad]."""
    error: Array
    """q^d − q (K, n) [rad], q the true position."""
    velocity: Array
    """(K, n) [rad/s], true."""


@dataclass(frozen=True, slots=True)
class Contact:
    """True wrench of the ground on the foot over K cycles, world axes, at the hand frame's origin; (K, 6) [N, N·m]."""

    time_s: Array
    raw: Array
    smooth: Array
    """Mean of `WINDOW` about each sample."""
    reference: Array
    """F^d."""


@dataclass(frozen=True, slots=True)
class SineSpans:
    """When a sinusoidal force is judged, first and last time [s]."""

    period_s: float
    before: tuple[float, float]
    """Whole periods up to the event, or to the end of the sine without one."""
    after: tuple[float, float] | None
    """The last whole period, at least `AFTER_S` after the event; None without one."""


def phase_span(run: Run, name: str) -> tuple[float, float]:
    """First and last time [s] of a phase.

    Raises:
        UsageError: there is none of this name, or the run ends before it does.

    """
    start_s, end_s = _times(run, name)
    if run.scenario.duration_s < end_s - TIME_TOLERANCE_S:
        raise UsageError(
            f"duration_s {run.scenario.duration_s:g} s is too short: phase {name!r}, which the experiment looks at,"
            f" ends at {end_s:g} s; --set duration_s={end_s:g} or more"
        )
    return start_s, end_s


def _times(run: Run, name: str) -> tuple[float, float]:
    """First and last time [s] of a phase, in the run or not."""
    start_s = 0.0
    for phase in run.scenario.controller.phases:
        end_s = start_s + phase.duration_s
        if phase.name == name:
            return start_s, end_s
        start_s = end_s
    raise UsageError(f"controller.phases: no phase {name!r}, which the experiment needs")


def in_span(time_s: Array, span: tuple[float, float]) -> Mask:
    """Which times (K,) lie in a span, its end left out."""
    chosen: Mask = (time_s >= span[0] - TIME_TOLERANCE_S) & (time_s < span[1] - TIME_TOLERANCE_S)
    return chosen


def motion(series: RunSeries, span: tuple[float, float], asked: RunSeries | None = None) -> Motion:
    """Take the motion of a span out of a run.

    Args:
        series: the run.
        span: first and last time [s].
        asked: the run under torque control that tells q^d, on the same clock; None: this one.

    """
    of_trace, of_truth = common_ticks(series)
    sequence = series.trace.sequence[of_trace]
    told = (series if asked is None else asked).trace
    _, of_told, of_common = np.intersect1d(told.sequence, sequence, return_indices=True)
    desired = told.offset.position_desired[of_told]
    chosen = in_span(told.time_s[of_told], span)
    rows = of_truth[of_common][chosen]
    return Motion(
        told.time_s[of_told][chosen],
        desired[chosen],
        desired[chosen] - series.truth.position[rows],
        series.truth.velocity[rows],
    )


def wrench_phase(run: Run) -> tuple[Phase, SineWrench]:
    """Find the phase in which a sinusoidal force is exerted.

    Raises:
        UsageError: there is none.

    """
    for phase in run.scenario.controller.phases:
        if phase.wrench is not None and phase.wrench.amplitude[2] > 0.0:
            return phase, phase.wrench
    raise UsageError("controller.phases: no phase with a wrench of some vertical amplitude, which the experiment needs")


def sine_spans(run: Run, event: str | None = None) -> SineSpans:
    """Find the whole periods of the sinusoidal force in a run, and those after an event.

    Raises:
        UsageError: no such phase or event, or no whole period before or after it.

    """
    phase, wrench = wrench_phase(run)
    start_s, end_s = _times(run, phase.name)
    period_s = 1.0 / wrench.frequency_hz
    begin_s, end_s = start_s + wrench.ramp_s, min(end_s - wrench.ramp_s, run.scenario.duration_s)
    last_s = end_s
    if event is not None:
        last_s = event_of(run, event).start_s
    periods = int((last_s - begin_s + TIME_TOLERANCE_S) / period_s)
    if periods < 1:
        raise UsageError(f"controller.phases.{phase.name}: no whole period of its sine ends before {last_s:g} s")
    before = (begin_s, begin_s + periods * period_s)
    if event is None:
        return SineSpans(period_s, before, None)
    whole_s = begin_s + int((end_s - begin_s + TIME_TOLERANCE_S) / period_s) * period_s
    released_s = last_s + event_of(run, event).duration_s
    if whole_s - period_s < released_s + AFTER_S - TIME_TOLERANCE_S:
        raise UsageError(
            f"plant.world.events: {event!r} ends at {released_s:g} s; the last whole period of the sine, from"
            f" {whole_s - period_s:g} s on, must begin {AFTER_S:g} s after that or later"
        )
    return SineSpans(period_s, before, (whole_s - period_s, whole_s))


def contact(series: RunSeries) -> Contact:
    """Sum the true contacts of the hand frame's link over the cycles that trace and truth have in common.

    Raises:
        UsageError: the robot has no hand frame.

    """
    description = series.run.robot.description
    link = description.hand_frame
    if link is None:
        raise UsageError(f"robot {description.name} has no hand_frame, whose contact the experiment measures")
    of_trace, of_truth = common_ticks(series)
    raw = np.zeros((len(of_truth), 6))
    for row, index in zip(raw, of_truth.tolist(), strict=True):
        for sample in series.truth.contacts[index]:
            if sample.link == link:
                force = np.array(sample.force_in_world)
                arm = np.array(sample.position_in_world) - series.truth.hand[index]
                row[:3] += force
                row[3:] += np.cross(arm, force)
    return Contact(
        series.trace.time_s[of_trace],
        raw,
        smooth(raw, WINDOW, 1, description.period_s),
        series.trace.wrench_reference[of_trace],
    )


def best_shift(signal: Array, reference: Array, period_s: float, reach_s: float) -> float:
    """Time [s] by which a signal is late: the shift with the least squared difference to its reference.

    Signals (K, n) are compared less their means, every column in units of its reference's deviation; between samples
    the minimum is that of a parabola. Columns without motion are left out. Positive: the signal comes later. NaN: the
    best of those tried is the largest or the least of them, so that there is none.

    Args:
        signal: (K, n).
        reference: (K, n), of the same times.
        period_s: between samples.
        reach_s: largest shift that is tried.

    """
    reach = round(reach_s / period_s)
    deviation = reference.std(axis=0)
    moving = deviation > 0.0
    unit = deviation[moving]
    one, other = signal[:, moving] / unit, reference[:, moving] / unit
    inner = other[reach : len(other) - reach]
    inner = inner - inner.mean(axis=0)
    costs = []
    for shift in range(-reach, reach + 1):
        part = one[reach + shift : len(one) - reach + shift]
        costs.append(float(np.mean((part - part.mean(axis=0) - inner) ** 2)))
    best = int(np.argmin(costs))
    if not 0 < best < 2 * reach:
        return float("nan")
    left, middle, right = costs[best - 1 : best + 2]
    curve = left - 2.0 * middle + right
    return (best - reach + (0.5 * (left - right) / curve if curve > 0.0 else 0.0)) * period_s


def rms(error: Array) -> Array:
    """Root mean square (n,) of errors (K, n)."""
    value: Array = np.sqrt(np.mean(error**2, axis=0))
    return value
