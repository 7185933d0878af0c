"""Progress of a run on the terminal: simulated time, real-time factor, cycle time, phase and mode."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from schemas.load import Run
from schemas.messages import CycleStatistics, Event
from schemas.scenario import Scenario

Observation = CycleStatistics | Event

_COLOURS = {"info": "cyan", "warning": "yellow", "error": "red"}


class Monitor(Protocol):
    """Where the launcher hears of the run: statistics and events since the last call."""

    def poll(self) -> list[Observation]:
        """All that has arrived, oldest first; never waits."""

    def warn(self, sequence: int, kind: str, text: str) -> None:
        """Publish an event of severity `warning` in the launcher's name."""

    def close(self) -> None:
        """Leave the run."""


def phase_at(scenario: Scenario, time_s: float) -> str:
    """`<phase> (<mode>)` that the schedule has at a simulated time; the last phase lasts to the end of the run."""
    end = 0.0
    for phase in scenario.controller.phases:
        end += phase.duration_s
        if time_s < end:
            break
    return f"{phase.name} ({phase.mode})"


class RunProgress:
    """Shows a run on a terminal as a bar, elsewhere as nothing but events worth a line; use it as a context manager."""

    def __init__(self, run: Run, console: Console) -> None:
        self._run = run
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=30),
            TextColumn("{task.completed:6.2f} / {task.total:g} s simulated"),
            TextColumn("{task.fields[pace]}"),
            TextColumn("[cyan]{task.fields[phase]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task: TaskID = self._bar.add_task(
            run.scenario.name, total=run.scenario.duration_s, pace="starting", phase=""
        )
        self.sequence = 0
        """Newest sequence number heard of."""

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, observations: list[Observation]) -> None:
        """Take in what the monitor heard."""
        for heard in observations:
            self.sequence = max(self.sequence, heard.sequence)
            time_s = heard.time_ns * 1e-9
            if isinstance(heard, Event):
                if heard.severity != "info":
                    self.say(f"{time_s:.3f} s  {heard.service}: {heard.kind}: {heard.text}", heard.severity)
            elif heard.service == "hal":
                pace = f"{heard.real_time_factor:.2f} × real time, cycle {heard.cycle_time_median_s * 1e3:.2f} ms"
                self._bar.update(self._task, completed=time_s, pace=pace, phase=phase_at(self._run.scenario, time_s))

    def say(self, text: str, severity: str = "info") -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, style=_COLOURS[severity], markup=False, highlight=False, soft_wrap=True)
