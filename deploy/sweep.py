"""An experiment over many seeds at once, by processes that share the seeds.

A run depends on its request alone, so the results are those of one process that takes the seeds one after the other.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Final

from deploy.errors import DeployError, UsageError
from deploy.experiment import Experiment, ExperimentRequest, Outcome, attempt
from deploy.launcher import LOG_NAME
from deploy.supervisor import ONE_THREAD

POLL_S: Final = 0.1
"""How often progress is read."""


class SweepError(DeployError):
    """A sweep ended before all its seeds had run; the message names the seed that ended it."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the run of a seed is."""

    seed: int
    share: float
    what: str


def usable_cpus() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


def sweep(
    run: Experiment,
    requests: Sequence[ExperimentRequest],
    jobs: int,
    *,
    keep_logs: bool = False,
    progress: Callable[[Progress], None] = lambda _: None,
    done: Callable[[Outcome], None] = lambda _: None,
) -> tuple[Outcome, ...]:
    """Run all requests in up to `jobs` processes; outcomes come in the order of the requests.

    `run` is a function of a module; every worker imports it anew. A run that raises `CosimError` is a `FailedRun`.
    Logs of runs that pass are deleted unless `keep_logs`. `done` hears of each outcome when it is there, `progress`
    of the runs on their way. When this function is left early, for whatever reason, or its process dies, the workers
    die at once.

    Raises:
        UsageError: a run refuses its configuration, which other seeds would too.
        SweepError: a run raised what it never should, or a worker died.

    """
    outcomes: dict[int, Outcome] = {}
    running: set[int] = set()
    context = multiprocessing.get_context("spawn")
    news: SimpleQueue[Progress] = context.SimpleQueue()

    def listen() -> None:
        while not news.empty():
            heard = news.get()
            running.add(heard.seed)
            progress(heard)

    alive, hold = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(min(jobs, len(requests)), context, _begin, (news, alive))
    try:
        with _environment_of_workers():
            pending = {pool.submit(_work, run, request): request for request in requests}
        while pending:
            finished, _ = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
            listen()
            for future in sorted(finished, key=lambda each: pending[each].seed):
                request = pending.pop(future)
                outcome = _outcome(future, request.seed, running)
                running.discard(request.seed)
                if outcome.passed and not keep_logs and request.directory is not None:
                    delete_logs(request.directory)
                outcomes[request.seed] = outcome
                done(outcome)
        pool.shutdown()
    finally:
        hold.close()
        pool.shutdown(cancel_futures=True)
        alive.close()
        news.close()
    return tuple(outcomes[request.seed] for request in requests)


def delete_logs(directory: Path) -> None:
    """Delete the logs of runs at and below a directory."""
    for path in directory.rglob(LOG_NAME):
        path.unlink()


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Give workers that are started here one BLAS thread each, and no ears for Ctrl-C.

    A terminal sends SIGINT to all processes; it is for the one that ends the others. Blocked and not ignored, so that
    a Ctrl-C in these milliseconds is not lost on this one.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _outcome(future: Future[Outcome], seed: int, running: set[int]) -> Outcome:
    try:
        return future.result()
    except BrokenProcessPool as error:
        seeds = ", ".join(map(str, sorted(running))) or "none yet"
        raise SweepError(
            f"a worker died, perhaps for want of memory, while these seeds ran: {seeds}; `--jobs 1` shows which"
        ) from error
    except UsageError:
        raise
    except Exception as error:
        raise SweepError(
            f"seed {seed}: internal error: {type(error).__name__}: {error} (`cosim --debug …` shows where)"
        ) from error


_news: SimpleQueue[Progress] | None = None
"""In a worker: where it tells its progress."""


def _begin(news: SimpleQueue[Progress], alive: Connection) -> None:
    """Make a worker of a new process."""
    global _news
    _news = news
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()


def _end_with(alive: Connection) -> None:
    """End this process when the other end of the pipe is gone, in the midst of a run: nobody waits for it."""
    alive.poll(None)
    os._exit(1)


def _work(run: Experiment, request: ExperimentRequest) -> Outcome:
    tell = partial(_tell, request.seed)
    tell(0.0, "starting")
    return attempt(run, replace(request, progress=tell))


def _tell(seed: int, share: float, what: str) -> None:
    if _news is not None:
        _news.put(Progress(seed, share, what))
