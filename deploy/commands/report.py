"""`cosim report`: metrics and plots of a log."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("report", epilog="Example: cosim report runs/arm9-transition/run.mcap --out plots")(report)


def report(
    log: Annotated[Path, typer.Argument(metavar="run.mcap", help="A log written by `cosim up` or `cosim record`.")],
    out: opt.Out = None,
    json_: opt.Json = False,
) -> None:
    """Compute the metrics of a log, draw its plots, write metrics.json; by default beside the log."""
    from rich.console import Console

    from deploy.errors import UsageError
    from deploy.report import write_report
    from deploy.summary import summary_table

    if not log.is_file():
        raise UsageError(f"no log at {log}")
    console = Console(stderr=True)
    with console.status(f"reading {log}") if console.is_terminal else nullcontext():
        result = write_report(log, out or log.parent)
    if json_:
        opt.print_json(result.as_json())
    else:
        Console().print(summary_table(result.metrics))
        for path in result.files:
            typer.echo(path)
