"""Start the services as processes, watch them, stop them: HAL first, so that the robot is held before others go."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import LaunchError
from schemas.service import Service

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Small matrices: threads only cost time and repeatability."""
STOP_SECONDS = 1.6
"""Within this all services have stopped or are killed."""
HAL_SECONDS = 0.6
"""Head start of the HAL for holding the robot."""
RECORDER_SECONDS = 0.4
"""Kept at the end for the recorder to write its index."""
POLL_SECONDS = 0.01


@dataclass(frozen=True, slots=True)
class Child:
    """One service's process; `output` holds what it prints."""

    service: Service
    process: subprocess.Popen[bytes]
    output: Path

    def last_words(self, lines: int = 3) -> str:
        """Join the last lines it printed; empty when it printed nothing."""
        try:
            text = self.output.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        said = [line.strip() for line in text.splitlines() if line.strip()]
        return " | ".join(said[-lines:])

    def ending(self) -> str:
        """How it ended, in words."""
        code = self.process.poll()
        if code is None:
            return "is running"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def epitaph(self) -> str:
        """Name, ending and last words in one line."""
        words = self.last_words()
        return f"{self.service} {self.ending()}" + (f"; it printed: {words}" if words else "; it printed nothing")


class Supervisor:
    """The processes of one run. `close` stops whatever still runs; use it as a context manager."""

    def __init__(self) -> None:
        self.children: dict[Service, Child] = {}

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, service: Service, arguments: Sequence[str], output: Path, environment: Mapping[str, str]) -> None:
        """Start `python <arguments>` in its own process group, so that a Ctrl-C at the terminal reaches only us.

        Raises:
            LaunchError: the process cannot be made.

        """
        try:
            with output.open("wb") as sink:
                process = subprocess.Popen(
                    [sys.executable, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=sink,
                    stderr=subprocess.STDOUT,
                    env=dict(environment),
                    process_group=0,
                )
        except OSError as error:
            raise LaunchError(f"cannot start {service}: {error}") from error
        self.children[service] = Child(service, process, output)

    def running(self) -> tuple[Service, ...]:
        """Services whose process lives."""
        return tuple(service for service, child in self.children.items() if child.process.poll() is None)

    def ended(self) -> tuple[Child, ...]:
        """Children that have ended; those killed by a signal first, then those that failed: likelier the cause."""
        over = [child for child in self.children.values() if child.process.poll() is not None]
        return tuple(sorted(over, key=lambda child: _guilt(child.process.returncode)))

    def wait(self, services: Sequence[Service], timeout_s: float) -> bool:
        """Wait for services to end; True when all have."""
        deadline = time.monotonic() + timeout_s
        while any(service in self.running() for service in services):
            if time.monotonic() >= deadline:
                return False
            time.sleep(POLL_SECONDS)
        return True

    def stop(self, budget_s: float = STOP_SECONDS) -> tuple[Service, ...]:
        """SIGTERM to the HAL, then to plant and controller, then to the recorder; SIGKILL to what remains.

        Returns the services that had to be killed.
        """
        deadline = time.monotonic() + budget_s
        self._terminate(Service.HAL)
        self.wait([Service.HAL], HAL_SECONDS)
        self._terminate(Service.CONTROLLER)
        self._terminate(Service.PLANT)
        others = [Service.HAL, Service.CONTROLLER, Service.PLANT]
        self.wait(others, max(deadline - RECORDER_SECONDS - time.monotonic(), 0.0))
        killed = [service for service in others if service in self.running()]
        for service in killed:
            self._kill(service)
        self._terminate(Service.RECORDER)
        if not self.wait([Service.RECORDER], max(deadline - time.monotonic(), RECORDER_SECONDS)):
            self._kill(Service.RECORDER)
            killed.append(Service.RECORDER)
        return tuple(killed)

    def _terminate(self, service: Service) -> None:
        child = self.children.get(service)
        if child is not None and child.process.poll() is None:
            child.process.terminate()

    def _kill(self, service: Service) -> None:
        child = self.children[service]
        if child.process.poll() is None:
            os.killpg(child.process.pid, signal.SIGKILL)
        child.process.wait()


def service_environment(run_directory: Path) -> dict[str, str]:
    """Environment of a service: ours, one numeric thread, unbuffered output, the run directory."""
    environment = dict(os.environ)
    environment.update(dict.fromkeys(ONE_THREAD, "1"))
    environment["PYTHONUNBUFFERED"] = "1"
    environment["COSIM_RUN_DIR"] = str(run_directory)
    environment.setdefault("MUJOCO_GL", "disable")  # no service draws, and looking for a display takes time
    return environment


def _guilt(code: int) -> int:
    return 0 if code < 0 else 1 if code > 0 else 2
