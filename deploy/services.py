"""Entry of a service process: `python -m deploy.services plant --run-file run.json …`; started by the launcher."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from deploy.run_file import read_run
from schemas.errors import CosimError
from schemas.load import Run
from schemas.service import Service, ServiceOptions

ServiceBody = Callable[[Run, ServiceOptions], int]
"""A service: runs to its end and returns the exit code; it handles SIGTERM and SIGINT itself."""


def body(service: Service) -> ServiceBody:
    """Import only what the service needs."""
    if service is Service.PLANT:
        from plant_service.service import run_plant

        return run_plant
    if service is Service.HAL:
        from hal.service import run_hal

        return run_hal
    if service is Service.CONTROLLER:
        from controller_service.service import run_controller

        return run_controller
    from deploy.recorder import record

    return record


def arguments(service: Service, run_file: Path, options: ServiceOptions) -> list[str]:
    """Command line (after the interpreter) that gives `main` these options."""
    line = ["-m", "deploy.services", str(service), "--run-file", str(run_file)]
    line += ["--base-port", str(options.base_port), "--session", options.session]
    line += ["--peers", ",".join(options.peers), "--run-directory", str(options.run_directory)]
    if options.output is not None:
        line += ["--output", str(options.output)]
    return line


def run_service(service: Service, run: Run, options: ServiceOptions, *, debug: bool = False) -> int:
    """Run one service to its end; a `CosimError` becomes one line on stderr and its exit code."""
    try:
        return body(service)(run, options)
    except CosimError as error:
        if debug:
            traceback.print_exc()
        print(said_by(service, str(error)), file=sys.stderr, flush=True)
        return error.exit_code


def said_by(service: Service, words: str) -> str:
    """Put the speaker's name before words that do not begin with it."""
    return words if words.startswith(f"{service}: ") else f"{service}: {words}"


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="deploy.services", description=__doc__)
    parser.add_argument("service", type=Service, choices=list(Service))
    parser.add_argument("--run-file", type=Path, required=True)
    parser.add_argument("--base-port", type=int, required=True)
    parser.add_argument("--session", required=True)
    parser.add_argument("--peers", default="", help="comma-separated services of the run")
    parser.add_argument("--run-directory", type=Path, required=True)
    parser.add_argument("--output", type=Path)
    parsed = parser.parse_args(argv)
    options = ServiceOptions(
        base_port=parsed.base_port,
        session=parsed.session,
        peers=tuple(peer for peer in parsed.peers.split(",") if peer),
        run_directory=parsed.run_directory,
        output=parsed.output,
    )
    try:
        run = read_run(parsed.run_file)
    except CosimError as error:
        print(f"{parsed.service}: {error}", file=sys.stderr)
        return error.exit_code
    return run_service(parsed.service, run, options)


if __name__ == "__main__":
    sys.exit(main())
