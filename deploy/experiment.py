"""What an experiment is: a module of `experiments` with a function `run`; its result, and those of several seeds."""

from __future__ import annotations

import importlib
import math
import pkgutil
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from deploy.errors import UsageError
from deploy.variation import varied
from schemas.errors import ConfigurationError, CosimError

Metric = float | int | str | bool | None | list[float] | dict[str, float] | dict[str, str]

RESULT_NAMES: Final = (
    "metrics.json",
    "sweep.png",
    "*/to_torque.png",
    "*/to_position.png",
    "table-1.md",
    "tables-2-3.md",
    "estimators.md",
)
"""Results at a run's place beside the figures that are called like their experiment."""


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

    @property
    def margin(self) -> float:
        """How far the value may still go, negative where the limit is passed; −∞ for a value that is not a number."""
        margin = self.value - self.limit if self.at_least else self.limit - self.value
        return -math.inf if math.isnan(margin) else margin

    def as_json(self) -> dict[str, Any]:
        """Plain values; a value that is not finite is null."""
        return {
            "name": self.name,
            "value": _finite(self.value),
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
    overrides: dict[str, Any] = field(default_factory=dict)
    """What was set otherwise than the scenario has it, by the user and by the variation of the plant; dotted paths."""

    @property
    def passed(self) -> bool:
        """All bars hold."""
        return all(bar.holds for bar in self.bars)

    def as_json(self) -> dict[str, Any]:
        """Make the printed JSON object; numbers that are not finite are null."""
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            "seed": self.seed,
            "versions": self.versions,
            "overrides": _plain(self.overrides),
            "metrics": _finite(self.metrics),
            "bars": [bar.as_json() for bar in self.bars],
            "passed": self.passed,
        }


@dataclass(frozen=True, slots=True)
class FailedRun:
    """A seed whose run came to no result."""

    seed: int
    error: str
    overrides: dict[str, Any] = field(default_factory=dict)
    """As in `ExperimentResult`."""

    @property
    def passed(self) -> bool:
        """Never."""
        return False

    def as_json(self) -> dict[str, Any]:
        """Make the entry of the printed JSON object."""
        return {"seed": self.seed, "error": self.error, "overrides": _plain(self.overrides)}


Outcome = ExperimentResult | FailedRun


@dataclass(frozen=True, slots=True)
class BarSummary:
    """A bar over several seeds; `limit` is that of the worst one, the same for all where an experiment has it fixed."""

    name: str
    limit: float
    at_least: bool
    holds_count: int
    """Seeds in which it holds; a seed without result is none of them."""
    worst: float
    """The value with the least margin; one that is not a number is the worst there is."""
    worst_seed: int
    median: float
    """Of the seeds with a result; a value that is not a number counts as infinitely bad."""

    def as_json(self) -> dict[str, Any]:
        """Plain values; a value that is not finite is null."""
        return {
            "name": self.name,
            "limit": self.limit,
            "at_least": self.at_least,
            "holds_count": self.holds_count,
            "worst": _finite(self.worst),
            "worst_seed": self.worst_seed,
            "median": _finite(self.median),
        }


Experiment = Callable[[ExperimentRequest], ExperimentResult]


def experiment_names() -> list[str]:
    """List the experiments that come with the package: modules of `experiments` with a function `run`, `_` as `-`."""
    return [name for name in _module_names() if hasattr(_import(name), "run")]


def find_experiment(name: str) -> Experiment:
    """Import an experiment.

    Raises:
        UsageError: there is none of this name.

    """
    run: Experiment | None = getattr(_import(name), "run", None) if name in _module_names() else None
    if run is None:
        raise UsageError(f"no experiment {name!r}; there are {', '.join(experiment_names()) or 'none'}")
    return run


def attempt(run: Experiment, request: ExperimentRequest) -> Outcome:
    """Run an experiment for one seed; a run that comes to no result is an outcome, too.

    Raises:
        UsageError: the run refuses its configuration, which other seeds would too.

    """
    try:
        return replace(run(request), overrides=request.overrides)
    except ConfigurationError as error:
        raise UsageError(str(error)) from error
    except CosimError as error:
        return FailedRun(request.seed, str(error), request.overrides)


def seed_requests(
    seeds: Sequence[int],
    overrides: dict[str, Any],
    directory: Path,
    *,
    vary: bool,
    processes: bool = False,
    apart: bool = True,
) -> list[ExperimentRequest]:
    """Prepare a run for every seed, and make its directory: `seed-N` below `directory`, itself unless `apart`.

    With `vary` every seed has a plant of its own, but for the fields that `overrides` sets. Results of earlier runs at
    these places (`metrics.json`, figures) are deleted, so that none is taken for one of a run that came to no end.

    Raises:
        UsageError: a directory cannot be made, or an old result in it not be deleted.

    """
    requests = []
    _delete_results(directory)
    for seed in seeds:
        place = directory / f"seed-{seed}" if apart else directory
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--out {place}: cannot be made: {error.strerror}") from error
        _delete_results(place)
        requests.append(ExperimentRequest(seed, varied(overrides, seed) if vary else overrides, place, processes))
    return requests


def summarize(outcomes: Sequence[Outcome]) -> tuple[BarSummary, ...]:
    """Every bar over all seeds, in the order in which they come."""
    bars: dict[str, list[tuple[int, Bar]]] = {}
    for outcome in outcomes:
        if isinstance(outcome, ExperimentResult):
            for bar in outcome.bars:
                bars.setdefault(bar.name, []).append((outcome.seed, bar))
    summaries = []
    for name, of_seeds in bars.items():
        seed, worst = min(of_seeds, key=lambda entry: entry[1].margin)
        bad = -math.inf if worst.at_least else math.inf
        median = statistics.median(bad if math.isnan(bar.value) else bar.value for _, bar in of_seeds)
        held = sum(bar.holds for _, bar in of_seeds)
        summaries.append(BarSummary(name, worst.limit, worst.at_least, held, worst.value, seed, median))
    return tuple(summaries)


def combine(experiment: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Make the printed JSON object of several seeds: counts, every bar over all of them, one entry a seed."""
    passed = sum(outcome.passed for outcome in outcomes)
    robots = [outcome.robot for outcome in outcomes if isinstance(outcome, ExperimentResult)]
    return {
        "experiment": experiment,
        "robot": robots[0] if robots else None,
        "seeds": len(outcomes),
        "seeds_passed": passed,
        "passed": passed == len(outcomes),
        "bars": [bar.as_json() for bar in summarize(outcomes)],
        "runs": [outcome.as_json() for outcome in outcomes],
    }


def _delete_results(place: Path) -> None:
    """Delete metrics and figures of an earlier run at a place, known by their names: other pictures stay."""
    figures = [f"{name}{more}.{kind}" for name in _module_names() for more in ("", "-*") for kind in ("png", "svg")]
    for pattern in (*RESULT_NAMES, *figures):
        for path in place.glob(pattern):
            try:
                path.unlink()
            except OSError as error:
                raise UsageError(f"--out {path}: an old result, cannot be deleted: {error.strerror}") from error


def _module_names() -> list[str]:
    """Names of the modules of `experiments` as experiments would have them."""
    import experiments

    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(experiments.__path__))


def _import(name: str) -> Any:
    return importlib.import_module(f"experiments.{name.replace('-', '_')}")


def _finite(value: Any) -> Any:
    """Put None for every number that is not finite: JSON has none."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return value


def _plain(value: Any) -> Any:
    """Put text for what JSON has no form for: dates and sets of YAML, numbers that are not finite."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)
