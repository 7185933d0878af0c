"""Short runs of robots of every kind of drive, in memory: what tests of frames compare with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from deploy.inprocess import InProcess
from schemas.base import Model
from schemas.load import Run, load_run
from schemas.messages import BusFrames, RobotState

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
SCENARIOS = {
    "arm9": ("arm9-transition", 0.05),
    "crane": (str(ROBOTS / "crane-transition.yaml"), 1.25),
    "stilt": (str(ROBOTS / "stilt-step.yaml"), 0.08),
    "feather": (str(ROBOTS / "feather-wave.yaml"), 0.1),
}
"""Scenario and duration [s]: crane is in torque mode at its end, two cycles of delay; directions and offsets differ."""


@dataclass(frozen=True)
class Recorded:
    """What a run wrote."""

    run: Run
    frames: tuple[BusFrames, ...]
    states: dict[int, RobotState]


@lru_cache
def recorded(robot: str) -> Recorded:
    """Run one of `SCENARIOS` in this process."""
    scenario, duration_s = SCENARIOS[robot]
    run = load_run(scenario, {"duration_s": duration_s})
    messages: list[Model] = []
    InProcess(run, lambda _topic, message: messages.append(message)).run()
    frames = tuple(message for message in messages if isinstance(message, BusFrames))
    states = {message.sequence: message for message in messages if isinstance(message, RobotState)}
    return Recorded(run, frames, states)
