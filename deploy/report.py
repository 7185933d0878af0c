"""`cosim report`: metrics.json and plots from a log."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.errors import UsageError
from deploy.metrics import RunMetrics, summarize
from deploy.series import RunSeries, read_series

METRICS_NAME = "metrics.json"
PLOTTED_CHANGES = 4
"""Mode changes that get a figure of their own; a run with more has them in the metrics."""


@dataclass(frozen=True, slots=True)
class Report:
    """What was found and the files written."""

    log: Path
    metrics: RunMetrics
    files: tuple[Path, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "log": str(self.log),
            "metrics": self.metrics.as_json(),
            "files": [str(path) for path in self.files],
        }


def write_report(log: Path, directory: Path, *, plots: bool = True) -> Report:
    """Read a log, write `metrics.json` and the plots into a directory.

    Raises:
        LogError: the log cannot be read.
        ReportError: it holds no state.
        UsageError: the directory cannot be written.

    """
    series = read_series(log)
    metrics = summarize(series)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        file = directory / METRICS_NAME
        file.write_text(json.dumps(metrics.as_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        files = (file, *(write_plots(series, metrics, directory) if plots else ()))
    except OSError as error:
        raise UsageError(f"cannot write the report into {directory}: {error.strerror}") from error
    return Report(log, metrics, files)


def write_plots(series: RunSeries, metrics: RunMetrics, directory: Path) -> tuple[Path, ...]:
    """Draw what the log has material for; SVG."""
    import matplotlib

    matplotlib.use("Agg")
    from deploy.plots import hand_figure, joints_figure, transition_figure

    figures = {"joints.svg": joints_figure(series), "hand.svg": hand_figure(series)}
    for number, change in enumerate(metrics.mode_changes[:PLOTTED_CHANGES], start=1):
        figures[f"transition-{number}.svg"] = transition_figure(series, change)
    written = []
    for name, figure in figures.items():
        if figure is not None:
            figure.savefig(directory / name)
            written.append(directory / name)
    return tuple(written)
