"""One run to one log, in this process or as separate ones: what experiments and sweeps are made of."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Final

from rich.console import Console

from deploy.errors import RunStoppedError, UsageError
from deploy.inprocess import InProcess
from deploy.launcher import LOG_NAME, launch, plan
from deploy.monitor import RunMonitor
from deploy.progress import RunProgress
from schemas.base import Clock, Model
from schemas.fingerprint import fingerprint
from schemas.load import Run
from schemas.log import LogWriter
from schemas.messages import Event

QUIET: Final = Console(file=StringIO())


def run_to_log(run: Run, directory: Path, *, processes: bool = False) -> Path:
    """Run to the end; returns the path of its log in `directory`, which is made; a log that is there is replaced.

    Raises:
        UsageError: the realtime clock in one process.
        RunStoppedError: the HAL stopped the robot (one process; its log is there).
        CosimError: the run failed.

    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / LOG_NAME
    if processes:
        path.unlink(missing_ok=True)
        with RunProgress(run, QUIET) as progress:
            launch(plan(run, directory), progress, RunMonitor)
        return path
    if run.scenario.clock is not Clock.LOCKSTEP:
        raise UsageError("a run in one process has the lockstep clock; use separate processes for realtime")
    with LogWriter(path, run, fingerprint(run)) as log:
        stops: list[str] = []

        def write(topic: str, message: Model) -> None:
            log.write(topic, message)
            if isinstance(message, Event) and message.kind == "safe_stop":
                stops.append(f"stopped at sequence {message.sequence}: {message.text}")

        InProcess(run, write).run()
    if stops:
        raise RunStoppedError(f"{path}: {stops[0]}")
    return path
