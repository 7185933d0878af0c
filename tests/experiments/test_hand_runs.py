"""What the experiments measure with: oscillation, settling, the force of stiction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller_service.model import RobotModel
from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest
from deploy.series import RunSeries
from experiments import hand_runs
from experiments.hand_runs import (
    END_S,
    WINDOW_S,
    end_of,
    event_of,
    load,
    oscillation,
    perform,
    phase_named,
    settling_time,
    stiction_band,
    stiction_force,
    true_breakaway,
)
from plant_service.model import build, initial_position
from schemas.errors import ConfigurationError
from schemas.load import Run, load_run

TIME = np.arange(0.0, 6.0, 0.002)
ELBOW = "elbow_pitch_link"


def test_a_way_back_is_no_oscillation_and_a_swing_counts_from_its_first_pass() -> None:
    since = np.maximum(TIME - 1.0, 0.0)
    back = 0.05 * np.exp(-since / 0.1)
    swing = 0.05 * np.exp(-since / 0.8) * np.cos(2.0 * np.pi * since)
    found = oscillation(TIME, np.stack((back, swing, 0.0 * TIME), axis=1), 1.0)
    assert found[0] < 1e-6
    # first pass at a quarter period; then the trough at half and the crest at one
    expected = 0.05 * (np.exp(-0.5 / 0.8) + np.exp(-1.0 / 0.8))
    assert found[1] == pytest.approx(expected, rel=0.05)
    assert found[2] == 0.0
    assert END_S < WINDOW_S


def test_settling_is_when_the_last_excursion_ends() -> None:
    distance = np.where((TIME > 2.0) & (TIME < 2.5), 1.0, 0.0)
    assert settling_time(TIME, distance, 1.0, 0.5) == pytest.approx(1.5, abs=0.003)
    assert settling_time(TIME, distance, 3.0, 0.5) == 0.0
    assert np.isnan(settling_time(TIME, np.ones_like(TIME), 1.0, 0.5))


@pytest.mark.parametrize("seed", [0, 5])
def test_no_null_space_motion_is_easier_than_the_force_of_stiction(seed: int) -> None:
    """F d·(J_link q̇) ≤ Σ b |q̇| for every q̇ of the hand's null space, with equality for the easiest one."""
    run = load_run("arm9-null-space", {"seed": seed, "plant.friction_error": 0.3})
    force = stiction_force(run, ELBOW, (0.0, 2.0, 0.0))
    model = RobotModel(run.robot, ("hand", ELBOW))
    now = model.configure(initial_position(run.robot, run.scenario.plant), np.zeros(9))
    null = np.linalg.svd(now.frames["hand"].jacobian)[2][6:]
    gears = np.array([joint.gear_ratio for joint in run.robot.description.joints])
    factors = build(run.robot, run.scenario.plant, seed).friction_factors
    breakaway = run.scenario.plant.friction.breakaway * gears * factors
    motions = np.random.default_rng(3).normal(size=(20000, 3)) @ null
    power = np.abs(motions) @ breakaway
    along = motions @ now.frames[ELBOW].jacobian[1]
    assert (force * along <= power * (1 + 1e-9)).all()
    assert (power / np.abs(along)).min() < 1.2 * force


def test_a_direction_in_which_the_link_cannot_move_alone_is_refused() -> None:
    with pytest.raises(UsageError, match="hand cannot move along"):
        stiction_force(load_run("arm9-null-space"), "hand", (1.0, 0.0, 0.0))


def test_what_an_experiment_sets_itself_cannot_be_set() -> None:
    with pytest.raises(UsageError, match="--set seed: the experiment sets it itself"):
        load(ExperimentRequest(0, {"seed": 3}), "arm9-null-space")
    with pytest.raises(UsageError, match=r"controller\.null_space"):
        load(ExperimentRequest(0, {"controller.null_space.fade_s": 1}), "arm9-null-space", ("controller.null_space",))
    run = load(ExperimentRequest(4, {"plant.torque_scale": 0.87}), "arm9-null-space")
    assert (run.scenario.seed, run.scenario.plant.torque_scale) == (4, 0.87)


NULL_SPACE = "controller.null_space"
FORCE = "plant.world.events.elbow.force_in_world"


@pytest.mark.parametrize(
    ("path", "value", "own", "own_whole"),
    [
        (FORCE, [0, 1, 0], (FORCE,), ()),
        ("plant.world.events.elbow.force_in_world.1", 5, (FORCE,), ()),
        ("plant.world.events.1.force_in_world", [0, 1, 0], (FORCE,), ()),
        ("plant.world.events.1.force_in_world.0", 5, (FORCE,), ()),
        ("plant.world.events", [], (FORCE,), ()),
        ("plant.world", {}, (FORCE,), ()),
        ("controller.null_space.fade_s", 1, (NULL_SPACE,), ()),
        (NULL_SPACE, None, (), (NULL_SPACE,)),
        ("controller", {"phases": [{"name": "a", "mode": "torque", "duration_s": 1}]}, (), (NULL_SPACE,)),
    ],
)
def test_own_fields_are_refused_at_above_and_below(
    path: str, value: Any, own: tuple[str, ...], own_whole: tuple[str, ...]
) -> None:
    with pytest.raises(UsageError, match=f"^--set {path}: the experiment sets it itself"):
        load(ExperimentRequest(0, {path: value}), "arm9-null-space", own, own_whole=own_whole)


