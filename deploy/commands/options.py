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
        " or INTERFACE:CHANNEL for any python-can interface.",
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
    bus: str | None = None,
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
    for index, channel in enumerate(bus.split(",") if bus else ()):
        interface, name = bus_channel(channel)
        result[f"robot.buses.{index}.interface"] = interface
        result[f"robot.buses.{index}.channel"] = name
    return result


def bus_channel(text: str) -> tuple[str, str]:
    """Interface and channel of `can0`, `name`, `/path` or `interface:channel`."""
    interface, colon, channel = text.strip().partition(":")
    if colon:
        return interface, channel
    name = text.strip()
    is_kernel = name.rstrip("0123456789") in SOCKETCAN_NAMES and name[-1:].isdigit()
    return ("socketcan" if is_kernel else "cosim"), name


def check_buses(robot: RobotDescription, bus: str | None) -> None:
    """Refuse a `--bus` that leaves a bus unnamed.

    Raises:
        UsageError: fewer channels than the robot has buses.

    """
    from deploy.errors import UsageError

    if bus is not None and len(bus.split(",")) != len(robot.buses):
        raise UsageError(
            f"--bus {bus}: {len(bus.split(','))} channels; robot {robot.name} has {len(robot.buses)} buses:"
            f" {', '.join(b.name for b in robot.buses)}"
        )


def resolve_run(
    scenario: str,
    sets: list[str] | None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    clock: str | None = None,
    bus: str | None = None,
) -> Run:
    """Load the run that a command's options describe.

    Raises:
        ConfigurationError: a file, field or option is wrong.

    """
    from schemas.load import load_run

    run = load_run(scenario, overrides(sets, seed=seed, duration_s=duration_s, clock=clock, bus=bus))
    check_buses(run.robot.description, bus)
    return run


def print_json(result: object) -> None:
    """Print one JSON object on stdout."""
    typer.echo(json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False))


def write_json(result: object, path: Path) -> None:
    """Write what `print_json` prints into a file."""
    path.write_text(json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
