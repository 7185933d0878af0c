"""What a run's numbers depend on besides its configuration: replay is exact where this matches."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy

from schemas.load import Run

PACKAGES: Final = (
    "numpy", "scipy", "mujoco", "pin", "osqp", "daqp", "pydantic", "eclipse-zenoh", "python-can", "canopen", "mcap",
)  # fmt: skip
ARITHMETIC: Final = ("python", "machine", "cpu_features", "blas", "numpy", "scipy", "mujoco", "pin", "osqp", "daqp")
"""Entries on which the bits of a result depend, the project's own code apart: that is what replay tests."""


def fingerprint(run: Run) -> dict[str, str]:
    """Versions, kind of CPU, BLAS, clock and seed of a run, as text."""
    blas = numpy.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {
        "hrp-cosim": _version("hrp-cosim"),
        "git_commit": _git_commit(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cpu_features": _cpu_features(),
        "blas": f"{blas['name']} {blas['version']}",
        **{name: _version(name) for name in PACKAGES},
        "clock": run.scenario.clock.value,
        "seed": str(run.scenario.seed),
        "scenario": run.scenario.name,
        "robot": run.robot.description.name,
    }


def differences(logged: dict[str, str], here: dict[str, str]) -> tuple[str, ...]:
    """Entries of `ARITHMETIC` that differ, as `name: logged → here`; empty where replay can be exact."""
    return tuple(
        f"{name}: {logged.get(name, 'unknown')} → {here.get(name, 'unknown')}"
        for name in ARITHMETIC
        if logged.get(name) != here.get(name)
    )


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def _cpu_features() -> str:
    extensions = numpy.show_config(mode="dicts")["SIMD Extensions"]
    return " ".join(sorted({*extensions["baseline"], *extensions.get("found", [])}))


def _git_commit() -> str:
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "unknown"
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=root, capture_output=True, text=True, timeout=5.0, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip()
