"""`cosim stop`: the operator's emergency stop and its reset."""

from __future__ import annotations

from typing import Annotated

import typer

from deploy.commands import options as opt


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("stop", epilog="Example: cosim stop --reason 'cable caught'; later cosim stop --reset")(stop)


def stop(
    reset: Annotated[bool, typer.Option("--reset", help="Clear a latched emergency stop instead.")] = False,
    reason: Annotated[str, typer.Option(help="Written into the log.")] = "",
    base_port: opt.BasePort = None,
) -> None:
    """Make the HAL of the running session hold the robot; it stays latched until `--reset`."""
    from deploy.monitor import send_request
    from deploy.session import choose_session
    from schemas.messages import OperatorRequest

    session = choose_session(base_port)
    answer = send_request(session, OperatorRequest(action="reset" if reset else "stop", reason=reason))
    typer.echo(f"{session.scenario} (process {session.pid}): {answer}")
