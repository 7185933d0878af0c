"""Runs inside the CAN machine, on kernel interfaces: `python -m tests.deploy.can_runs FOLDER RUN…`.

Each run leaves its log in FOLDER/NAME; what commands said and how they ended is in FOLDER/NAME.json. The host judges.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

VCAN = "vcan0,vcan1,vcan2"
HAL_CARDS, PLANT_CARDS = "can0,can2,can4", "can1,can3,can5"
SCENARIO = "arm9-transition"
BUSES = {"arm9-0": "vcan0", "arm9-1": "vcan1", "arm9-2": "vcan2"}
PATIENCE_S = 900.0
PORT_TESTS = (
    "tests/hal/bus/test_socketcan_kernel.py",
    "tests/hal/bus/test_bus_contract.py",
    "tests/plant_service/test_service_buses.py",
)
OUTAGE_TESTS = ("tests/deploy/test_kernel_outage.py",)


@dataclass(frozen=True)
class Said:
    """A command that ended."""

    line: list[str]
    code: int
    out: str
    seconds: float


def call(*line: str, timeout_s: float = PATIENCE_S) -> Said:
    begun = time.monotonic()
    done = subprocess.run(
        line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout_s, check=False
    )
    return Said(list(line), done.returncode, done.stdout, time.monotonic() - begun)


def up(folder: Path, *more: str, duration: str = "0.5") -> Said:
    line = ("cosim", "up", SCENARIO, "--no-plots", "--duration", duration, "--out", str(folder))
    return call(*line, *more)


def direct(folder: Path) -> list[Said]:
    """The same run in one process: the project's tests hold it equal to the virtual bus, which takes twice the time."""
    code = (
        "from pathlib import Path; from deploy.runner import run_to_log; from schemas.load import load_run;"
        f" run_to_log(load_run({SCENARIO!r}, {{'duration_s': 0.5}}), Path({str(folder / 'direct')!r}))"
    )
    return [call("python", "-c", code)]


def virtual(folder: Path) -> list[Said]:
    """The reference: the project's own virtual bus."""
    return [up(folder / "virtual")]


def vcan(folder: Path) -> list[Said]:
    """vcan, with `candump` beside it; in memory and with a large buffer, or it would drop frames itself."""
    dump = Path("/dev/shm/candump.log")
    with dump.open("w") as file:
        listener = subprocess.Popen(["candump", "-r", "8388608", "-L", *BUSES.values()], stdout=file)
        said = up(folder / "vcan", "--bus", VCAN)
        time.sleep(2.0)
        listener.send_signal(signal.SIGINT)
        listener.wait()
    shutil.copy(dump, folder)
    return [said]


def kvaser(folder: Path) -> list[Said]:
    """HAL and plant on the two cards of each emulated pair."""
    return [up(folder / "kvaser", "--bus", HAL_CARDS, "--plant-bus", PLANT_CARDS)]


def alone(folder: Path) -> list[Said]:
    """A HAL on interfaces where no drive answers."""
    return [call("cosim", "hal", "--scenario", SCENARIO, "--bus", VCAN, "--peers", "hal")]


def visitor(folder: Path) -> list[Said]:
    """Drives of another maker on vcan, from a process that shares no code with ours; no plant."""
    robots = Path("tests/data/robots")
    slaves = [sys.executable, "-m", "tests.hal.foreign_slave", "--channel", "vcan0", "--lely"]
    with subprocess.Popen([*slaves, "--robot", str(robots / "visitor.yaml")], stdout=subprocess.PIPE, text=True) as far:
        assert far.stdout is not None
        far.stdout.readline()
        line = ("cosim", "up", str(robots / "visitor-greet.yaml"), "--no-plant", "--no-plots")
        said = call(*line, "--out", str(folder / "visitor"))
        far.terminate()
    return [said]


def port_tests(folder: Path) -> list[Said]:
    """Tests of ports and of the plant on interfaces, that need a kernel with CAN."""
    return [call("python", "-m", "pytest", "-rs", *PORT_TESTS)]


def outage_tests(folder: Path) -> list[Said]:
    """Whole runs whose interfaces go down or report trouble."""
    return [call("python", "-m", "pytest", "-rs", *OUTAGE_TESTS)]


RUNS: dict[str, Callable[[Path], list[Said]]] = {
    run.__name__: run for run in (direct, virtual, vcan, kvaser, alone, visitor, port_tests, outage_tests)
}


def main(arguments: Sequence[str]) -> int:
    folder = Path(arguments[0])
    for name in arguments[1:]:
        try:
            result = [asdict(said) for said in RUNS[name](folder)]
        except subprocess.SubprocessError as error:
            result = [asdict(Said([name], -1, str(error), 0.0))]
        (folder / f"{name}.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
        print(name, [(said["code"], round(said["seconds"], 1)) for said in result], flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
