"""`cosim experiment`: one of the papers' experiments."""

from __future__ import annotations

from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("experiment", epilog="Example: cosim experiment transition --seeds 5 --json")(experiment)


def experiment(
    name: Annotated[str, typer.Argument(metavar="NAME", help="E.g. `transition`; a wrong name lists them all.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed, or the first of several.")] = 0,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds in a row.")] = 1,
    sets: opt.Set = None,
    out: opt.Out = None,
    processes: Annotated[bool, typer.Option("--processes", help="Services as separate processes.")] = False,
    json_: opt.Json = False,
) -> None:
    """Run an experiment, compare its metrics with their limits; exits 1 when one does not hold."""
    from pathlib import Path

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Table

    from deploy.errors import UsageError
    from deploy.experiment import ExperimentRequest, combine, find_experiment

    run = find_experiment(name)
    directory = out or Path("runs") / name
    overrides = opt.overrides(sets)
    stderr = Console(stderr=True)
    results = []
    display = Progress(
        TextColumn("[bold]experiment {task.fields[experiment]}"),
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        TextColumn("seed {task.fields[seed]}, {task.description}"),
        TimeElapsedColumn(),
        console=stderr,
        disable=not stderr.is_terminal,
        transient=True,
    )
    with display:
        task = display.add_task("starting", total=float(seeds), experiment=name, seed=seed)
        for index in range(seeds):

            def tell(share: float, what: str, index: int = index) -> None:
                display.update(task, completed=index + share, description=what, seed=seed + index)

            place = directory if seeds == 1 else directory / f"seed-{seed + index}"
            try:
                place.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UsageError(f"--out {place}: cannot be made: {error.strerror}") from error
            results.append(run(ExperimentRequest(seed + index, overrides, place, processes, tell)))
            opt.write_json(results[-1].as_json(), place / "metrics.json")
    if json_:
        opt.print_json(results[0].as_json() if seeds == 1 else combine(results))
    else:
        table = Table(title=f"{name} on {results[0].robot}", title_justify="left")
        for header in ("seed", "what", "value", "limit", "holds"):
            table.add_column(header, justify="right" if header in ("value", "limit") else "left")
        for result in results:
            for bar in result.bars:
                sign, verdict = "≥" if bar.at_least else "≤", "[green]yes" if bar.holds else "[red]no"
                table.add_row(str(result.seed), bar.name, f"{bar.value:.4g}", f"{sign} {bar.limit:.4g}", verdict)
        Console().print(table)
        typer.echo(directory)
    if not all(result.passed for result in results):
        raise typer.Exit(1)
