"""`cosim doctor`: check that a robot description makes sense."""

from __future__ import annotations

from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor", epilog="Example: cosim doctor --robot arm9")(doctor)


def doctor(
    robot: Annotated[str, typer.Option(help="Packaged name or YAML file.")],
    sets: opt.Set = None,
    json_: opt.Json = False,
) -> None:
    """Check a robot description: joints, bus load, timing, sensors, limits. Exits 1 if a cycle does not fit."""
    from deploy.doctor import examine, show
    from schemas.load import load_robot

    robot_sets = {path.removeprefix("robot."): value for path, value in opt.overrides(sets).items()}
    description = load_robot(robot, robot_sets).description
    diagnosis = examine(description)
    if json_:
        opt.print_json(diagnosis.as_json())
    else:
        import sys

        from rich.console import Console

        show(description, diagnosis, Console(width=None if sys.stdout.isatty() else 120))
    if not diagnosis.fits:
        raise typer.Exit(1)
