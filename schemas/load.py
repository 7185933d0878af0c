"""Read robots and scenarios from YAML; every fault is one message with file, field and what was expected."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from schemas.bus_load import cycle_plan
from schemas.check_run import check_run
from schemas.controller import OPTIONAL_PARTS
from schemas.errors import ConfigurationError
from schemas.robot import RobotDescription
from schemas.scenario import Scenario

M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Robot:
    """A checked description with the text of its URDF: all that the services need, with no path left to resolve."""

    description: RobotDescription
    urdf: str


@dataclass(frozen=True, slots=True)
class Run:
    """A robot and a scenario that fit each other: what every process of a run is given."""

    robot: Robot
    scenario: Scenario

    @property
    def cycles(self) -> int:
        """Number of states of the run."""
        return round(self.scenario.duration_s * self.robot.description.rate_hz)


def load_run(scenario: str, overrides: dict[str, Any] | None = None) -> Run:
    """Read a scenario (a packaged name or a path) and its robot.

    `overrides` maps dotted paths to values, e.g. `{"plant.torque_scale": 0.8, "robot.rate_hz": 250}`: paths that start
    with `robot.` reach the robot description, others the scenario.

    A robot whose buses cannot carry its plan is refused unless the scenario says `allow_overload`.

    Raises:
        ConfigurationError: with file, field and reason.

    """
    path = _find(scenario, "scenarios", "scenario")
    split = {True: {}, False: {}}  # type: dict[bool, dict[str, Any]]
    for key, value in (overrides or {}).items():
        of_robot = key.startswith("robot.")
        split[of_robot][key.removeprefix("robot.")] = value
    data = _with_motors(_with_gains(_override(_read_yaml(path), split[False], path), path), path)
    config = _parse(Scenario, data, path)
    beside = path.parent / config.robot
    name = str(beside) if beside.is_file() else config.robot
    robot = load_robot(name, split[True], allow_overload=config.allow_overload)
    check_run(robot.description, config, path)
    return Run(robot, config)


def load_robot(robot: str, overrides: dict[str, Any] | None = None, *, allow_overload: bool = False) -> Robot:
    """Read and check a robot description (a packaged name or a path) and its URDF.

    `allow_overload` takes one whose buses cannot carry its plan.

    Raises:
        ConfigurationError: unknown field, NaN, duplicate node id, joint missing in the URDF, bus over 100 %, commands
            that would miss their SYNC, …

    """
    path = _find(robot, "robots", "robot")
    description = _parse(RobotDescription, _override(_read_yaml(path), overrides or {}, path), path)
    urdf_path = resolve_urdf(description.urdf, path)
    urdf = urdf_path.read_text(encoding="utf-8")
    _check_urdf(description, urdf, path, urdf_path)
    if not allow_overload:
        _check_plan(description, path)
    return Robot(description, urdf)


def rewire(robot: Robot, lines: Sequence[dict[str, Any]]) -> Robot:
    """Put a robot on other wires: `lines` holds new values of fields of `schemas.robot.BUS_LINES`, one entry a bus.

    Raises:
        ConfigurationError: a channel given twice, an empty one, two channels for a virtual bus.

    """
    buses = [bus.model_dump() | line for bus, line in zip(robot.description.buses, lines, strict=True)]
    try:
        return Robot(RobotDescription.model_validate(dict(robot.description) | {"buses": buses}), robot.urdf)
    except ValidationError as error:
        raise ConfigurationError(_faults(error, "buses")) from error


def resolve_urdf(urdf: str, robot_file: Path) -> Path:
    """Path of a description's URDF; `package://` names an installed Python package.

    Raises:
        ConfigurationError: the package or the file does not exist.

    """
    if urdf.startswith("package://"):
        package, _, inner = urdf.removeprefix("package://").partition("/")
        try:
            spec = importlib.util.find_spec(package)
        except (ImportError, ValueError):
            spec = None
        if spec is None or not spec.submodule_search_locations:
            raise ConfigurationError(f"{robot_file}: urdf: Python package {package!r} is not installed")
        path = Path(next(iter(spec.submodule_search_locations))) / inner
    else:
        path = robot_file.parent / urdf
    if not path.is_file():
        raise ConfigurationError(f"{robot_file}: urdf: no file at {path}")
    return path


def _with_motors(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Lay a scenario's motor models over those of the file that it names."""
    controller = data.get("controller")
    config = controller.get("position_torque") if isinstance(controller, dict) else None
    name = config.get("motors_from") if isinstance(config, dict) else None
    if not isinstance(controller, dict) or not isinstance(config, dict) or not isinstance(name, str):
        return data
    beside = path.parent / name
    source = beside if beside.is_file() else _find(name, "motors", "motors")
    identified = _read_yaml(source).get("motors")
    if not isinstance(identified, dict):
        raise ConfigurationError(
            f"{source}: motors: expected a mapping of joints, as `cosim identify motors` writes it"
        )
    own = config.get("motors") or {}
    if not isinstance(own, dict):
        return data  # for the model to refuse
    motors = _overlay(identified, own)
    return data | {"controller": controller | {"position_torque": config | {"motors": motors}}}


