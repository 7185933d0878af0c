"""`cosim bus`: the frames of a robot's buses: decoded, counted, to and from the files of other CAN tools."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands import options as opt

if TYPE_CHECKING:
    from deploy.bus_frames import BusFrame
    from deploy.bus_source import Feed
    from schemas.robot import RobotDescription

EXAMPLES = """Example: cosim bus --robot arm9 --bus arm9-1 --only elbow_pitch --count 20

cosim bus  (the run that is going on; --stats: until it ends or Ctrl-C)

cosim bus --robot arm9 --bus arm9-1 --channel can0  (a real bus)

cosim bus run.mcap --only EMCY --json

cosim bus run.mcap --stats

cosim bus run.mcap --to run.log  (then: canplayer -I run.log vcan0=arm9-0 vcan1=arm9-1 vcan2=arm9-2)

cosim bus candump.log --scenario arm9-transition --channel arm9-0=can0 --channel arm9-1=can1
--channel arm9-2=can2 --to frames.mcap

cosim bus --dbc --robot arm9 --bus arm9-0 --to arm9-0.dbc
"""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bus", epilog=EXAMPLES)(bus)


def bus(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="A log (.mcap) or a file of a CAN tool (.log of candump, .asc, .blf, .trc, .csv); default: live.",
        ),
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Packaged name or YAML file; default: the log's or the run's.")
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="Run that a log made by `--to x.mcap` is to state.")] = None,
    bus: Annotated[str | None, typer.Option(metavar="A,B", help="Buses of the robot; default: all.")] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[BUS=]CHANNEL",
            help="Channel of a bus instead of the description's: `can0`, a path, INTERFACE:CHANNEL; in a file: its name"
            " there, or its number (from 1). Repeatable.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WORD", help="Joint, sensor, kind of frame (TPDO1, EMCY, …) or hexadecimal id. Repeatable."
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Leave after this many frames.")] = None,
    to: Annotated[
        Path | None, typer.Option(help="Write the frames: .log, .asc, .blf, .trc, .csv, or a log .mcap.")
    ] = None,
    stats: Annotated[bool, typer.Option("--stats", help="Load of each bus, and counts by identifier.")] = False,
    dbc: Annotated[bool, typer.Option("--dbc", help="Print the DBC file of a bus; with --to: write it.")] = False,
    clock: opt.Clock = None,
    allow_overload: opt.AllowOverload = False,
    base_port: opt.BasePort = None,
    json_: opt.Json = False,
) -> None:
    """Show the frames of a robot's buses in its joints' names and SI units; convert them, count them.

    Times of a log's frames are laid out by their bits, SYNC k at k periods.
    A capture becomes a log by its SYNCs: counted in lockstep, by their times in realtime (--clock).
    """
    from deploy.bus_monitor import Monitor, Only
    from deploy.bus_source import LOG_SUFFIX, Feed, find_place
    from deploy.errors import UsageError

    if sum((stats, dbc, only is not None)) > 1 or (to is not None and (stats or only)):
        raise UsageError("give one of --only, --stats, --dbc; --to goes with --dbc or alone")
    run = opt.resolve_run(scenario, None, clock=clock, allow_overload=allow_overload) if scenario is not None else None
    place = find_place(source, robot, run, base_port)
    if dbc:
        _write_dbc(place.robot, bus, to)
        return
    feed = Feed.of(place, bus, channel or [])
    if to is not None:
        frames = islice(_frames(feed), count)
        result = _write_log(feed, frames, to) if to.suffix == LOG_SUFFIX else _write_file(feed, frames, to)
        if json_:
            opt.print_json(result)
        else:
            typer.echo(", ".join(f"{name} {value}" for name, value in result.items()))
    elif stats:
        _show_statistics(feed, count, json_)
    else:
        chosen = Only.of(place.robot, feed.buses, only or [])
        origin_ns = None if place.log is None else 0
        monitor = Monitor(place.robot, feed.buses, chosen, as_json=json_, origin_ns=origin_ns)
        for line in monitor.lines(_frames(feed), count):
            typer.echo(line)
            if place.path is None:
                sys.stdout.flush()


def _frames(feed: Feed) -> Iterator[BusFrame]:
    return feed.frames(opt.bus_channel, lambda line: typer.echo(f"cosim: {line}", err=True))


def _write_dbc(robot: RobotDescription, bus: str | None, to: Path | None) -> None:
    from deploy.bus_monitor import choose_buses
    from deploy.dbc import dbc_text
    from deploy.errors import UsageError

    buses = choose_buses(robot, bus)
    if len(buses) > 1:
        raise UsageError(f"--dbc: a DBC file is of one bus; choose by --bus one of {', '.join(buses)}")
    text = dbc_text(robot, buses[0])
    if to is None:
        sys.stdout.write(text.replace("\r\n", "\n"))
        return
    try:
        to.write_text(text, encoding="ascii", newline="")
    except OSError as error:
        raise UsageError(f"--to {to}: cannot be written: {error.strerror}") from error


def _write_file(feed: Feed, frames: Iterator[BusFrame], to: Path) -> dict[str, object]:
    from deploy.bus_files import suffix_of, write_frames
    from deploy.bus_frames import from_zero

    suffix_of(to)
    shifted = from_zero(frames, feed.place.robot.period_ns)
    channels = feed.channels
    count = write_frames(to, shifted, channels, feed.buses)
    names = [channels.channel(bus) for bus in feed.buses]
    return {"file": str(to), "frames": count, "channels": " ".join(names)}


def _write_log(feed: Feed, frames: Iterator[BusFrame], to: Path) -> dict[str, object]:
    from deploy.bus_import import messages_of
    from deploy.errors import UsageError
    from schemas.fingerprint import fingerprint
    from schemas.log import LogWriter

    run = feed.place.run
    if feed.place.log is not None:
        raise UsageError(f"--to {to}: {feed.place.path} is a log already")
    if run is None:
        raise UsageError(f"--to {to}: a log states its scenario; give --scenario instead of --robot")
    source = "live" if feed.place.path is None else feed.place.path.name
    counts: dict[str, object] = {"file": str(to)}
    topics: dict[str, int] = {}
    with LogWriter(to, run, {**fingerprint(run), "frames_of": source}) as log:
        for topic, message in messages_of(frames, run):
            log.write(topic, message)
            kind = "buses" if topic.startswith("bus/") else f"{topic}s"
            topics[kind] = topics.get(kind, 0) + 1
    return counts | {"states": topics.get("states", 0), "events": topics.get("events", 0)}


def _show_statistics(feed: Feed, count: int | None, json_: bool) -> None:
    from rich.console import Console

    from deploy.bus_stats import counted_report, logged_report
    from deploy.errors import UsageError

    log = feed.place.log
    report = logged_report(log, feed.buses) if log is not None and count is None else None
    if report is None:
        report = counted_report(feed.place.robot, islice(_frames(feed), count))
    if not report.metrics:
        raise UsageError(f"no SYNC on {', '.join(feed.buses)}: nothing to count")
    if json_:
        opt.print_json(report.as_json())
        return
    console = Console(width=None if sys.stdout.isatty() else 120)
    for heading, table in report.tables():
        console.print(heading, highlight=False)
        console.print(table)
