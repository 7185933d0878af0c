"""`cosim up`: a whole run."""

from __future__ import annotations

from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("up", epilog="Example: cosim up arm9-transition --duration 5 --set plant.torque_scale=0.8")(up)


def up(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="Packaged name or YAML file.")],
    duration: Annotated[float | None, typer.Option(help="Length [s simulated]; default: the scenario's.")] = None,
    seed: opt.Seed = None,
    out: opt.Out = None,
    sets: opt.Set = None,
    clock: opt.Clock = None,
    bus: opt.Bus = None,
    base_port: opt.BasePort = None,
    no_plant: Annotated[bool, typer.Option("--no-plant", help="The robot is real: start no plant.")] = False,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Only the table and metrics.json at the end.")] = False,
    json_: opt.Json = False,
) -> None:
    """Launch plant, HAL, controller and recorder as processes, supervise them, summarise the log."""
    import time
    from contextlib import nullcontext

    from rich.console import Console

    from deploy.launcher import launch, output_directory, plan
    from deploy.monitor import RunMonitor
    from deploy.progress import RunProgress

    run = opt.resolve_run(scenario, sets, seed=seed, duration_s=duration, clock=clock, bus=bus)
    directory = output_directory(run, out, time.localtime())
    prepared = plan(run, directory, base_port=base_port, with_plant=not no_plant)
    with RunProgress(run, Console(stderr=True)) as progress:
        outcome = launch(prepared, progress, RunMonitor)
    from deploy.report import write_report
    from deploy.summary import summary_table

    console = Console(stderr=True)
    with console.status("summing up") if console.is_terminal else nullcontext():
        result = write_report(prepared.log, directory, plots=not no_plots)
    if json_:
        opt.print_json({**result.as_json(), "interrupted": outcome.interrupted, "recorder_lost": outcome.recorder_lost})
    else:
        Console().print(summary_table(result.metrics))
        for path in (prepared.log, *result.files):
            typer.echo(path)
    if outcome.recorder_lost:
        typer.echo(f"the recorder was lost: {prepared.log} ends early", err=True)
    if outcome.interrupted:
        typer.echo(f"interrupted; the log up to there is {prepared.log}", err=True)
        raise typer.Exit(1)
