from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from schemas.load import Run, load_run

URDF = """<robot name="pendulum">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/></joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="tip"/></joint>
</robot>
"""


def _joint(name: str, node_id: int) -> dict[str, Any]:
    return {
        "name": name,
        "gear_ratio": 200.0,
        "rotor_inertia": 1e-5,
        "torque_limit": 100.0,
        "torque_rate_limit": 1e4,
        "velocity_limit": 3.0,
        "position_min": -1.5,
        "position_max": 1.5,
        "encoder_counts": 4096,
        "drive": {
            "kind": "torque",
            "bus": "can0",
            "node_id": node_id,
            "rated_motor_torque": 0.5,
            "position_gain": 1000.0,
            "velocity_gain": 10.0,
        },
    }


ROBOT: dict[str, Any] = {
    "name": "pendulum",
    "urdf": "pendulum.urdf",
    "rate_hz": 500.0,
    "compute_budget_s": 0.001,
    "hand_frame": "tip",
    "buses": [{"name": "can0", "channel": "can0"}, {"name": "can1", "channel": "can1"}],
    "joints": [_joint("shoulder", 1), _joint("elbow", 2)],
    "force_torque_sensors": [{"name": "wrist", "frame": "tip", "bus": "can1", "can_id": 0x100, "command_id": 0x110}],
}
SCENARIO: dict[str, Any] = {
    "name": "hold",
    "robot": "pendulum.yaml",
    "duration_s": 1.0,
    "seed": 7,
    "controller": {"phases": [{"name": "hold", "mode": "position", "duration_s": 1.0}]},
}


class Files:
    """A robot and a scenario on disk whose fields a test may change before they are loaded."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.robot: dict[str, Any] = copy.deepcopy(ROBOT)
        self.scenario: dict[str, Any] = copy.deepcopy(SCENARIO)
        self.urdf = URDF

    def load(self, **overrides: Any) -> Run:
        (self.folder / "pendulum.urdf").write_text(self.urdf)
        (self.folder / "pendulum.yaml").write_text(yaml.safe_dump(self.robot))
        (self.folder / "hold.yaml").write_text(yaml.safe_dump(self.scenario))
        return load_run(str(self.folder / "hold.yaml"), overrides)


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


@pytest.fixture
def run(files: Files) -> Run:
    return files.load()
