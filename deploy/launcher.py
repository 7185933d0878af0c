"""`cosim up`: start plant, HAL, controller and recorder as processes, supervise them, end with what came of it."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from deploy import session as sessions
from deploy.errors import ChildDiedError, UsageError
from deploy.progress import Monitor, RunProgress
from deploy.run_file import write_run
from deploy.services import arguments, said_by
from deploy.supervisor import Child, Supervisor, service_environment
from schemas.lifecycle import STOPPED
from schemas.load import Run
from schemas.messages import Event
from schemas.service import Service, ServiceOptions, session_identity

LOG_NAME = "run.mcap"
RUN_NAME = "run.json"
REFRESH_SECONDS = 0.05
GRACE_SECONDS = 0.7
"""After a death the others have this long to notice, hold the robot and say so by themselves."""
FINISH_SECONDS = 5.0
"""After the HAL's regular end the others have this long to finish what they are about."""

MonitorMaker = Callable[[Run, ServiceOptions], Monitor]


@dataclass(frozen=True, slots=True)
class Plan:
    """A run ready to be started."""

    run: Run
    services: tuple[Service, ...]
    options: ServiceOptions
    directory: Path
    """Where the log, the run file and what the services print are written."""

    @property
    def log(self) -> Path:
        """The recorder's file."""
        return self.directory / LOG_NAME

    def options_of(self, service: Service) -> ServiceOptions:
        """Only the recorder has an output."""
        return replace(self.options, output=self.log if service is Service.RECORDER else None)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run went that no service spoiled."""

    interrupted: bool
    recorder_lost: bool
    wall_s: float


def output_directory(run: Run, given: Path | None, now: time.struct_time) -> Path:
    """`given`, or `runs/<scenario>-<time>`; made, and refused when it already holds a log.

    Raises:
        UsageError: a log is there, or the directory cannot be made.

    """
    directory = given or Path("runs") / f"{run.scenario.name}-{time.strftime('%Y%m%d-%H%M%S', now)}"
    stem, number = directory, 2
    while given is None and (directory / LOG_NAME).exists():
        directory, number = stem.with_name(f"{stem.name}-{number}"), number + 1
    if (directory / LOG_NAME).exists():
        raise UsageError(f"{directory / LOG_NAME} exists; give another --out or remove it")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {directory}: cannot be made: {error.strerror}") from error
    return directory


def plan(run: Run, directory: Path, *, base_port: int | None = None, with_plant: bool = True) -> Plan:
    """Choose ports, sockets' directory and identity.

    Raises:
        LaunchError: no free ports, or no place for sockets.
        UsageError: another run has this base port.

    """
    if base_port is not None:
        sessions.refuse_taken(base_port)
    services = tuple(service for service in Service if with_plant or service is not Service.PLANT)
    port = base_port if base_port is not None else sessions.free_base_port()
    options = ServiceOptions(
        base_port=port,
        session=session_identity(run),
        peers=tuple(str(service) for service in services),
        run_directory=sessions.run_directory(port),
    )
    return Plan(run, services, options, directory)


def launch(plan: Plan, progress: RunProgress, make_monitor: MonitorMaker) -> Outcome:
    """Run it to its end, to an interrupt (SIGINT, SIGTERM) or to a service's death.

    Raises:
        ChildDiedError: plant, HAL or controller ended before the run did; everything is stopped.
        LaunchError: a process could not be started.

    """
    run_file = plan.directory.absolute() / RUN_NAME
    try:
        write_run(plan.run, run_file)
    except OSError as error:
        sessions.discard(plan.options.run_directory)
        raise UsageError(f"--out {plan.directory}: cannot be written: {error.strerror}") from error
    environment = service_environment(plan.options.run_directory)
    started = time.monotonic()
    try:
        with _interrupts() as interrupted, Supervisor() as supervisor:
            sessions.announce(sessions.describe(plan.run, plan.options, plan.directory))
            for service in plan.services:
                line = arguments(service, run_file, plan.options_of(service))
                supervisor.start(service, line, plan.directory / f"{service}.txt", environment)
            monitor = make_monitor(plan.run, plan.options)
            try:
                recorder_lost = _supervise(supervisor, monitor, progress, interrupted)
            finally:
                monitor.close()
    finally:
        sessions.discard(plan.options.run_directory)
    return Outcome(bool(interrupted), recorder_lost, time.monotonic() - started)


def _supervise(supervisor: Supervisor, monitor: Monitor, progress: RunProgress, interrupted: list[int]) -> bool:
    """Watch until the HAL has ended; True when the recorder went missing on the way."""
    recorder_lost = False
    hal_left = False
    while not interrupted:
        heard = monitor.poll()
        hal_left |= any(
            isinstance(each, Event) and (each.service, each.kind) == (Service.HAL, STOPPED) for each in heard
        )
        progress.show(heard)
        ended = {child.service: child for child in supervisor.ended()}
        if Service.HAL in ended and ended[Service.HAL].process.returncode == 0:
            _finish(supervisor)
            progress.show(monitor.poll())
            return recorder_lost
        lost = ended.pop(Service.RECORDER, None)
        if lost is not None and not recorder_lost and not (hal_left and lost.process.returncode == 0):
            recorder_lost = True
            text = f"{lost.epitaph()}; the run goes on without a log"
            progress.say(text, "warning")
            monitor.warn(progress.sequence, "recorder_lost", text)
        if ended:
            _mourn(supervisor, monitor, progress)
        time.sleep(REFRESH_SECONDS)
    progress.say("stopping", "warning")
    supervisor.stop()
    progress.show(monitor.poll())
    return recorder_lost


def _finish(supervisor: Supervisor) -> None:
    """Wait for the others after the HAL has ended the run, then look whether all went well.

    Raises:
        ChildDiedError: another service failed at the end.

    """
    supervisor.wait([Service.PLANT, Service.CONTROLLER], FINISH_SECONDS)
    supervisor.wait([Service.RECORDER], FINISH_SECONDS)
    late = supervisor.running()
    supervisor.stop()
    failed = [c for c in supervisor.ended() if c.process.returncode != 0 and c.service is not Service.RECORDER]
    if late and not failed:
        raise ChildDiedError(f"{', '.join(late)} did not end with the run and had to be stopped")
    if failed:
        raise ChildDiedError(f"after the run's last cycle {failed[0].epitaph()}")


def _mourn(supervisor: Supervisor, monitor: Monitor, progress: RunProgress) -> None:
    """Let the others notice that a service ended early, stop them, name the one that was first.

    Raises:
        ChildDiedError: unless the HAL turns out to have ended the run at the same moment.

    """
    cause = _first_to_blame(supervisor)
    supervisor.wait([Service.PLANT, Service.HAL, Service.CONTROLLER], GRACE_SECONDS)
    progress.show(monitor.poll())
    if cause.process.returncode == 0:
        # Who ends in peace has heard another's goodbye; that one may take a moment longer to end, and says why.
        cause = _first_to_blame(supervisor)
    code = cause.process.returncode
    hal = supervisor.children[Service.HAL].process
    if code == 0 and hal.poll() == 0:
        return
    supervisor.stop()
    witnesses = [
        said_by(child.service, words)
        for child in _others(supervisor, cause)
        if (words := child.last_words(1)) and child.process.returncode > 0
    ]
    early = " before the run was over" if code == 0 else ""
    rest = "; ".join(witnesses) or "the other services were stopped"
    raise ChildDiedError(f"{cause.epitaph()}{early}\n{rest}")


def _first_to_blame(supervisor: Supervisor) -> Child:
    return next(child for child in supervisor.ended() if child.service is not Service.RECORDER)


def _others(supervisor: Supervisor, cause: Child) -> list[Child]:
    return [child for child in supervisor.children.values() if child.service is not cause.service]


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """SIGINT and SIGTERM append their number to the list, so that the loop ends at a point of its choosing."""
    received: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