def _with_gains(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Lay a scenario's controller over the set of gains that it names."""
    controller = data.get("controller")
    name = controller.get("gains") if isinstance(controller, dict) else None
    if not isinstance(controller, dict) or not isinstance(name, str):
        return data
    beside = path.parent / name
    source = beside if beside.is_file() else _find(name, "gains", "gains")
    gains = _read_yaml(source)
    for part in OPTIONAL_PARTS:
        if controller.get(part) is None:
            gains.pop(part, None)
    return data | {"controller": _overlay(gains, controller)}


def _overlay(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge mappings key by key; elsewhere what is above wins."""
    merged = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            merged[key] = _overlay(below[key], above[key])
    return merged


def _find(name: str, folder: str, what: str) -> Path:
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        if path.is_file():
            return path
        raise ConfigurationError(f"no {what} file at {path}")
    packaged = Path(str(resources.files("deploy"))) / folder
    candidates = (packaged / f"{name}.yaml", packaged / name / f"{name}.yaml")
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    known = sorted(file.stem for file in packaged.rglob("*.yaml"))
    raise ConfigurationError(f"no {what} {name!r}: give a .yaml file or one of {', '.join(known)}")


class _UniqueKeys(yaml.SafeLoader):
    """A field given twice is a mistake; YAML's own rule would be that the last one wins."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key given twice."""
        keys = [key.value for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        for key, _ in node.value:
            if keys.count(key.value) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
        return super().construct_mapping(node, deep)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _UniqueKeys)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ConfigurationError(f"{path}: expected a mapping of fields at the top")
    return data


def _override(data: dict[str, Any], overrides: dict[str, Any], path: Path) -> dict[str, Any]:
    for dotted, value in overrides.items():
        node: Any = data
        *parents, leaf = dotted.split(".")
        for part in parents:
            if isinstance(node, list):
                node = node[_list_index(part, node, dotted, path)]
            elif isinstance(node, dict):
                node = node.setdefault(part, {})
            else:
                raise ConfigurationError(f"{path}: --set {dotted}: {part!r} lies below a plain value")
        if isinstance(node, list):
            node[_list_index(leaf, node, dotted, path)] = value
        elif isinstance(node, dict):
            node[leaf] = value
        else:
            raise ConfigurationError(f"{path}: --set {dotted}: {leaf!r} lies below a plain value")
    return data


def _list_index(part: str, node: list[Any], dotted: str, path: Path) -> int:
    if part.isdigit() and int(part) < len(node):
        return int(part)
    for index, item in enumerate(node):
        if isinstance(item, dict) and item.get("name") == part:
            return index
    raise ConfigurationError(f"{path}: --set {dotted}: no item {part!r} in a list of {len(node)}")


def _parse(model: type[M], data: dict[str, Any], path: Path) -> M:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigurationError(f"{path}: {_faults(error, model.__name__)}") from error


def _faults(error: ValidationError, whole: str) -> str:
    """Field and reason of the first three faults; `whole` names what has no field."""
    faults = []
    for fault in error.errors():
        field = ".".join(str(part) for part in fault["loc"]) or whole
        faults.append(f"{field}: {fault['msg'].removeprefix('Value error, ')}")
    more = f" (and {len(faults) - 3} more)" if len(faults) > 3 else ""
    return f"{'; '.join(faults[:3])}{more}"


def _check_plan(robot: RobotDescription, path: Path) -> None:
    """Refuse a robot whose buses cannot carry its plan."""
    plan = cycle_plan(robot)
    if not plan.fits:
        raise ConfigurationError(
            f"{path}: {'; '.join(plan.faults())}. To make it fit: {plan.remedies()}; to run it all the same:"
            " --allow-overload, or allow_overload: true in the scenario."
        )


def _check_urdf(robot: RobotDescription, urdf: str, path: Path, urdf_path: Path) -> None:
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ConfigurationError(f"{urdf_path}: not valid XML: {error}") from error
    joints = {joint.get("name"): joint for joint in root.iter("joint") if joint.get("type") is not None}
    links = {link.get("name") for link in root.findall("link")}
    for index, joint in enumerate(robot.joints):
        element = joints.get(joint.name)
        if element is None:
            raise ConfigurationError(f"{path}: joints.{index}.name: {urdf_path.name} has no joint {joint.name!r}")
        if element.get("type") not in {"revolute", "continuous"}:
            raise ConfigurationError(
                f"{path}: joints.{index}: {joint.name} is {element.get('type')} in {urdf_path.name}, expected revolute"
            )
    frames = [("hand_frame", robot.hand_frame)] if robot.hand_frame else []
    frames += [(f"force_torque_sensors.{i}.frame", s.frame) for i, s in enumerate(robot.force_torque_sensors)]
    frames += [(f"imus.{i}.frame", s.frame) for i, s in enumerate(robot.imus)]
    for field, frame in frames:
        if frame not in links:
            raise ConfigurationError(f"{path}: {field}: {urdf_path.name} has no link {frame!r}")
