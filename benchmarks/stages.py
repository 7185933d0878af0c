"""The stages of a cycle: in one process by stopwatches, between processes by round trips, whole by `cosim up`."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import Stopwatch, Timing, measure
from deploy.inprocess import InProcess
from deploy.session import free_base_port
from hal.bus.hub import BusHub
from hal.bus.ports import CosimPort
from schemas.base import Clock
from schemas.keys import Keys
from schemas.load import Run
from schemas.transport import TransportConfig, open_session

WARM_UP = 50
WAIT_S = 10.0
FRAMES = bytes(16 * 9)
"""As many frames as arm9 has drives."""
MESSAGE = b"x" * 2048
"""About the size of arm9's state as JSON."""


def one_process(run: Run, cycles: int) -> tuple[list[Timing], float]:
    """Stages of the in-process run, and its real-time factor."""
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
    for _ in range(WARM_UP):
        loop.step()
    for watch in watches:
        watch.clear()
    whole = measure("whole cycle, one process", loop.step, cycles, warm_up=0)
    factor = cycles * run.robot.description.period_s / float(whole.samples.sum())
    return [*(watch.timing() for watch in watches), whole], factor


def bus_round_trip(n: int) -> Timing:
    """Send frames of nine drives to another process and back over the virtual bus."""
    with tempfile.TemporaryDirectory(prefix="cosim-") as directory:
        path = str(Path(directory) / "bench")
        echo = multiprocessing.get_context("spawn").Process(target=_echo_bus, args=(path, n + WARM_UP), daemon=True)
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
            echo.join(WAIT_S)


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


def separate_processes(scenario: str, duration_s: float) -> dict[str, Any]:
    """Metrics of a `cosim up`: cycle time and real-time factor as the HAL measured them."""
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as directory:
        line = [sys.executable, "-m", "deploy.cli", "up", scenario, "--duration", str(duration_s)]
        line += ["--out", directory, "--no-plots", "--json"]
        done = subprocess.run(line, capture_output=True, text=True, check=True)
    metrics: dict[str, Any] = json.loads(done.stdout)["metrics"]
    return metrics


_KEYS = Keys("bench", "bench")


def _echo_bus(path: str, n: int) -> None:
    with BusHub(path) as hub:
        echoed = 0
        while echoed < n * len(FRAMES):
            frames = hub.receive(WAIT_S)
            if not frames:
                return
            hub.send(frames)
            echoed += len(frames)


def _echo_zenoh(base_port: int, n: int) -> None:
    with open_session("hal", _KEYS, TransportConfig(base_port=base_port), Clock.LOCKSTEP) as transport:
        questions = transport.subscribe(_KEYS.state)
        transport.join(["plant"], WAIT_S)
        for _ in range(n):
            data = questions.receive(WAIT_S)
            if data is None:
                return
            transport.publish_bytes(_KEYS.command, data, 0, 0)
