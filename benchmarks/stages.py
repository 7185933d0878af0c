"""The stages of a cycle: in one process by stopwatches, between processes by round trips, whole by `cosim up`."""

from __future__ import annotations

import math
import multiprocessing
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.measure import Figures, Stopwatch, Timing, measure
from deploy.inprocess import InProcess
from deploy.launcher import LOG_NAME
from deploy.session import free_base_port
from hal.bus.hub import BusHub
from hal.bus.ports import CosimPort
from schemas.base import Clock
from schemas.keys import Keys
from schemas.load import Run
from schemas.log import LogReader
from schemas.messages import CycleStatistics
from schemas.service import Service
from schemas.statistics import percentile
from schemas.transport import TransportConfig, open_session

WARM_UP = 50
WAIT_S = 10.0
FRAMES = bytes(16 * 9)
"""As many frames as arm9 has drives."""
SERVICES = {
    "plant, SYNC served to truth sent": Service.PLANT,
    "controller, state decoded to trace sent": Service.CONTROLLER,
}
EVERYTHING = (
    "arm9-dual-compliance",
    {
        "plant.world": {},
        "controller.friction_compensation": {},
        "controller.observer": {},
        "controller.hand_force.wrench_task": {},
        "controller.collision": {
            "obstacles": [
                {"name": "post", "start_in_world": [0.3, 0, -0.4], "end_in_world": [0.3, 0, 0.4], "radius": 0.05}
            ]
        },
    },
)
"""Scenario and overrides of a run with all parts of the controller on."""
POSITION_INTERFACE = ("leg6-stairs", {"controller.phases.0.duration_s": 0.1})
"""Scenario and overrides of a run under torque control through the position interface."""
MESSAGE = b"x" * 2048
"""About the size of arm9's state as JSON."""


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """A whole run: the cycle, its stages, simulated over wall-clock time."""

    stages: tuple[Figures, ...]
    whole: Figures
    real_time_factor: float

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def one_process(run: Run, cycles: int) -> LoopFigures:
    """Measure the run in this process."""
    loop = InProcess(run, lambda _topic, _message: None)
    loop.boot()
    watches = [
        Stopwatch("plant step (MuJoCo, firmware)", loop.plant, "advance"),
        Stopwatch("SYNC and simulated devices", loop.master, "sync"),
        Stopwatch("gather and decode", loop.master, "gather"),
        Stopwatch("controller tick", loop.controller, "step"),
        Stopwatch("QP within the tick", loop.controller._qp, "solve"),
        Stopwatch("limits and RPDOs", loop.master, "apply"),
    ]
    if loop.controller._interface is not None:
        watches.append(Stopwatch("estimation within the tick", loop.controller._interface, "sense"))
    for _ in range(WARM_UP):
        loop.step()
    for watch in watches:
        watch.clear()
    whole = measure("one process", loop.step, cycles, warm_up=0)
    factor = cycles * run.robot.description.period_s / float(whole.samples.sum())
    return LoopFigures(tuple(watch.timing().figures() for watch in watches), whole.figures(), factor)


def bus_round_trip(n: int) -> Timing:
    """Send frames of nine drives to another process and back over the virtual bus."""
    with tempfile.TemporaryDirectory(prefix="cosim-") as directory:
        path = str(Path(directory) / "bench")
        echo = multiprocessing.get_context("spawn").Process(target=_echo_bus, args=(path,), daemon=True)
        echo.start()
        port = CosimPort("bench", path, WAIT_S)

        def call() -> None:
            port.send(FRAMES)
            got = 0
            while got < len(FRAMES):
                got += len(port.receive(WAIT_S))

        try:
            return measure("bus round trip, 9 frames each way", call, n, WARM_UP)
        finally:
            port.close()
            echo.terminate()
            echo.join()


def zenoh_round_trip(n: int) -> Timing:
    """Send a message of 2 kB to another process and back over Zenoh."""
    port = free_base_port()
    echo = multiprocessing.get_context("spawn").Process(target=_echo_zenoh, args=(port, n + WARM_UP), daemon=True)
    echo.start()
    with open_session("plant", _KEYS, TransportConfig(base_port=port), Clock.LOCKSTEP) as transport:
        answers = transport.subscribe(_KEYS.command)
        transport.join(["hal"], WAIT_S)

        def call() -> None:
            transport.publish_bytes(_KEYS.state, MESSAGE, 0, 0)
            while answers.receive(WAIT_S) is None:
                pass

        timing = measure("Zenoh round trip, 2 kB", call, n, WARM_UP)
    echo.join(WAIT_S)
    return timing


def separate_processes(scenario: str, duration_s: float) -> LoopFigures:
    """Measure a `cosim up` by what its services say once a second, which costs the cycle nothing.

    Each service sums up its own cycle in a histogram 2.3 % fine; the HAL's is the whole, from SYNC to SYNC.
    """
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as directory:
        line = [sys.executable, "-m", "deploy.cli", "up", scenario, "--duration", str(duration_s)]
        subprocess.run([*line, "--out", directory, "--no-plots", "--json"], capture_output=True, check=True)
        reader = LogReader(Path(directory) / LOG_NAME)
        statistics = list(reader.messages(CycleStatistics))
    period_s = reader.run.robot.description.period_s
    of_hal = [each for each in statistics if each.service == Service.HAL]
    wall_s = sum(each.cycles * period_s / each.real_time_factor for each in of_hal)
    return LoopFigures(
        tuple(_figures(name, statistics, service) for name, service in SERVICES.items()),
        _figures("separate processes", statistics, Service.HAL),
        sum(each.cycles for each in of_hal) * period_s / wall_s,
    )


def _figures(name: str, statistics: list[CycleStatistics], service: Service) -> Figures:
    chosen = [each for each in statistics if each.service == service]
    median, p99, p99_9 = (percentile(chosen, q) or math.nan for q in (50.0, 99.0, 99.9))
    return Figures(name, sum(each.cycles for each in chosen), median, p99, p99_9)


_KEYS = Keys("bench", "bench")


def _echo_bus(path: str) -> None:
    """Send back what comes until nothing does or the process is ended."""
    with BusHub(path) as hub:
        while frames := hub.receive(WAIT_S):
            hub.send(frames)


def _echo_zenoh(base_port: int, n: int) -> None:
    with open_session("hal", _KEYS, TransportConfig(base_port=base_port), Clock.LOCKSTEP) as transport:
        questions = transport.subscribe(_KEYS.state)
        transport.join(["plant"], WAIT_S)
        for _ in range(n):
            data = questions.receive(WAIT_S)
            if data is None:
                return
            transport.publish_bytes(_KEYS.command, data, 0, 0)
