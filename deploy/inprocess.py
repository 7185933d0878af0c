"""A whole lockstep run in one process: the same objects, frames and messages as the separate services, no sockets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from controller_service.controller import Controller
from hal.bus.ports import DirectPort
from hal.master import BOOT_SEQUENCE, Master
from plant_service.plant import Plant
from schemas.base import Model
from schemas.load import Run
from schemas.messages import HalStatus, RobotState
from schemas.service import session_identity
from schemas.topics import BUS_PREFIX, LOAD_PREFIX

BOOT_S: Final = 5.0
_NO_WAIT: Final = 0.0

Sink = Callable[[str, Model], None]
"""Takes each message with its topic, e.g. `LogWriter.write`."""


class InProcess:
    """One run, cycle by cycle: `boot`, `step` as often as wanted, `finish`.

    Every message goes to `sink` under its topic, in the order of the cycle: state, truth, command, trace, bus frames.
    """

    def __init__(self, run: Run, sink: Sink) -> None:
        self._run = run
        self._sink = sink
        self.plant = Plant(run)
        session = session_identity(run)
        ports = [
            DirectPort(bus.name, partial(self.plant.deliver, index))
            for index, bus in enumerate(run.robot.description.buses)
        ]
        self.master = Master(run.robot.description, ports, session)
        self.controller = Controller(run, session)
        self.sequence = 0

    def boot(self) -> None:
        """Configure and enable all drives.

        Raises:
            BootError: see `hal.boot`.

        """
        self.master.boot(BOOT_S)
        self._log_frames(BOOT_SEQUENCE)

    def step(self) -> None:
        """Run one cycle; the plant integrates its interval before the controller answers, as the clock allows."""
        state = self._exchange()
        self._sink("state", state)
        self._advance()
        command, trace = self.controller.step(state)
        self._sink("command", command)
        self._sink("trace", trace)
        for event in self.controller.drain_events():
            self._sink("event", event)
        self.master.apply(command)
        self._close_cycle()

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Boot, run all cycles (or up to a safe stop), finish; `progress` is told the sequence after each cycle."""
        self.boot()
        while self.sequence < self._run.cycles and self.master.core.status is not HalStatus.SAFE_STOP:
            self.step()
            if progress is not None:
                progress(self.sequence)
        self.finish()

    def finish(self) -> None:
        """Leave the robot holding."""
        cycles = self.master.core.cycles_to_hold
        self.master.core.leave()
        for _ in range(cycles):
            self._exchange()
            self._advance()
            self.master.apply(None)
            self._close_cycle()
        self._log_loads(final=True)

    def _exchange(self) -> RobotState:
        self.master.sync(self.sequence)
        return self.master.gather(self.sequence, _NO_WAIT)

    def _advance(self) -> None:
        self._sink("truth", self.plant.truth())
        self.plant.advance()
        self._log_loads()

    def _close_cycle(self) -> None:
        self._log_frames(self.sequence)
        for event in self.master.core.drain_events():
            self._sink("event", event)
        self.sequence += 1

    def _log_loads(self, *, final: bool = False) -> None:
        for statistics in self.plant.statistics(final=final):
            self._sink(LOAD_PREFIX + statistics.bus, statistics)

    def _log_frames(self, sequence: int) -> None:
        for frames in self.master.frames(sequence):
            self._sink(BUS_PREFIX + frames.bus, frames)
