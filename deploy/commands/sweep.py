"""`cosim sweep`: an experiment over many seeds, each with a plant of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands import options as opt
from deploy.commands.experiment import FirstSeed, Name, SeedsDisplay, show, summary, write_outcome


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("sweep", epilog="Example: cosim sweep transition --seeds 20 --jobs 4")(sweep)


def sweep(
    name: Name,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds in a row.")] = 20,
    seed: FirstSeed = 0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; default: the processors there are.")
    ] = None,
    sets: opt.Set = None,
    out: opt.Out = None,
    nominal: Annotated[
        bool, typer.Option("--nominal", help="All seeds with the scenario's plant, none with one of its own.")
    ] = False,
    keep_logs: Annotated[
        bool, typer.Option("--keep-logs", help="Keep the run.mcap of seeds that pass, too; the others' are kept.")
    ] = False,
    json_: opt.Json = False,
) -> None:
    """Repeat an experiment over seeds that vary the plant; exits 1 when a seed does not pass.

    Each seed has its own torque constants, friction and masses; `--set` wins over them. `cosim experiment NAME --vary
    --seed N` repeats one of the runs. Writes metrics.json, sweep.png and a folder for each seed to runs/sweep-NAME.
    """
    from deploy.experiment import Outcome, combine, find_experiment, seed_requests
    from deploy.sweep import Progress, usable_cpus
    from deploy.sweep import sweep as run_sweep
    from deploy.sweep_figure import sweep_figure

    run = find_experiment(name)
    directory = out or Path("runs") / f"sweep-{name}"
    requests = seed_requests(range(seed, seed + seeds), opt.overrides(sets), directory, vary=not nominal)
    places = {request.seed: request.directory for request in requests}
    with SeedsDisplay(f"sweep {name}", seeds) as display:

        def tell(heard: Progress) -> None:
            display.tell(heard.seed, heard.share, heard.what)

        def done(outcome: Outcome) -> None:
            display.done(outcome)
            write_outcome(outcome, places[outcome.seed])

        outcomes = run_sweep(run, requests, jobs or usable_cpus(), keep_logs=keep_logs, progress=tell, done=done)
    result = combine(name, outcomes)
    opt.write_json(result, directory / "metrics.json")
    if result["bars"]:
        sweep_figure(name, outcomes).savefig(directory / "sweep.png", dpi=120)
    if json_:
        opt.print_json(result)
    else:
        show(summary(name, outcomes))
        typer.echo(directory)
    if not result["passed"]:
        raise typer.Exit(1)
