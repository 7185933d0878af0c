"""A `cosim up` in the background, watched from outside as any other program would."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from deploy.session import RunningSession
from schemas.base import Clock
from schemas.keys import Keys
from schemas.messages import RobotState
from schemas.topics import decode
from schemas.transport import TransportConfig, open_session

PATIENCE_S = 60.0


@dataclass(frozen=True)
class Ending:
    """How `cosim up` ended."""

    code: int
    output: str
    seconds: float
    """From the last signal sent."""


class Running:
    """One run and its processes."""

    def __init__(self, process: subprocess.Popen[str], directory: Path, runtime: Path) -> None:
        self.process = process
        self.directory = directory
        self.log = directory / "run.mcap"
        self._runtime = runtime
        self._signalled_s = time.monotonic()

    def session(self) -> RunningSession:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            for note in self._runtime.glob("*/session.json"):
                try:
                    return RunningSession(**json.loads(note.read_text()))
                except ValueError:
                    continue  # half written
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.02)
        raise AssertionError("no session note")

    def wait_for_sequence(self, sequence: int) -> RobotState:
        """The first state at or after a sequence number."""
        session = self.session()
        keys = Keys(session.namespace, session.robot)
        config = TransportConfig(base_port=session.base_port)
        with open_session("test", keys, config, Clock.REALTIME) as transport:
            states = transport.subscribe(keys.state, newest=True)
            deadline = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline:
                data = states.receive(0.2)
                if data is not None:
                    state = decode(RobotState, data)
                    if state.sequence >= sequence:
                        return state
                assert self.process.poll() is None, self.process.communicate()
        raise AssertionError(f"sequence {sequence} not reached")

    def pid_of(self, service: str) -> int:
        for line in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split():
            command = Path(f"/proc/{line}/cmdline").read_bytes().split(b"\0")
            if b"deploy.services" in command and command[command.index(b"deploy.services") + 1] == service.encode():
                return int(line)
        raise AssertionError(f"no process of {service}")

    def kill(self, service: str) -> None:
        os.kill(self.pid_of(service), signal.SIGKILL)
        self._signalled_s = time.monotonic()

    def signal(self, service: str, number: signal.Signals) -> None:
        os.kill(self.pid_of(service), number)
        self._signalled_s = time.monotonic()

    def cli(self, *arguments: str) -> str:
        """Run another `cosim` command beside it; its output."""
        line = [sys.executable, "-m", "deploy.cli", *arguments]
        environment = {**os.environ, "COSIM_RUN_DIR": str(self._runtime)}
        done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=30, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self._signalled_s = time.monotonic()

    def end(self, timeout_s: float = PATIENCE_S) -> Ending:
        out, err = self.process.communicate(timeout=timeout_s)
        return Ending(self.process.returncode, out + err, time.monotonic() - self._signalled_s)


@contextmanager
def cosim_up(directory: Path, *arguments: str) -> Iterator[Running]:
    """Start `cosim up` with its own runtime directory below `directory`; it is killed when the block is left."""
    runtime = directory / "rt"
    runtime.mkdir(parents=True)
    out = directory / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy.cli", "up", *arguments, "--out", str(out), "--no-plots"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "COSIM_RUN_DIR": str(runtime)},
    )
    try:
        yield Running(process, out, runtime)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
