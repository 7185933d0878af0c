"""`cosim identify`: models of motors, and the body beyond a force/torque sensor, from logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands import options as opt

if TYPE_CHECKING:
    from deploy.identify import Identification
    from deploy.identify_ft import FtIdentification

Logs = Annotated[
    list[Path], typer.Argument(metavar="RUN.mcap…", help="Logs of one robot, written by `cosim up` or `cosim record`.")
]
YamlOut = Annotated[Path | None, typer.Option("--out", metavar="FILE.yaml", help="Write the result as YAML.")]

MOTORS_EXAMPLE = """Example: cosim identify motors runs/leg6-high-torque/run.mcap runs/leg6-high-velocity/run.mcap
--out leg6-motors.yaml --plots plots

A scenario then says controller.position_torque.motors_from: leg6-motors.yaml"""
FT_EXAMPLE = """Example: cosim identify ft runs/leg6-payload/run.mcap --out payload.yaml

The mapping `payload:` of the file is what controller.position_torque.payload takes; `cosim identify motors --payload`
reads the file."""

app = typer.Typer(help="Identify a robot from logs: its motors, or the body beyond a force/torque sensor.")


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="identify", no_args_is_help=True)


@app.command("motors", epilog=MOTORS_EXAMPLE)
def motors(
    logs: Logs,
    method: Annotated[
        str, typer.Option(metavar="least-squares|asymmetric|two-stage|qp", help="How the gains are fitted.")
    ] = "two-stage",
    weight: Annotated[float, typer.Option(min=1.0, help="w: over-estimation weighs so many times more.")] = 100.0,
    coulomb: Annotated[bool, typer.Option("--coulomb", help="Fit k_c, too.")] = False,
    window: Annotated[int, typer.Option(min=5, help="Samples of the Savitzky-Golay filter.")] = 80,
    still_velocity: Annotated[float, typer.Option(min=1e-6, help="rad/s below which a joint rests.")] = 0.05,
    slip_velocity: Annotated[
        float, typer.Option(min=0.0, help="rad/s below which a joint may stick; left out with --coulomb.")
    ] = 0.005,
    qp_samples: Annotated[int, typer.Option(min=50, help="To which a joint's samples are thinned for the QP.")] = 1000,
    phase: Annotated[list[str] | None, typer.Option(help="Use this phase's samples only. Repeatable.")] = None,
    payload: Annotated[Path | None, typer.Option(help="What `identify ft --out` wrote, instead of the URDF's.")] = None,
    piecewise: Annotated[bool, typer.Option("--piecewise", help="Fit the piecewise models, too.")] = False,
    out: YamlOut = None,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Draw model and residuals of every joint.")] = None,
    json_: opt.Json = False,
) -> None:
    """Identify the motor models Δq = k_τ τ + k_v q̇ + k_c sign(q̇) of a robot whose drives take positions only."""
    from deploy.errors import UsageError
    from deploy.identify import FitMethod, IdentifyOptions, identify
    from deploy.motor_data import read_states
    from deploy.motor_file import read_payload, write_motors
    from schemas.control_law import SavitzkyGolayFilter

    _check_files(logs)
    if method not in list(FitMethod):
        raise UsageError(f"--method {method}: expected one of {', '.join(FitMethod)}")
    options = IdentifyOptions(
        FitMethod(method),
        weight,
        coulomb=coulomb,
        still_velocity=still_velocity,
        slip_velocity=slip_velocity,
        qp_samples=qp_samples,
        filter=SavitzkyGolayFilter(window=window),
        payload=None if payload is None else read_payload(payload),
        phases=tuple(phase or ()),
        piecewise=piecewise or plots is not None,
    )
    with _progress() as tell:
        series = []
        for number, path in enumerate(logs):
            tell(0.7 * number / len(logs), f"reading {path}")
            series.append(read_states(path, phases=bool(phase)))
        names = [path.name if path.name != "run.mcap" else f"{path.resolve().parent.name}/{path.name}" for path in logs]
        result = identify(series, options, names=names, progress=lambda share, what: tell(0.7 + 0.2 * share, what))
        if plots is not None:
            tell(0.9, "drawing")
            _draw(result, plots)
    if out is not None:
        write_motors(result, out)
    if json_:
        opt.print_json(result.as_json())
        return
    _print_motors(result)
    for written in (out, plots):
        if written is not None:
            typer.echo(written)


@app.command("ft", epilog=FT_EXAMPLE)
def ft(
    logs: Logs,
    sensor: Annotated[str | None, typer.Option(help="Force/torque sensor; default: the robot's first.")] = None,
    out: YamlOut = None,
    json_: opt.Json = False,
) -> None:
    """Identify the mass and centre of the body beyond a force/torque sensor, and its offsets, from poses at rest."""
    from deploy.identify_ft import identify_ft
    from deploy.motor_file import write_payload

    _check_files(logs)
    with _progress() as tell:
        result = identify_ft(logs, sensor, progress=tell)
    if out is not None:
        header = [
            f"Body beyond sensor {result.sensor} of {result.robot.name}, and its offsets, identified by"
            f" `cosim identify ft` from {', '.join(result.logs)},",
            f"{len(result.poses)} poses at rest. Units: kg, m, N, N·m, in the sensor's frame.",
        ]
        write_payload(result.payload, header, out)
    if json_:
        opt.print_json(result.as_json())
        return
    _print_ft(result)
    if out is not None:
        typer.echo(out)


def _print_motors(result: Identification) -> None:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from deploy.commands.experiment import show
    from deploy.identify import weight_of

    options = result.options
    for name in result.cut:
        typer.echo(f"cosim: {name}: the log is cut short; what there is was used", err=True)
    table = Table(
        title=f"Motors of {result.robot.name}: {options.method.value}, w = {weight_of(options):g};"
        " over-estimation of |Δq|: rate, largest over the largest |Δq|",
        title_justify="left",
    )
    gains = ("10³ k_τ\n\\[rad/N·m]", "10³ k_v\n\\[s]", *(("10³ k_c\n\\[rad]",) if options.coulomb else ()))
    for column in (
        "joint",
        *gains,
        "rms\n\\[mrad]",
        "R²",
        "over\nrate",
        "over\nmax",
        "τ reached\n\\[% of limit]",
        "q̇ reached\n",
    ):
        table.add_column(column, justify="left" if column == "joint" else "right", no_wrap=True)
    for each in result.joints:
        fit, statistics = each.fit, each.fit.statistics
        table.add_row(
            each.joint,
            f"{1e3 * fit.torque_gain:.4f}",
            f"{1e3 * fit.velocity_gain:.2f}",
            *((f"{1e3 * fit.coulomb:.3f}",) if options.coulomb else ()),
            f"{1e3 * statistics.rms_residual:.3f}",
            f"{statistics.r_squared:.4f}",
            f"{statistics.over_estimation_rate:.1%}",
            f"{statistics.largest_over_estimation_relative:.1%}",
            f"{each.torque_reached:.0%}",
            f"{each.velocity_reached:.0%}",
        )
    lines = []
    left_out = [f"{count} {reason}" for reason, count in result.data.left_out.items()]
    near = [f"{each.limited} of {each.joint}" for each in result.joints if each.limited]
    left_out += [f"{', '.join(near)} near the drive's torque limit"] if near else []
    lines.append(Text(f"{result.data.rows} rows; left out: {'; '.join(left_out) or 'none'}"))
    for each in result.joints:
        if each.piecewise is not None:
            sides = {"q̇ > 0": each.piecewise.positive, "q̇ < 0": each.piecewise.negative}
            states = [f"{side} {fit.status.value} (iteration {fit.iterations})" for side, fit in sides.items()]
            lines.append(Text(f"piecewise, {each.joint}: {'; '.join(states)}"))
        if not each.fit.converged:
            gradient = each.fit.gradient_residual
            lines.append(Text(f"{each.joint}: the fit did not converge, gradient {gradient:.1e}", "yellow"))
    show(Group(table, *lines))


def _print_ft(result: FtIdentification) -> None:
    from rich.table import Table

    from deploy.commands.experiment import show

    fit = result.fit
    urdf_mass = fit.payload.mass - result.difference.mass
    urdf_centre = fit.payload.centre_of_mass - result.difference.centre_of_mass
    table = Table(
        title=f"Beyond sensor {result.sensor} of {result.robot.name}: {len(result.poses)} poses, condition"
        f" {fit.condition:.1f}, residuals {fit.residual_force_rms:.2g} N, {fit.residual_torque_rms:.2g} N·m",
        title_justify="left",
    )
    for column in ("what", "identified", "URDF"):
        table.add_column(column, justify="left" if column == "what" else "right")
    table.add_row("mass [kg]", f"{fit.payload.mass:.4f} ± {fit.mass_deviation:.4f}", f"{urdf_mass:.4f}")
    for axis, value, own in zip("xyz", fit.payload.centre_of_mass, urdf_centre, strict=True):
        table.add_row(f"centre {axis} [m]", f"{value:.4f}", f"{own:.4f}")
    names = [f"{kind} {axis} {unit}" for kind, unit in (("f", "[N]"), ("n", "[N·m]")) for axis in "xyz"]
    for name, value, deviation in zip(names, fit.payload.wrench_offset, fit.offset_deviation, strict=True):
        table.add_row(f"offset {name}", f"{value:.3f} ± {deviation:.3f}", "–")
    show(table)


def _draw(result: Identification, directory: Path) -> None:
    """Draw the figures of every joint."""
    from deploy.errors import UsageError
    from experiments.figures import friction_figure, motor_figure, save

    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--plots {directory}: cannot be made: {error.strerror}") from error
    for index in range(len(result.joints)):
        save(motor_figure(result, index), directory / f"{result.joints[index].joint}-torque")
        save(friction_figure(result, index), directory / f"{result.joints[index].joint}-friction")


def _check_files(logs: list[Path]) -> None:
    from deploy.errors import UsageError

    for path in logs:
        if not path.is_file():
            raise UsageError(f"no log at {path}")


@contextmanager
def _progress() -> Iterator[Callable[[float, str], None]]:
    """Show a bar on a terminal, elsewhere nothing."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (BarColumn(bar_width=30), TaskProgressColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(
        TextColumn("[bold]identify"), *columns, console=console, disable=not console.is_terminal, transient=True
    ) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda share, what: bar.update(task, completed=share, description=what)
