from __future__ import annotations

import json
from pathlib import Path

from deploy.report import write_report


def test_a_report_holds_metrics_and_a_figure_of_each_change(fresh_log: Path, tmp_path: Path) -> None:
    report = write_report(fresh_log, tmp_path / "plots")
    names = {path.name for path in report.files}
    assert names == {"metrics.json", "joints.svg", "hand.svg", "transition-1.svg", "transition-2.svg"}
    assert all(path.stat().st_size > 0 for path in report.files)
    metrics = json.loads((tmp_path / "plots" / "metrics.json").read_text())
    assert metrics["states"] == metrics["commands"] == 150
    assert [(change["from_mode"], change["to_mode"]) for change in metrics["mode_changes"]] == [(8, 10), (10, 8)]
    assert metrics["hand_error_rms_m"] is not None


def test_a_cut_log_is_reported_as_cut(fresh_log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(fresh_log.read_bytes()[:-40])
    report = write_report(cut, tmp_path, plots=False)
    assert report.metrics.log_complete is False
    assert report.metrics.states > 0
