"""`python -m benchmarks`: measure every stage of the cycle and the whole, print a table, write JSON."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.stages import bus_round_trip, one_process, separate_processes, zenoh_round_trip
from schemas.load import load_run


def main() -> int:
    """Run all benchmarks."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("--scenario", default="arm9-transition")
    parser.add_argument("--cycles", type=int, default=2000, help="cycles in one process, and round trips")
    parser.add_argument("--duration", type=float, default=5.0, help="simulated seconds as separate processes")
    parser.add_argument("--out", type=Path, default=Path("runs/bench.json"))
    chosen = parser.parse_args()
    console = Console(stderr=True)

    with console.status("one process"):
        timings, factor = one_process(load_run(chosen.scenario), chosen.cycles)
    with console.status("bus"):
        timings.append(bus_round_trip(chosen.cycles))
    with console.status("Zenoh"):
        timings.append(zenoh_round_trip(chosen.cycles))
    with console.status("separate processes"):
        processes = separate_processes(chosen.scenario, chosen.duration)

    table = Table(title=f"{chosen.scenario}, wall clock", title_justify="left")
    table.add_column("stage")
    for header in ("median µs", "p99 µs", "p99.9 µs"):
        table.add_column(header, justify="right")
    for timing in timings:
        table.add_row(timing.name, *(f"{timing.percentile(q) * 1e6:.0f}" for q in (50.0, 99.0, 99.9)))
    Console(width=None if sys.stdout.isatty() else 100).print(table)
    median_us = processes["cycle_time_median_s"] * 1e6
    print(f"real-time factor: one process {factor:.2f}, separate processes {processes['real_time_factor']:.2f}")
    print(f"whole cycle, separate processes: median {median_us:.0f} µs")

    result = {
        "scenario": chosen.scenario,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "stages": [timing.as_json() for timing in timings],
        "one_process": {"real_time_factor": factor},
        "separate_processes": {
            key: processes[key] for key in ("cycle_time_median_s", "cycle_time_max_s", "real_time_factor")
        },
    }
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    chosen.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(chosen.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
