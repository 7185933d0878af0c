"""`cosim bus`: the frames of a bus, decoded."""

from __future__ import annotations

from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bus", epilog="Example: cosim bus --robot arm9 --bus arm_upper --count 20")(bus)


def bus(
    robot: Annotated[str, typer.Option(help="Packaged name or YAML file.")],
    bus: Annotated[str | None, typer.Option(help="Bus of the robot; default: its first.")] = None,
    channel: Annotated[
        str | None, typer.Option(help="Channel instead of the description's: `can0`, a path, INTERFACE:CHANNEL.")
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Leave after this many frames.")] = None,
    base_port: opt.BasePort = None,
    json_: opt.Json = False,
) -> None:
    """Print the frames of a bus as they pass, with the names of joints and objects."""
    from deploy.bus_monitor import watch
    from schemas.load import load_robot

    override = opt.bus_channel(channel) if channel else None
    watch(load_robot(robot).description, bus, override, count, base_port, typer.echo, as_json=json_)
