"""`cosim experiment`: one of the papers' experiments; and what it shares with `cosim sweep`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self

import typer

from deploy.commands import options as opt

if TYPE_CHECKING:
    from rich.console import RenderableType

    from deploy.experiment import Outcome

Name = Annotated[str, typer.Argument(metavar="NAME", help="E.g. `transition`; a wrong name lists them all.")]
FirstSeed = Annotated[int, typer.Option(min=0, help="Seed, or the first of several.")]

FILE_WIDTH = 120
"""Columns of what is printed into a file or a pipe."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("experiment", epilog="Example: cosim experiment transition --seeds 5 --json")(experiment)


def experiment(
    name: Name,
    seed: FirstSeed = 0,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds in a row.")] = 1,
    vary: Annotated[
        bool, typer.Option("--vary", help="Each seed has the plant that it has in `cosim sweep`, not the scenario's.")
    ] = False,
    sets: opt.Set = None,
    out: opt.Out = None,
    processes: Annotated[bool, typer.Option("--processes", help="Services as separate processes.")] = False,
    json_: opt.Json = False,
) -> None:
    """Run an experiment, compare its metrics with their limits; exits 1 when one does not hold or a run failed.

    Writes logs, figures and metrics.json to runs/NAME; of several seeds, a folder for each and a metrics.json of all.
    """
    from dataclasses import replace
    from functools import partial

    from rich.table import Table

    from deploy.errors import DeployError
    from deploy.experiment import ExperimentResult, FailedRun, attempt, combine, find_experiment, seed_requests

    run = find_experiment(name)
    directory = out or Path("runs") / name
    requests = seed_requests(
        range(seed, seed + seeds), opt.overrides(sets), directory, vary=vary, processes=processes, apart=seeds > 1
    )
    outcomes = []
    with SeedsDisplay(f"experiment {name}", seeds) as display:
        for request in requests:
            outcomes.append(attempt(run, replace(request, progress=partial(display.tell, request.seed))))
            display.done(outcomes[-1])
            write_outcome(outcomes[-1], request.directory)
    printed = outcomes[0].as_json() if seeds == 1 else combine(name, outcomes)
    if seeds > 1:
        opt.write_json(printed, directory / "metrics.json")
    if json_:
        opt.print_json(printed)
    if seeds == 1 and isinstance(outcomes[0], FailedRun):
        raise DeployError(outcomes[0].error)
    results = [outcome for outcome in outcomes if isinstance(outcome, ExperimentResult)]
    if not json_:
        table = Table(title=f"{name} on {results[0].robot}" if results else name, title_justify="left")
        for header in ("seed", "what", "value", "limit", "holds"):
            table.add_column(header, justify="right" if header in ("value", "limit") else "left")
        for result in results:
            for bar in result.bars:
                sign, verdict = "≥" if bar.at_least else "≤", "[green]yes" if bar.holds else "[red]no"
                table.add_row(str(result.seed), bar.name, f"{bar.value:.4g}", f"{sign} {bar.limit:.4g}", verdict)
        if results:
            show(table)
        if seeds > 1:
            show(summary(name, outcomes))
        typer.echo(directory)
    if not all(outcome.passed for outcome in outcomes):
        raise typer.Exit(1)


class SeedsDisplay:
    """A bar over the runs of several seeds on a terminal, elsewhere nothing; use it as a context manager."""

    def __init__(self, title: str, count: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._display = Progress(
            TextColumn(f"[bold]{title}"),
            BarColumn(bar_width=30),
            TaskProgressColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._display.add_task("starting", total=float(count))
        self._count = count
        self._shares: dict[int, float] = {}
        self._finished = 0
        self._bad = 0

    def __enter__(self) -> Self:
        self._display.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._display.stop()

    def tell(self, seed: int, share: float, what: str) -> None:
        """Show what a run does now, and what share of it is done."""
        self._shares[seed] = share
        self._update(f"seed {seed}, {what}")

    def done(self, outcome: Outcome) -> None:
        """Count a run that is over."""
        self._shares[outcome.seed] = 1.0
        self._finished += 1
        self._bad += not outcome.passed
        self._update(f"seed {outcome.seed}, done")

    def _update(self, what: str) -> None:
        counts = f"{self._finished} of {self._count} done, {self._bad} bad; " if self._count > 1 else ""
        self._display.update(self._task, completed=sum(self._shares.values()), description=counts + what)


def summary(name: str, outcomes: Sequence[Outcome]) -> RenderableType:
    """Every bar over all seeds, how many seeds pass, and what became of those without result."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from deploy.experiment import ExperimentResult, FailedRun, summarize

    count, passed = len(outcomes), sum(outcome.passed for outcome in outcomes)
    robots = [f" on {outcome.robot}" for outcome in outcomes if isinstance(outcome, ExperimentResult)]
    table = Table(title=f"{name}{robots[0] if robots else ''}, {count} seeds", title_justify="left")
    for header in ("bar", "limit", "passes", "median", "worst", "seed"):
        table.add_column(header, justify="left" if header == "bar" else "right", no_wrap=True)
    for bar in summarize(outcomes):
        limit = f"{'≥' if bar.at_least else '≤'} {bar.limit:.4g}"
        passes = f"[{'green' if bar.holds_count == count else 'red'}]{bar.holds_count}/{count}"
        table.add_row(bar.name, limit, passes, f"{bar.median:.4g}", f"{bar.worst:.4g}", str(bar.worst_seed))
    lines = [Text(f"seed {run.seed}: {run.error}", "red") for run in outcomes if isinstance(run, FailedRun)]
    verdict = Text(f"{passed} of {count} seeds pass", "green" if passed == count else "red")
    return Group(*([table] if robots else []), *lines, verdict)


def show(what: RenderableType) -> None:
    """Print on stdout; wide enough for a table where it is not a terminal."""
    import sys

    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else FILE_WIDTH).print(what)


def write_outcome(outcome: Outcome, directory: Path | None) -> None:
    """Write metrics.json of one seed."""
    if directory is not None:
        opt.write_json(outcome.as_json(), directory / "metrics.json")
