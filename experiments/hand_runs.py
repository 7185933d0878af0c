"""What the experiments with the arm's hand share: runs, the error of the hand, oscillation, the force of stiction."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from controller_service.model import RobotModel
from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest
from deploy.runner import run_to_log
from deploy.series import Array, RunSeries, read_series
from plant_service.model import build, initial_position
from schemas.base import ControlMode
from schemas.controller import Phase
from schemas.load import Run, load_run
from schemas.world import WorldEvent

Mask = NDArray[np.bool_]

WINDOW_S: Final = 2.0
"""After a release: what counts as its oscillation."""
END_S: Final = 0.1
"""Last stretch of the window, whose mean is where a motion came to rest."""
TIME_TOLERANCE_S: Final = 1e-6
"""Sums of times as people write them may differ by this."""


def load(
    request: ExperimentRequest,
    scenario: str,
    own: tuple[str, ...] = (),
    *,
    own_whole: tuple[str, ...] = (),
    events: tuple[str, ...] = (),
    after_s: float = 0.0,
) -> Run:
    """Read the experiment's scenario with the request's seed and overrides, and check what the experiment needs of it.

    Args:
        request: seed and overrides.
        scenario: name of the experiment's scenario.
        own: fields that the experiment sets itself; nothing at, below or above them can be set. The seed is one.
        own_whole: fields that it sets as a whole, in some of its runs; what lies below them is the user's.
        events: names of the world's events that it looks at. They begin in torque mode, which stays.
        after_s: time [s] that is left of the run after the last of these events has let go.

    Raises:
        UsageError: an override of what the experiment sets itself, or something that it needs is missing.
        ConfigurationError: the overrides do not fit the scenario.

    """
    run = load_run(scenario, {**request.overrides, "seed": request.seed})
    for path in request.overrides:
        named = _named(path, run)
        if any(_within(named, field) or _within(field, named) for field in ("seed", *own)) or any(
            _within(field, named) for field in own_whole
        ):
            raise UsageError(f"--set {path}: the experiment sets it itself; --seed chooses the seed")
    acting = [event_of(run, name) for name in events]
    if acting:
        _check_times(run, acting, after_s)
    return run


def _named(path: str, run: Run) -> str:
    """Give a path with the name of an event of the world instead of its number."""
    field = "plant.world.events"
    number, dot, below = path.removeprefix(f"{field}.").partition(".")
    events = run.scenario.plant.world.events
    if not _within(path, field) or not number.isdigit() or int(number) >= len(events):
        return path
    return f"{field}.{events[int(number)].name}{dot}{below}"


def _within(path: str, field: str) -> bool:
    """Whether a dotted path is a field or lies below it."""
    return path == field or path.startswith(f"{field}.")


def _check_times(run: Run, events: list[WorldEvent], after_s: float) -> None:
    scenario = run.scenario
    last = max(events, key=end_of)
    needed_s = end_of(last) + after_s
    if scenario.duration_s < needed_s - TIME_TOLERANCE_S:
        raise UsageError(
            f"duration_s {scenario.duration_s:g} s is too short: event {last.name!r} ends at {end_of(last):g} s and the"
            f" experiment looks at the {after_s:g} s after it; --set duration_s={needed_s:g} or more"
        )
    first = min(events, key=lambda event: event.start_s)
    starts_s = 0.0
    for index, phase in enumerate(scenario.controller.phases):
        is_last = index == len(scenario.controller.phases) - 1
        ends_s = float("inf") if is_last else starts_s + phase.duration_s
        overlaps = starts_s < needed_s - TIME_TOLERANCE_S and ends_s > first.start_s + TIME_TOLERANCE_S
        if overlaps and phase.mode is not ControlMode.TORQUE:
            raise UsageError(
                f"controller.phases: {phase.name!r} is in mode {phase.mode.value} from {starts_s:g} s on; the"
                f" experiment needs torque mode from event {first.name!r} at {first.start_s:g} s to {needed_s:g} s"
            )
        starts_s = ends_s


def end_of(event: WorldEvent) -> float:
    """Time [s] at which an event's force is gone; a hand's fades after its end."""
    return event.start_s + event.duration_s + (event.ramp_s if event.kind == "hand_held" else 0.0)


def event_of(run: Run, name: str) -> WorldEvent:
    """Find an event of the world by its name.

    Raises:
        UsageError: there is none.

    """
    events = run.scenario.plant.world.events
    for event in events:
        if event.name == name:
            return event
    raise _missing("plant.world.events", f"event {name!r}", (event.name for event in events))


def phase_named(run: Run, name: str) -> Phase:
    """Find a phase of the controller by its name.

    Raises:
        UsageError: there is none.

    """
    phases = run.scenario.controller.phases
    for phase in phases:
        if phase.name == name:
            return phase
    raise _missing("controller.phases", f"phase {name!r}", (phase.name for phase in phases))


def _missing(field: str, what: str, there: Iterable[str]) -> UsageError:
    return UsageError(
        f"{field}: no {what}, which the experiment needs; there are: {', '.join(there) or 'none'}. Leave out the --set"
        " that takes it away"
    )


def perform(request: ExperimentRequest, scenario: str, directory: Path, overrides: dict[str, Any]) -> RunSeries:
    """Run a variant of the scenario and read its log; `overrides` win over the request's at and below them.

    Raises:
        RunStoppedError: the HAL stopped the robot.

    """
    of_user = {
        path: value for path, value in request.overrides.items() if not any(_within(path, field) for field in overrides)
    }
    run = load_run(scenario, {**of_user, **overrides, "seed": request.seed})
    return read_series(run_to_log(run, directory, processes=request.processes))


@contextmanager
def workplace(request: ExperimentRequest) -> Iterator[Path]:
    """Give the request's directory, or one that vanishes."""
    if request.directory is not None:
        yield request.directory
        return
    with TemporaryDirectory(prefix="cosim-experiment-") as scratch:
        yield Path(scratch)


