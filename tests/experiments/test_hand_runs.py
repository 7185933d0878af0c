"""What the experiments measure with: oscillation, settling, the force of stiction."""

from __future__ import annotations

import numpy as np
import pytest

from controller_service.model import RobotModel
from deploy.errors import UsageError
from deploy.experiment import ExperimentRequest
from experiments.hand_runs import END_S, WINDOW_S, load, oscillation, settling_time, stiction_force
from plant_service.model import build, initial_position
from schemas.load import load_run

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
