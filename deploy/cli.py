"""The command line `cosim`: one subcommand a module of `deploy.commands`, errors in one place."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

from deploy.commands import bus, can_vm, doctor, experiment, identify, replay, report, service, stop, sweep, up
from schemas.errors import CosimError

app = typer.Typer(
    name="cosim",
    help="Co-simulation and hardware abstraction for torque control of robots with high-reduction gears.",
    epilog="Example: cosim up arm9-transition --duration 5",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show a traceback when something fails.")] = False,
) -> None:
    del debug  # read by `main`, which must know it before parsing can fail


for module in (up, service, stop, doctor, replay, report, identify, experiment, sweep, bus, can_vm):
    module.register(app)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0 fine, 1 the result is bad, 2 wrong usage or configuration."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        app(arguments, prog_name="cosim")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except CosimError as error:
        return _report(str(error), error.exit_code, debug)
    except KeyboardInterrupt:
        return _report("interrupted", 1, debug=False)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # a reader such as `head` has seen enough
        return 1
    except Exception as error:  # noqa: BLE001 the outermost edge: a user gets a line, a developer the traceback
        return _report(f"internal error: {type(error).__name__}: {error} (`cosim --debug …` shows where)", 1, debug)
    return 0


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"cosim: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
