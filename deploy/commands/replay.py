"""`cosim replay`: check that a log comes out the same again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("replay", epilog="Example: cosim replay runs/arm9-transition/run.mcap --all")(replay)


def replay(
    log: Annotated[Path, typer.Argument(metavar="run.mcap", help="A log written by `cosim up` or `cosim record`.")],
    hal: Annotated[bool, typer.Option("--hal", help="Logged frames through the decoder; compare states.")] = False,
    plant: Annotated[bool, typer.Option("--plant", help="Logged commands to a fresh plant; compare frames.")] = False,
    every: Annotated[bool, typer.Option("--all", help="Controller, HAL and plant.")] = False,
    json_: opt.Json = False,
) -> None:
    """Feed logged states through a fresh controller and compare its commands; exits 1 at the first difference."""
    from rich.console import Console

    from deploy.errors import UsageError

    if not log.is_file():
        raise UsageError(f"no log at {log}")
    from deploy.replay import replay_log

    chosen = [name for name, wanted in (("hal", hal), ("plant", plant)) if wanted] or ["controller"]
    parts = ["controller", "hal", "plant"] if every else chosen
    stderr = Console(stderr=True)
    results = []
    for part in parts:
        if stderr.is_terminal:
            with stderr.status(f"replaying {part}"):
                results.append(replay_log(log, part))
        else:
            results.append(replay_log(log, part))
    if json_:
        opt.print_json([result.as_json() for result in results])
    else:
        for result in results:
            typer.echo(result.describe())
    if not all(result.passed for result in results):
        raise typer.Exit(1)
