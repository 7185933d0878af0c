"""What an experiment is: a module of `experiments` with a function `run`, and the result each of them gives."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deploy.errors import UsageError

Metric = float | int | str | bool | None | list[float] | dict[str, float]


@dataclass(frozen=True, slots=True)
class Bar:
    """A metric with the limit it must keep: `value` ≤ `limit`, or ≥ where `at_least`."""

    name: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """False for a value that is not a number, too."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    def as_json(self) -> dict[str, Any]:
        """Plain values; a value that is not finite is null."""
        value = self.value if math.isfinite(self.value) else None
        return {
            "name": self.name,
            "value": value,
            "limit": self.limit,
            "at_least": self.at_least,
            "holds": self.holds,
        }


def no_progress(_share: float, _what: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True, slots=True)
class ExperimentRequest:
    """What the command line asks of an experiment."""

    seed: int
    overrides: dict[str, Any] = field(default_factory=dict)
    """Dotted paths as `schemas.load.load_run` takes them."""
    directory: Path | None = None
    """Where logs and plots go; None writes none."""
    processes: bool = False
    """Services as separate processes instead of one."""
    progress: Callable[[float, str], None] = no_progress
    """Told what share of the experiment is done and what comes next."""


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """What came of one run of an experiment; SI units in the metrics' names."""

    experiment: str
    robot: str
    seed: int
    versions: dict[str, str]
    metrics: dict[str, Metric]
    bars: tuple[Bar, ...]

    @property
    def passed(self) -> bool:
        """All bars hold."""
        return all(bar.holds for bar in self.bars)

    def as_json(self) -> dict[str, Any]:
        """Make the printed JSON object."""
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            "seed": self.seed,
            "versions": self.versions,
            "metrics": self.metrics,
            "bars": [bar.as_json() for bar in self.bars],
            "passed": self.passed,
        }


Experiment = Callable[[ExperimentRequest], ExperimentResult]


def experiment_names() -> list[str]:
    """List the experiments that come with the package: modules of `experiments` with a function `run`."""
    import experiments

    return sorted(
        module.name
        for module in pkgutil.iter_modules(experiments.__path__)
        if hasattr(importlib.import_module(f"experiments.{module.name}"), "run")
    )


def find_experiment(name: str) -> Experiment:
    """Import an experiment.

    Raises:
        UsageError: there is none of this name.

    """
    names = experiment_names()
    if name not in names:
        raise UsageError(f"no experiment {name!r}; there are {', '.join(names) or 'none'}")
    run: Experiment = importlib.import_module(f"experiments.{name}").run
    return run


def combine(results: list[ExperimentResult]) -> dict[str, Any]:
    """One entry a seed, and the counts."""
    passed = sum(result.passed for result in results)
    return {
        "experiment": results[0].experiment,
        "robot": results[0].robot,
        "seeds": len(results),
        "seeds_passed": passed,
        "passed": passed == len(results),
        "runs": [result.as_json() for result in results],
    }
