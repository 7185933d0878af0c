"""Options that several commands share, and the run they add up to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from schemas.load import Run
    from schemas.robot import RobotDescription

Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="Override a field; `robot.…` reaches the robot. Repeatable."),
]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of everything random; default: the scenario's.")]
Clock = Annotated[str | None, typer.Option(metavar="lockstep|realtime", help="Default: the scenario's.")]
Bus = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="Channels of the robot's buses, in order: `can0`, `vcan0` (SocketCAN), a path or name (virtual),"
        " or INTERFACE:CHANNEL for any python-can interface. HAL and plant may be told different ends of one wire.",
    ),
]
PlantBus = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="The plant's own channels where they are not the HAL's, e.g. the other one of two CAN cards on each wire.",
    ),
]
AllowOverload = Annotated[
    bool,
    typer.Option(
        "--allow-overload", help="Run although the buses cannot carry the plan; the summary says what is lost."
    ),
]
BasePort = Annotated[
    int | None, typer.Option(min=1024, max=65000, help="First of the run's consecutive loopback TCP ports.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Out = Annotated[Path | None, typer.Option("--out", help="Output directory.")]

SOCKETCAN_NAMES = ("can", "vcan", "slcan")


def overrides(
    sets: list[str] | None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    clock: str | None = None,
    allow_overload: bool = False,
) -> dict[str, Any]:
    """Dotted paths and values as `schemas.load.load_run` takes them; the later options win over `--set`.

    Raises:
        UsageError: an entry of `--set` is not PATH=VALUE.

    """
    import yaml

    from deploy.errors import UsageError

    result: dict[str, Any] = {}
    for entry in sets or []:
        path, equals, value = entry.partition("=")
        if not equals or not path:
            raise UsageError(f"--set {entry}: expected PATH=VALUE, e.g. plant.torque_scale=0.8")
        try:
            result[path] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise UsageError(f"--set {entry}: the value is not YAML") from error
    if seed is not None:
        result["seed"] = seed
    if duration_s is not None:
        result["duration_s"] = duration_s
    if clock is not None:
        result["clock"] = clock
    if allow_overload:
        result["allow_overload"] = True
    return result


def bus_channel(text: str) -> tuple[str, str]:
    """Interface and channel of `can0`, `name`, `/path` or `interface:channel`."""
    interface, colon, channel = text.strip().partition(":")
    if colon:
        return interface, channel
    name = text.strip()
    is_kernel = name.rstrip("0123456789") in SOCKETCAN_NAMES and name[-1:].isdigit()
    return ("socketcan" if is_kernel else "cosim"), name


def bus_lines(robot: RobotDescription, bus: str | None, plant_bus: str | None) -> list[dict[str, Any]]:
    """Bus lines, as `schemas.load.rewire` takes them, of `--bus` (for HAL and plant) and `--plant-bus`.

    Raises:
        UsageError: not one channel a bus, or the two sides of a bus are of different interfaces.

    """
    from deploy.errors import UsageError
    from schemas.robot import VIRTUAL_INTERFACE

    lines: list[dict[str, Any]] = [{} for _ in robot.buses]
    if bus is not None:
        for line, (interface, channel) in zip(lines, _channels(robot, "--bus", bus), strict=True):
            line |= {"interface": interface, "channel": channel, "plant_channel": None}
    if plant_bus is not None:
        sides = _channels(robot, "--plant-bus", plant_bus)
        for line, each, (interface, channel) in zip(lines, robot.buses, sides, strict=True):
            of_hal = line.get("interface", each.interface)
            if of_hal == VIRTUAL_INTERFACE:
                raise UsageError(
                    f"--plant-bus {plant_bus}: bus {each.name} is virtual, with one channel for HAL and plant; name the"
                    " HAL's side of real buses by --bus"
                )
            if interface != of_hal:
                raise UsageError(
                    f"--plant-bus {plant_bus}: {channel} is of interface {interface}, but bus {each.name} is opened by"
                    f" {of_hal}; both sides have the same interface"
                )
            line["plant_channel"] = channel
    return lines


def _channels(robot: RobotDescription, option: str, text: str) -> list[tuple[str, str]]:
    """Interface and channel of each bus of a robot."""
    from deploy.errors import UsageError

    names = ", ".join(bus.name for bus in robot.buses)
    channels = [bus_channel(part) for part in text.split(",")]
    if len(channels) != len(robot.buses):
        raise UsageError(
            f"{option} {text}: {len(channels)} channels; robot {robot.name} has {len(robot.buses)} buses: {names}"
        )
    if not all(interface and channel for interface, channel in channels):
        raise UsageError(f"{option} {text}: a channel is empty; expected one for each of {names}")
    return channels


def resolve_run(
    scenario: str,
    sets: list[str] | None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    clock: str | None = None,
    bus: str | None = None,
    plant_bus: str | None = None,
    allow_overload: bool = False,
) -> Run:
    """Load the run that a command's options describe.

    Raises:
        ConfigurationError: a file, field or option is wrong.

    """
    from dataclasses import replace

    from deploy.errors import UsageError
    from schemas.errors import ConfigurationError
    from schemas.load import load_run, rewire

    chosen = overrides(sets, seed=seed, duration_s=duration_s, clock=clock, allow_overload=allow_overload)
    run = load_run(scenario, chosen)
    if bus is None and plant_bus is None:
        return run
    lines = bus_lines(run.robot.description, bus, plant_bus)
    try:
        return replace(run, robot=rewire(run.robot, lines))
    except ConfigurationError as error:
        given = [f"{name} {text}" for name, text in (("--bus", bus), ("--plant-bus", plant_bus)) if text is not None]
        raise UsageError(f"{' '.join(given)}: {error}") from error


def print_json(result: object) -> None:
    """Print one JSON object on stdout."""
    typer.echo(json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False))


def write_json(result: object, path: Path) -> None:
    """Write what `print_json` prints into a file."""
    path.write_text(json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
