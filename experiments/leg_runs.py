"""What the experiments with the leg share: the runs from which its motors are identified, and the models."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from deploy.experiment import ExperimentRequest
from deploy.identify import Identification, IdentifyOptions, identify
from deploy.series import RunSeries
from experiments.hand_runs import perform

COLLECTIONS: Final = {"high-torque": "leg6-high-torque", "high-velocity": "leg6-high-velocity"}
"""Scenarios of section 3.4 of [Del Prete 2016]."""
OWN_OF_SCENARIO: Final = ("plant.world", "plant.initial_posture", "plant.truth_frames")
"""What of the plant belongs to a motion and not to the robot."""


def identified_motors(request: ExperimentRequest, directory: Path) -> dict[str, dict[str, float]]:
    """Identify the motors of the plant that a request speaks of: same seed, same differences from the model.

    Both collections are run, with the request's overrides of robot and plant but for those of its motion. The result is
    a value for `controller.position_torque.motors`.

    Args:
        request: seed and overrides; its progress is not told.
        directory: for the logs.

    Raises:
        RunStoppedError: the HAL stopped a run.
        IdentificationError: a joint's samples do not tell its model.

    """
    return identification(request, directory).motors()


def identification(
    request: ExperimentRequest, directory: Path, options: IdentifyOptions | None = None
) -> Identification:
    """Do what `identified_motors` does and give all of it; the options' defaults are two-stage and w = 100."""
    logs = collect(request, directory)
    return identify(list(logs.values()), options or IdentifyOptions(), names=[*COLLECTIONS.values()])


def collect(request: ExperimentRequest, directory: Path) -> dict[str, RunSeries]:
    """Run both collections on the plant of a request."""
    of_plant = replace(request, overrides=plant_overrides(request.overrides))
    runs = {}
    for number, (name, scenario) in enumerate(COLLECTIONS.items()):
        request.progress(number / len(COLLECTIONS), name)
        runs[name] = perform(of_plant, scenario, directory / name, {})
    return runs


def plant_overrides(overrides: dict[str, Any]) -> dict[str, Any]:
    """Choose of overrides those that make another robot or plant, and not another motion."""
    return {
        path: value
        for path, value in overrides.items()
        if path.startswith(("plant.", "robot."))
        and not any(path == own or path.startswith(f"{own}.") for own in OWN_OF_SCENARIO)
    }
