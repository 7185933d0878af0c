"""`python -m benchmarks`: measure the machine, every stage of the cycle and the whole; print tables, write JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.anti_windup import anti_windup
from benchmarks.kernel_can import kernel_ports
from benchmarks.measure import Figures
from benchmarks.motor_fit import motor_fit
from benchmarks.stages import (
    EVERYTHING,
    POSITION_INTERFACE,
    bus_round_trip,
    one_process,
    separate_processes,
    zenoh_round_trip,
)
from benchmarks.yardstick import yardsticks
from schemas.load import load_run


def main() -> int:
    """Run all benchmarks."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("--scenario", default="arm9-transition")
    parser.add_argument("--cycles", type=int, default=4000, help="cycles in one process, and round trips")
    parser.add_argument("--duration", type=float, default=10.0, help="simulated seconds as separate processes")
    parser.add_argument("--out", type=Path, default=Path("runs/bench.json"))
    chosen = parser.parse_args()
    console = Console(stderr=True)

    with console.status("machine"):
        machine = [timing.figures() for timing in yardsticks(chosen.cycles)]
    with console.status("one process"):
        one = one_process(load_run(chosen.scenario), chosen.cycles)
    with console.status("one process, all parts of the controller"):
        everything = one_process(load_run(*EVERYTHING), chosen.cycles)
    with console.status("one process, torque control through the position interface"):
        interface = one_process(load_run(*POSITION_INTERFACE), chosen.cycles)
    stages = list(one.stages)
    with console.status("bus"):
        stages.append(bus_round_trip(chosen.cycles).figures())
    stages += [timing.figures() for timing in kernel_ports("vcan0", chosen.cycles)]
    stages += [timing.figures() for timing in anti_windup(chosen.cycles)]
    stages.append(motor_fit().figures())
    with console.status("Zenoh"):
        stages.append(zenoh_round_trip(chosen.cycles).figures())
    with console.status("separate processes"):
        separate = separate_processes(chosen.scenario, chosen.duration)

    out = Console(width=None if sys.stdout.isatty() else 100)
    out.print(_table("this machine, now", machine))
    out.print(_table(f"{chosen.scenario}: stages of the cycle, wall clock", stages))
    out.print(_table(f"{EVERYTHING[0]} with all parts of the controller: stages of the cycle", everything.stages))
    out.print(_table(f"{POSITION_INTERFACE[0]}, the position interface: stages of the cycle", interface.stages))
    out.print(_table("separate processes, of each service's own cycle", separate.stages))
    out.print(_table("whole cycle, SYNC to SYNC", [one.whole, separate.whole]))
    print(f"real-time factor: one process {one.real_time_factor:.2f}, separate {separate.real_time_factor:.2f}")

    result = {
        "scenario": chosen.scenario,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "yardsticks": [each.as_json() for each in machine],
        "stages": [each.as_json() for each in stages],
        "one_process": one.as_json(),
        "everything": everything.as_json(),
        "position_interface": interface.as_json(),
        "separate_processes": separate.as_json(),
    }
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    chosen.out.write_text(json.dumps(result, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    print(chosen.out)
    return 0


def _table(title: str, rows: Sequence[Figures]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("what", min_width=34)
    for header in ("median µs", "p99 µs", "p99.9 µs"):
        table.add_column(header, justify="right")
    for row in rows:
        table.add_row(row.name, *(f"{time_s * 1e6:.0f}" for time_s in (row.median_s, row.p99_s, row.p99_9_s)))
    return table


if __name__ == "__main__":
    sys.exit(main())
