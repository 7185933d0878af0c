"""Where a run lives on this machine: its directory for bus sockets, its ports, and the note by which others find it."""

from __future__ import annotations

import json
import os
import shutil
import socket
from dataclasses import asdict, dataclass
from pathlib import Path

from deploy.errors import LaunchError, UsageError
from schemas.load import Run
from schemas.service import Service, ServiceOptions

RUN_DIRECTORY_VARIABLE = "COSIM_RUN_DIR"
"""Environment variable that names the directory of bare bus channels."""
LONGEST_DIRECTORY = 80
"""[bytes]; a socket's path holds 107 (AF_UNIX), this leaves room for the channel's name."""
PORTS = len(Service)
FIRST_PORT = 20000
NOTE = "session.json"


@dataclass(frozen=True, slots=True)
class RunningSession:
    """The note a launcher leaves in its run directory while the run lasts."""

    pid: int
    base_port: int
    session: str
    namespace: str
    robot: str
    scenario: str
    directory: str
    output: str


def runtime_root() -> Path:
    """Directory of the runs on this machine: that of bare bus channels, `COSIM_RUN_DIR` or this user's in `/tmp`."""
    from hal.bus.address import run_directory as directory_of_bare_channels

    return directory_of_bare_channels()


def run_directory(base_port: int) -> Path:
    """Directory of one run's sockets, by its port under `runtime_root`.

    Raises:
        LaunchError: it cannot be made, or its path is too long for a socket.

    """
    path = (runtime_root() / str(base_port)).absolute()
    if len(os.fsencode(path)) > LONGEST_DIRECTORY:
        raise LaunchError(
            f"{path}: longer than {LONGEST_DIRECTORY} bytes, too long for bus sockets;"
            f" set {RUN_DIRECTORY_VARIABLE} to a shorter path"
        )
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise LaunchError(f"cannot make the run directory {path}: {error.strerror}") from error
    return path


def discard(directory: Path) -> None:
    """Remove a run's directory."""
    shutil.rmtree(directory, ignore_errors=True)


def free_base_port() -> int:
    """First of `PORTS` consecutive loopback TCP ports that are free now, for a run beside others.

    Raises:
        LaunchError: none found.

    """
    first = FIRST_PORT + PORTS * (os.getpid() % 1000)
    for base in range(first, first + 400 * PORTS, PORTS):
        if all(_is_free(port) for port in range(base, base + PORTS)):
            return base
    raise LaunchError(f"no {PORTS} consecutive free TCP ports from {first} on; give --base-port")


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def describe(run: Run, options: ServiceOptions, output: Path) -> RunningSession:
    """Note of a run supervised by this process."""
    return RunningSession(
        pid=os.getpid(),
        base_port=options.base_port,
        session=options.session,
        namespace=run.scenario.namespace,
        robot=run.robot.description.name,
        scenario=run.scenario.name,
        directory=str(options.run_directory),
        output=str(output.absolute()),
    )


def refuse_taken(base_port: int) -> None:
    """Refuse the base port of a run that is going on: its directory, sockets and note are that run's.

    Raises:
        UsageError: naming that run.

    """
    for session in running_sessions():
        if session.base_port == base_port and session.pid != os.getpid():
            raise UsageError(
                f"--base-port {base_port}: taken by {session.scenario} (process {session.pid}); give another"
            )


def announce(session: RunningSession) -> None:
    """Leave the note, one a base port."""
    path = run_directory(session.base_port) / NOTE
    path.write_text(json.dumps(asdict(session)), encoding="utf-8")


def withdraw(session: RunningSession) -> None:
    """Remove the note."""
    (run_directory(session.base_port) / NOTE).unlink(missing_ok=True)


def running_sessions() -> list[RunningSession]:
    """List the notes whose launcher still lives."""
    found = []
    for note in sorted(runtime_root().glob(f"*/{NOTE}")):
        try:
            session = RunningSession(**json.loads(note.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            continue  # removed or half written between listing and reading: that run is not there to talk to
        if _lives(session.pid):
            found.append(session)
    return found


def choose_session(base_port: int | None) -> RunningSession:
    """Choose the run that a command speaks to: the one at `base_port`, or the only one.

    Raises:
        UsageError: none, or several to choose from.

    """
    sessions = running_sessions()
    if base_port is not None:
        sessions = [session for session in sessions if session.base_port == base_port]
    if not sessions:
        where = "" if base_port is None else f" at base port {base_port}"
        raise UsageError(f"no run is going on{where}; start one by `cosim up SCENARIO`")
    if len(sessions) > 1:
        listed = ", ".join(f"{s.base_port} ({s.scenario}, process {s.pid})" for s in sessions)
        raise UsageError(f"several runs are going on; give --base-port, one of {listed}")
    return sessions[0]


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
