"""Descriptions of what the world does: what is read, and that nonsense is refused with file and field."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from schemas.errors import ConfigurationError
from schemas.messages import PlantTruth
from schemas.scenario import PlantConfig
from schemas.topics import decode, encode
from schemas.world import Box, HandHeld, Pole, Push, World

POLE = {"kind": "pole", "name": "pole", "start_in_world": [1, 0, 0], "end_in_world": [1, 0, 2], "radius": 0.02}
BOX = {"kind": "box", "name": "table", "position_in_world": [1, 0, 0], "half_sizes": [0.3, 0.2, 0.1]}
PUSH = {"kind": "push", "name": "bump", "link": "tip", "force_in_world": [0, 9, 0], "start_s": 0.1, "duration_s": 0.2}
HAND = {
    "kind": "hand_held",
    "name": "hand",
    "link": "tip",
    "start_s": 0.5,
    "duration_s": 2,
    "path": [[0, 0, 0, 0], [0.5, 0.1, 0, 0], [1, 0.1, 0.1, 0]],
    "stiffness": 2000,
    "force_limit": 80,
}


def test_all_kinds_are_read_and_survive_the_log(files: Any) -> None:
    files.scenario["plant"] = {"world": {"obstacles": [POLE, BOX], "events": [PUSH, HAND]}}
    plant = files.load().scenario.plant
    assert [type(item) for item in plant.world.obstacles + plant.world.events] == [Pole, Box, Push, HandHeld]
    assert PlantConfig.model_validate_json(plant.model_dump_json()) == plant


def test_an_event_is_found_by_its_name_in_overrides(files: Any) -> None:
    files.scenario["plant"] = {"world": {"events": [PUSH, HAND]}}
    world = files.load(**{"plant.world.events.hand.start_s": 0.7}).scenario.plant.world
    assert [event.start_s for event in world.events] == [0.1, 0.7]


def test_a_scenario_without_a_world_has_an_empty_one(files: Any) -> None:
    plant = files.load().scenario.plant
    assert plant.world == World()
    assert plant.friction_error == 0.0


BAD = [
    ({"obstacles": [POLE | {"radius": 0}]}, r"obstacles\.0\.pole\.radius"),
    ({"obstacles": [POLE | {"end_in_world": [1, 0, 0]}]}, r"obstacles\.0\.pole: end_in_world is start_in_world"),
    ({"obstacles": [POLE | {"friction": -0.1}]}, r"obstacles\.0\.pole\.friction"),
    ({"obstacles": [BOX | {"half_sizes": [0.1, 0.1, 0.0]}]}, r"obstacles\.0\.box\.half_sizes\.2"),
    ({"obstacles": [BOX | {"orientation_to_world": [1, 1, 0, 0]}]}, r"obstacles\.0\.box: .* norm 1\.41421"),
    ({"obstacles": [BOX | {"kind": "ball"}]}, r"obstacles\.0: .*'ball'"),
    ({"obstacles": [BOX, POLE | {"name": "table"}]}, r"world: the name 'table' is given twice"),
    ({"obstacles": [POLE], "events": [PUSH | {"name": "pole"}]}, r"world: the name 'pole' is given twice"),
    ({"events": [PUSH | {"start_s": -1}]}, r"events\.0\.push\.start_s"),
    ({"events": [PUSH | {"duration_s": 0}]}, r"events\.0\.push\.duration_s"),
    ({"events": [PUSH | {"force_in_world": [0, float("nan"), 0]}]}, r"events\.0\.push\.force_in_world\.1"),
    ({"events": [PUSH | {"ramp_s": 0.11}]}, r"events\.0\.push: ramp_s: two ramps of 0\.11 s .* 0\.2 s"),
    ({"events": [PUSH | {"duration_s": 1e-4, "ramp_s": 0}]}, r"events\.0\.duration_s: bump .* 0\.0001 s .* 0\.0005 s"),
    ({"events": [HAND | {"path": [[1, 0, 0, 0], [0.5, 0, 0, 0]]}]}, r"events\.0\.hand_held: path: .* 0\.5 s .* 1 s"),
    ({"events": [HAND | {"path": [[1, 0, 0, 0], [1, 1, 0, 0]]}]}, r"events\.0\.hand_held: path"),
    ({"events": [HAND | {"path": [[-1, 0, 0, 0]]}]}, r"events\.0\.hand_held\.path\.0\.0"),
    ({"events": [HAND | {"path": [[0, 0, 0.1, 0]]}]}, r"events\.0\.hand_held: path: .*without displacement"),
    ({"events": [HAND | {"path": [[3, 0, 0.1, 0]]}]}, r"events\.0\.hand_held: path: .* 3 s comes after the end"),
    ({"events": [HAND | {"stiffness": -1}]}, r"events\.0\.hand_held\.stiffness"),
    ({"events": [HAND | {"force_limit": 0}]}, r"events\.0\.hand_held\.force_limit"),
]


@pytest.mark.parametrize(("world", "words"), BAD, ids=[words for _, words in BAD])
def test_nonsense_is_refused_with_file_and_field(files: Any, world: dict[str, Any], words: str) -> None:
    files.scenario["plant"] = {"world": world}
    with pytest.raises(ConfigurationError, match=rf"hold\.yaml: plant.*{words}"):
        files.load()


@pytest.mark.parametrize("error", [-0.1, 1.0])
def test_a_friction_error_that_would_turn_friction_round_is_refused(files: Any, error: float) -> None:
    files.scenario["plant"] = {"friction_error": error}
    with pytest.raises(ConfigurationError, match=r"hold\.yaml: plant\.friction_error"):
        files.load()


def test_truth_of_logs_that_know_no_world_is_read() -> None:
    truth = PlantTruth(
        sequence=0,
        time_ns=0,
        position=(0.0,),
        velocity=(0.0,),
        acceleration=(0.0,),
        mode=(0,),
        drive_state=(),
        motor_torque=(0.0,),
        motor_torque_substeps=(),
        friction_torque=(0.0,),
        frames={},
    )
    old = {key: value for key, value in json.loads(encode(truth)).items() if key not in {"contacts", "world_forces"}}
    assert decode(PlantTruth, json.dumps(old).encode()) == truth


def test_springs_too_stiff_for_the_substep_are_refused() -> None:
    box = {"kind": "box", "name": "block", "position_in_world": [0, 0, 0], "half_sizes": [1, 1, 1], "mass": 1.0}
    PlantConfig.model_validate({"substep_s": 0.0005, "world": {"obstacles": [box | {"stiffness": 3.9e6}]}})
    with pytest.raises(ValidationError, match=r"obstacles\.0\.stiffness: block with 1 kg turns by 1\.\d+ rad"):
        PlantConfig.model_validate({"substep_s": 0.0005, "world": {"obstacles": [box | {"stiffness": 5e6}]}})
