"""Bus lines: which wire a run is made on, for HAL and plant, and nothing else; heartbeats, contact boxes."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from schemas.errors import ConfigurationError
from schemas.load import rewire
from schemas.log import RunRecord
from schemas.robot import BUS_LINES, Bus, LinkBox, Safety
from schemas.service import session_identity


def test_the_plant_opens_its_own_channel_where_it_has_one() -> None:
    pair = Bus(name="arm", interface="socketcan", channel="can0", plant_channel="can1", bitrate=500_000)
    assert pair.of_plant() == Bus(name="arm", interface="socketcan", channel="can1", bitrate=500_000)
    shared = Bus(name="arm", interface="socketcan", channel="vcan0")
    assert shared.of_plant() is shared


def test_every_field_but_the_name_is_a_bus_line() -> None:
    assert set(Bus.model_fields) == BUS_LINES | {"name"}


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"channel": "arm", "plant_channel": "other"}, "a virtual bus (cosim) has one channel"),
        ({"interface": "socketcan", "channel": ""}, "at least 1 character"),
        ({"interface": "", "channel": "can0"}, "at least 1 character"),
        ({"interface": "socketcan", "channel": "can0", "plant_channel": ""}, "at least 1 character"),
    ],
)
def test_lines_that_open_nothing_are_refused(fields: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Bus(name="arm", **fields)
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("first", "second", "twice"),
    [
        (("can0", None), ("can0", None), "can0"),
        (("can0", "can1"), ("can1", None), "can1"),
        (("can0", "can1"), ("can2", "can1"), "can1"),
        (("can0", "can1"), ("can1", "can0"), "can0"),
    ],
)
def test_two_buses_share_no_channel(files: Any, first: tuple[str, str], second: tuple[str, str], twice: str) -> None:
    for bus, (channel, plant_channel) in zip(files.robot["buses"], (first, second), strict=True):
        bus |= {"interface": "socketcan", "channel": channel, "plant_channel": plant_channel}
    with pytest.raises(ConfigurationError, match=rf"bus channel 'socketcan:{twice}' is given twice"):
        files.load()


def test_both_sides_may_share_a_channel_and_kinds_of_interface_may_share_a_name(files: Any) -> None:
    files.robot["buses"][0] |= {"interface": "socketcan", "channel": "can0", "plant_channel": "can0"}
    files.robot["buses"][1] |= {"interface": "pcan", "channel": "can0"}
    assert files.load().robot.description.buses[0].of_plant().channel == "can0"


LINES = [
    {"interface": "socketcan", "channel": "can0", "plant_channel": "can1", "bitrate": 800_000},
    {"interface": "socketcan", "channel": "can2", "plant_channel": None},
]


def test_a_robot_on_other_wires_is_the_same_robot(files: Any) -> None:
    robot = files.load().robot
    moved = rewire(robot, LINES)
    assert [bus.name for bus in moved.description.buses] == [bus.name for bus in robot.description.buses]
    assert moved.description.buses[0].of_plant().channel == "can1"
    assert moved.description.buses[1].bitrate == 1_000_000
    assert moved.description.joints == robot.description.joints
    assert rewire(moved, [{**bus.model_dump(include=BUS_LINES)} for bus in robot.description.buses]) == robot


def test_wires_are_checked_as_in_a_file(files: Any) -> None:
    with pytest.raises(ConfigurationError, match="bus channel 'socketcan:can0' is given twice"):
        rewire(files.load().robot, [LINES[0], LINES[1] | {"channel": "can0"}])


def test_the_identity_of_a_run_is_the_same_on_every_wire(files: Any) -> None:
    first = files.load()
    files.robot["buses"] = [bus | line for bus, line in zip(files.robot["buses"], LINES, strict=True)]
    second = files.load()
    assert second.robot.description != first.robot.description
    assert session_identity(second) == session_identity(first)
    files.robot["buses"][0]["name"] = "can7"
    for joint in files.robot["joints"]:
        joint["drive"]["bus"] = "can7"
    assert session_identity(files.load()) != session_identity(first)


def test_a_log_remembers_the_wires(files: Any) -> None:
    files.robot["buses"][0] |= LINES[0]
    run = files.load()
    assert RunRecord.model_validate_json(RunRecord.of(run).model_dump_json(by_alias=True)).run() == run


@pytest.mark.parametrize("heartbeat_s", [0.0, 0.0009, 21.5])
def test_a_heartbeat_that_its_objects_cannot_hold_is_refused(heartbeat_s: float) -> None:
    with pytest.raises(ValidationError, match="heartbeat_s"):
        Safety(heartbeat_s=heartbeat_s)


def test_three_of_the_longest_heartbeats_fit_the_consumer_object() -> None:
    assert 3000.0 * Safety(heartbeat_s=21.0).heartbeat_s < 2**16


BOX = {"name": "sole", "link": "hand", "position_in_link": (0.0, 0.0, 0.1), "half_sizes": (0.1, 0.05, 0.01)}


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"orientation_to_link": (1.0, 1.0, 0.0, 0.0)}, "orientation_to_link has the norm 1.41421"),
        ({"orientation_to_link": (0.0, 0.0, 0.0, 0.0)}, "orientation_to_link has the norm 0"),
        ({"half_sizes": (0.1, 0.0, 0.1)}, "half_sizes"),
        ({"name": ""}, "name"),
    ],
)
def test_contact_boxes_without_shape_orientation_or_name_are_refused(fields: dict[str, Any], expected: str) -> None:
    LinkBox(**BOX | {"orientation_to_link": (0.6, 0.0, 0.8, 0.0)})
    with pytest.raises(ValidationError) as caught:
        LinkBox(**BOX | fields)
    assert expected in str(caught.value)


def test_two_contact_boxes_of_one_name_are_refused(files: Any) -> None:
    files.robot["contact_boxes"] = [BOX]
    assert files.load().robot.description.contact_boxes == (LinkBox(**BOX),)
    files.robot["contact_boxes"] = [BOX, BOX | {"link": "chest"}]
    with pytest.raises(ConfigurationError, match="contact box 'sole' is given twice"):
        files.load()
