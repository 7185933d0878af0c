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
    plant_bus: opt.PlantBus = None,
    base_port: opt.BasePort = None,
    no_plant: Annotated[bool, typer.Option("--no-plant", help="The robot is real: start no plant.")] = False,
    allow_overload: opt.AllowOverload = False,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Only the table and metrics.json at the end.")] = False,
    json_: opt.Json = False,
) -> None:
    """Launch plant, HAL, controller and recorder as processes, supervise them, summarise the log."""
    import time
    from contextlib import nullcontext

    from rich.console import Console

    from deploy.errors import ChildDiedError, UsageError
    from deploy.launcher import Outcome, launch, output_directory, plan
    from deploy.monitor import RunMonitor
    from deploy.progress import RunProgress
    from deploy.report import write_report  # here, so that the end of a run does not wait for it
    from deploy.summary import summary_table
    from schemas.errors import CosimError

    if no_plant and plant_bus is not None:
        raise UsageError(f"--plant-bus {plant_bus}: with --no-plant there is no plant to open it")
    run = opt.resolve_run(
        scenario,
        sets,
        seed=seed,
        duration_s=duration,
        clock=clock,
        bus=bus,
        plant_bus=plant_bus,
        allow_overload=allow_overload,
    )
    directory = output_directory(run, out, time.localtime())
    prepared = plan(run, directory, base_port=base_port, with_plant=not no_plant)
    failure: ChildDiedError | None = None
    outcome: Outcome | None = None
    with RunProgress(run, Console(stderr=True)) as progress:
        try:
            outcome = launch(prepared, progress, RunMonitor)
        except ChildDiedError as error:
            failure = error
    if failure is not None and not prepared.log.is_file():
        raise failure
    console = Console(stderr=True)
    try:
        with console.status("summing up") if console.is_terminal else nullcontext():
            result = write_report(prepared.log, directory, plots=not no_plots)
    except CosimError as error:
        raise failure or error from error
    ending = {
        "interrupted": outcome is not None and outcome.interrupted,
        "recorder_lost": outcome is not None and outcome.recorder_lost,
        "failure": None if failure is None else str(failure),
    }
    if json_:
        opt.print_json({**result.as_json(), **ending})
    else:
        Console().print(summary_table(result.metrics))
        for path in (prepared.log, *result.files):
            typer.echo(path)
    if failure is not None:
        raise failure
    if ending["recorder_lost"]:
        typer.echo(f"the recorder was lost: {prepared.log} ends early", err=True)
    if ending["interrupted"]:
        typer.echo(f"interrupted; the log up to there is {prepared.log}", err=True)
        raise typer.Exit(1)
