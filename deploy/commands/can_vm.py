"""`cosim can-vm`: a command in the CAN machine."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

TCG = "tcg,thread=multi"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "can-vm",
        epilog="Example: cosim can-vm -- cosim up arm9-transition --bus vcan0,vcan1,vcan2 --duration 0.5",
    )(can_vm)


def can_vm(
    command: Annotated[list[str] | None, typer.Argument(help="The command and its arguments, after `--`.")] = None,
    prepare: Annotated[bool, typer.Option("--prepare", help="Only fetch what the machine is built from.")] = False,
    timeout: Annotated[float, typer.Option(min=0.0, help="Limit for the command in seconds, after the boot.")] = 3600.0,
    env: Annotated[
        list[str] | None, typer.Option("--env", metavar="NAME=VALUE", help="Variable for the command; repeatable.")
    ] = None,
    cpus: Annotated[int, typer.Option(min=1, help="Virtual processors.")] = 2,
    memory: Annotated[int, typer.Option(min=512, help="Memory in MB.")] = 4096,
    accel: Annotated[str, typer.Option(help="QEMU's accelerator; `kvm` where the computer has it.")] = TCG,
    cache: Annotated[
        Path | None, typer.Option(help="Folder for the kernel; default: COSIM_CACHE_DIR or the user's cache folder.")
    ] = None,
) -> None:
    """Run a command on a Linux with CAN: vcan0-3 and the emulated cards can0/can1, can2/can3, can4/can5.

    The command sees this computer's files and runs in the current folder; its output and exit code are handed on.
    """
    from deploy import can_vm as machine
    from deploy.errors import UsageError

    if prepare == bool(command):
        raise UsageError("can-vm: give either a command after `--` or --prepare")
    variables: dict[str, str] = {}
    for text in env or []:
        name, separator, content = text.partition("=")
        if not (name and separator):
            raise UsageError(f"--env {text}: expected NAME=VALUE")
        variables[name] = content
    if not command:
        parts = machine.prepare(cache or machine.default_cache())
        typer.echo(f"the CAN machine is ready: {parts.kernel}")
        return

    def out(data: bytes) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    def err(data: bytes) -> None:
        sys.stderr.buffer.write(data)
        sys.stderr.buffer.flush()

    completed = machine.run_in_machine(
        command,
        timeout_s=timeout,
        env=variables,
        cache=cache,
        config=machine.MachineConfig(cpus=cpus, memory_mb=memory, accelerator=accel),
        stdout=out,
        stderr=err,
    )
    raise typer.Exit(completed.code)