def test_fields_beside_and_below_those_set_as_a_whole_are_the_users() -> None:
    overrides = {
        "controller.null_space.posture_metric": "joint",
        "plant.world.events.elbow.start_s": 9.5,
        "plant.world.events.0.force_in_world": [0, 50, 0],
    }
    run = load(ExperimentRequest(0, overrides), "arm9-null-space", (FORCE,), own_whole=(NULL_SPACE,))
    null_space = run.scenario.controller.null_space
    assert null_space is not None
    assert null_space.posture_metric == "joint"
    assert (event_of(run, "elbow").start_s, end_of(event_of(run, "hand"))) == (9.5, 5.5)
    with pytest.raises(ConfigurationError, match="seedling") as caught:
        load(ExperimentRequest(0, {"seedling": 5}), "arm9-null-space")
    assert not isinstance(caught.value, UsageError)


def test_a_run_without_a_part_drops_what_the_user_set_of_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given: list[Run] = []

    def keep(run: Run, directory: Path, *, processes: bool) -> Path:
        given.append(run)
        return directory

    monkeypatch.setattr(hand_runs, "run_to_log", keep)
    monkeypatch.setattr(hand_runs, "read_series", lambda _: RunSeries)
    request = ExperimentRequest(4, {"controller.null_space.fade_s": 0.3, "plant.torque_scale": 0.87})
    perform(request, "arm9-null-space", tmp_path, {})
    perform(request, "arm9-null-space", tmp_path, {NULL_SPACE: None})
    with_part, without = (run.scenario for run in given)
    assert with_part.controller.null_space is not None
    assert with_part.controller.null_space.fade_s == 0.3
    assert without.controller.null_space is None
    assert [scenario.plant.torque_scale for scenario in (with_part, without)] == [0.87, 0.87]
    assert [scenario.seed for scenario in (with_part, without)] == [4, 4]


def test_what_an_experiment_needs_is_missed_by_name() -> None:
    with pytest.raises(UsageError, match=r"no event 'person', .* there are: hand, elbow\. Leave out"):
        load(ExperimentRequest(0), "arm9-null-space", events=("hand", "person"))
    with pytest.raises(UsageError, match=r"no event 'person', .* there are: none"):
        load(ExperimentRequest(0, {"plant.world.events": []}), "arm9-anti-windup", events=("person",))
    run = load_run("arm9-null-space")
    assert phase_named(run, "hold").duration_s == 16.5
    with pytest.raises(UsageError, match=r"no phase 'lead', .* there are: settle, hold"):
        phase_named(run, "lead")


@pytest.mark.parametrize(
    ("scenario", "event", "end_s"), [("arm9-null-space", "elbow", 13.5), ("arm9-dual-compliance", "hand", 12.5)]
)
def test_time_is_left_after_the_last_event_has_let_go(scenario: str, event: str, end_s: float) -> None:
    events = ("hand", "elbow")
    assert end_of(event_of(load_run(scenario), event)) == pytest.approx(end_s)
    fading = load_run(scenario, {f"plant.world.events.{event}.ramp_s": 0.2})
    assert end_of(event_of(fading, event)) == pytest.approx(end_s + (0.2 if event == "hand" else 0.0))
    left_s = load_run(scenario).scenario.duration_s - end_s
    load(ExperimentRequest(0), scenario, events=events, after_s=left_s)
    with pytest.raises(UsageError, match=f"event '{event}' ends at {end_s:g} s .* --set duration_s=17.01 or more"):
        load(ExperimentRequest(0), scenario, events=events, after_s=left_s + 0.01)
    with pytest.raises(UsageError, match="duration_s 5 s is too short"):
        load(ExperimentRequest(0, {"duration_s": 5}), scenario, events=events)


def test_events_act_in_torque_mode() -> None:
    path = "controller.phases.settle.duration_s"
    load(ExperimentRequest(0, {path: 3}), "arm9-null-space", events=("hand",))
    with pytest.raises(UsageError, match=r"'settle' is in mode position from 0 s on.* event 'hand' at 3 s to 5\.5 s"):
        load(ExperimentRequest(0, {path: 3.1}), "arm9-null-space", events=("hand",))
    later = [{"name": "a", "mode": "torque", "duration_s": 6}, {"name": "b", "mode": "position", "duration_s": 6}]
    request = ExperimentRequest(0, {"controller.phases": later})
    load(request, "arm9-null-space", events=("hand",), after_s=0.5)
    with pytest.raises(UsageError, match="'b' is in mode position from 6 s on"):
        load(request, "arm9-null-space", events=("hand",), after_s=0.6)


def test_stiction_holds_a_joint_within_its_band_and_not_beyond() -> None:
    """K_p M e = b at its edge; friction factors of the seed are in it."""
    run = load_run("arm9-anti-windup", {"seed": 4, "plant.friction_error": 0.3})
    band, breakaway = stiction_band(run), true_breakaway(run)
    mass = RobotModel(run.robot).configure(initial_position(run.robot, run.scenario.plant), np.zeros(9)).mass
    assert np.allclose(run.scenario.controller.hand.stiffness * np.diag(mass) * band, breakaway)
    gears = np.array([joint.gear_ratio for joint in run.robot.description.joints])
    factors = breakaway / (run.scenario.plant.friction.breakaway * gears)
    assert np.allclose(factors, build(run.robot, run.scenario.plant, 4).friction_factors)
    assert (np.abs(factors - 1.0) <= 0.3).all()
    assert np.ptp(factors) > 0.1
