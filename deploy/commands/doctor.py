"""`cosim doctor`: check that a robot description makes sense, and that a log's buses kept to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor", epilog="Example: cosim doctor --robot arm9")(doctor)


def doctor(
    robot: Annotated[str | None, typer.Option(help="Packaged name or YAML file; default: the log's.")] = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="run.mcap", help="A log: compare each bus as measured there with its worst case."),
    ] = None,
    sets: opt.Set = None,
    json_: opt.Json = False,
) -> None:
    """Check a robot description: joints, bus load, timing, sensors, limits.

    Exits 1 if the plan does not fit its buses or its period, or if a log shows lost frames or more than the worst case.
    """
    from deploy.doctor import examine, show
    from deploy.errors import UsageError
    from schemas.load import load_robot

    description = None
    if robot is not None:
        robot_sets = {path.removeprefix("robot."): value for path, value in opt.overrides(sets).items()}
        description = load_robot(robot, robot_sets, allow_overload=True).description
    elif log is None or sets:
        raise UsageError("doctor: give --robot NAME|FILE (--set needs it too), or --log run.mcap")
    if log is not None:
        from deploy.measured import compare

        if not log.is_file():
            raise UsageError(f"no log at {log}")
        description, comparisons = compare(log, description)
        diagnosis = examine(description, comparisons)
    else:
        assert description is not None
        diagnosis = examine(description)
    if json_:
        opt.print_json(diagnosis.as_json())
    else:
        import sys

        from rich.console import Console

        show(diagnosis, Console(width=None if sys.stdout.isatty() else 120))
    if not diagnosis.healthy:
        raise typer.Exit(1)
