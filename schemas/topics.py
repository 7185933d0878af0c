"""Which message travels under which name, and its bytes: JSON of the model, the same on Zenoh and in the log."""

from __future__ import annotations

from typing import TypeVar

from pydantic import ValidationError

from schemas.base import Model
from schemas.errors import CosimError
from schemas.messages import (
    BusFrames,
    BusStatistics,
    ControllerTrace,
    CycleStatistics,
    Event,
    JointCommand,
    OperatorRequest,
    PlantTruth,
    RobotState,
)
from schemas.robot import RobotDescription

M = TypeVar("M", bound=Model)

BUS_PREFIX = "bus/"
LOAD_PREFIX = "load/"
TOPICS: dict[str, type[Model]] = {
    "state": RobotState,
    "command": JointCommand,
    "trace": ControllerTrace,
    "truth": PlantTruth,
    "event": Event,
    "health": CycleStatistics,
    "operator": OperatorRequest,
}
"""Leaf of a key (see `Keys`) and the message it carries; `bus/<name>` carries `BusFrames`, `load/<name>` carries
`BusStatistics`."""


class MalformedMessageError(CosimError):
    """Bytes that are not the message they should be: not JSON, a field missing, unknown or not finite."""


def topics_of(robot: RobotDescription) -> dict[str, type[Model]]:
    """Every topic of a robot and its message, in the fixed order of a log's channels."""
    buses: dict[str, type[Model]] = {BUS_PREFIX + bus.name: BusFrames for bus in robot.buses}
    loads: dict[str, type[Model]] = {LOAD_PREFIX + bus.name: BusStatistics for bus in robot.buses}
    return TOPICS | buses | loads


def encode(message: Model) -> bytes:
    """JSON of a message, UTF-8."""
    return message.__pydantic_serializer__.to_json(message)


def decode(model: type[M], data: bytes) -> M:
    """Read a message from its JSON.

    Raises:
        MalformedMessageError: naming the message, the first field at fault and what was expected.

    """
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False)[0]
        field = ".".join(str(part) for part in fault["loc"]) or "message"
        raise MalformedMessageError(f"{model.__name__}: {field}: {fault['msg']} ({len(data)} bytes)") from error


def stamp(message: Model) -> tuple[int, int]:
    """Sequence and time [ns] of a message; (0, 0) for one that carries neither (`OperatorRequest`)."""
    return getattr(message, "sequence", 0), getattr(message, "time_ns", 0)