def common_ticks(series: RunSeries) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give indices of trace and truth for the sequences that both have."""
    _, of_trace, of_truth = np.intersect1d(series.trace.sequence, series.truth.sequence, return_indices=True)
    return of_trace, of_truth


def hand_error(series: RunSeries) -> tuple[Array, Array]:
    """Give times (K,) [s] and true less desired hand (K, 3) [m] at the same SYNC, in torque mode with a hand task."""
    of_trace, of_truth = common_ticks(series)
    error = series.truth.hand[of_truth] - series.trace.hand_desired[of_trace]
    chosen = series.trace.torque_mode[of_trace] & np.isfinite(error).all(axis=1)
    return series.trace.time_s[of_trace][chosen], error[chosen]


def oscillation(time_s: Array, signal: Array, release_s: float) -> Array:
    """Peak to peak (m,) of a signal (K, m) in the `WINDOW_S` after a release, from when it first passes its rest.

    The way back to where the signal comes to rest is no oscillation; what swings beyond it is. 0: it never does.
    """
    _, away = _after_release(time_s, signal, release_s)
    passed = np.logical_or.accumulate(np.sign(away) != np.sign(away[0]), axis=0)
    swing = np.where(passed, away, 0.0)
    return np.asarray(swing.max(axis=0) - swing.min(axis=0), np.float64)


def _after_release(time_s: Array, signal: Array, release_s: float) -> tuple[Array, Array]:
    """Give times (L,) of the window after a release, and how far the signal (L, m) then is from its rest."""
    window = (time_s >= release_s) & (time_s < release_s + WINDOW_S)
    rest = signal[(time_s >= release_s + WINDOW_S - END_S) & (time_s < release_s + WINDOW_S)].mean(axis=0)
    return time_s[window], np.asarray(signal[window] - rest, np.float64)


def settling_time(time_s: Array, distance: Array, release_s: float, band: float) -> float:
    """Time [s] from a release until a distance (K,) stays below a band; NaN if it never does."""
    after = time_s >= release_s
    outside = np.flatnonzero(distance[after] > band)
    if not outside.size:
        return 0.0
    if outside[-1] == np.count_nonzero(after) - 1:
        return float("nan")
    return float(time_s[after][outside[-1] + 1] - release_s)


def cycle_at(series: RunSeries, time_s: float) -> int:
    """Index in the truth of the last cycle at or before a time."""
    return int(np.searchsorted(series.truth.time_s, time_s, side="right")) - 1


def true_breakaway(run: Run) -> Array:
    """Breakaway torques (n,) [N·m] of this run's plant, at the joints."""
    factors = build(run.robot, run.scenario.plant, run.scenario.seed).friction_factors
    gears = np.array([joint.gear_ratio for joint in run.robot.description.joints])
    return np.asarray(run.scenario.plant.friction.breakaway * gears * factors, np.float64)


def stiction_band(run: Run) -> Array:
    """Distance (n,) [rad] from its place at which stiction can hold a joint: b_i / (K_p M_ii), K_p the hand task's.

    Within it the place of rest is a matter of chance; only what swings farther is oscillation.
    """
    model = RobotModel(run.robot)
    mass = model.configure(initial_position(run.robot, run.scenario.plant), np.zeros(model.n)).mass
    return np.asarray(true_breakaway(run) / (run.scenario.controller.hand.stiffness * mass.diagonal()), np.float64)


def stiction_force(run: Run, link: str, direction_in_world: tuple[float, float, float]) -> float:
    """Least force [N] at a link's origin that breaks the true stiction without moving the hand, at the start posture.

    A motion q̇ of the hand's null space that moves the point at 1 m/s along the direction d starts when F exceeds its
    friction power Σ b_i |q̇_i|, b the breakaway torques of this run's plant; the easiest one is a linear program:
    min bᵀ|q̇| subject to J_hand q̇ = 0 and dᵀ J_link q̇ = 1.
    """
    robot, plant = run.robot, run.scenario.plant
    hand = robot.description.hand_frame
    if hand is None:
        raise UsageError(f"robot {robot.description.name} has no hand_frame, which the experiment moves")
    breakaway = true_breakaway(run)
    model = RobotModel(robot, (hand, link))
    n = model.n
    now = model.configure(initial_position(robot, plant), np.zeros(n))
    direction = np.array(direction_in_world) / np.linalg.norm(direction_in_world)
    along = direction.dot(now.frames[link].jacobian[:3])
    rows = np.vstack((now.frames[hand].jacobian, along))
    found = linprog(
        np.tile(breakaway, 2), A_eq=np.hstack((rows, -rows)), b_eq=np.append(np.zeros(6), 1.0), bounds=(0, None)
    )
    if not found.success:
        raise UsageError(f"link {link} cannot move along {direction_in_world} while the hand stays: choose another")
    return float(found.fun)
