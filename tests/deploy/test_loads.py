from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from deploy.loads import bus_metrics
from deploy.metrics import summarize
from deploy.report import write_report
from deploy.series import read_series
from deploy.summary import summary_table
from schemas.load import Run, load_run
from tests.deploy.bus_statistics import frame, statistics, write_log

ELBOW_RPDO1 = 0x206
LOST = (
    frame(0x080),
    frame(0x186, 480, replaced=20),
    frame(ELBOW_RPDO1, 200, late=100, replaced=200, wait_mean_s=1e-3, wait_max_s=4e-3),
    frame(0x300, 5),
)


def printed(*renderables: object) -> str:
    console = Console(width=120)
    with console.capture() as capture:
        for renderable in renderables:
            console.print(renderable)
    return capture.get()


def test_messages_of_a_bus_add_up_and_frames_get_their_names(run: Run) -> None:
    robot = run.robot.description
    second = statistics("arm9-1", load_mean=0.6, load_max=0.9, frames=LOST)
    (metrics,) = bus_metrics(robot, [statistics("arm9-1"), second, second])
    assert metrics.bus == "arm9-1"
    assert metrics.cycles == 1500
    assert metrics.load_mean == pytest.approx((0.4 + 0.6 + 0.6) / 3)
    assert metrics.load_max == 0.9
    assert (metrics.late, metrics.replaced) == (200, 440)
    by_id = {frame.can_id: frame for frame in metrics.frames}
    assert by_id[ELBOW_RPDO1].name == "RPDO1 of elbow_pitch"
    assert by_id[0x186].name == "TPDO1 of elbow_pitch"
    assert by_id[0x080].name == "SYNC"
    assert by_id[0x300].name == "0x300"  # RPDO2 of node 0: nobody's
    assert by_id[ELBOW_RPDO1].wait_max_s == 4e-3


def test_buses_come_in_the_robots_order_and_silent_ones_are_left_out(run: Run) -> None:
    robot = run.robot.description
    found = bus_metrics(robot, [statistics("arm9-2"), statistics("arm9-0")])
    assert [metrics.bus for metrics in found] == ["arm9-0", "arm9-2"]
    assert bus_metrics(robot, []) == ()


def test_a_bus_that_loses_nothing_has_no_complaint(run: Run) -> None:
    (metrics,) = bus_metrics(run.robot.description, [statistics("arm9-0")])
    assert metrics.complaint() == ""


def test_a_complaint_names_the_worst_frames_first(run: Run) -> None:
    (metrics,) = bus_metrics(run.robot.description, [statistics("arm9-1", frames=LOST)])
    assert metrics.complaint() == (
        "bus arm9-1: 100 late, 220 replaced frames"
        " (RPDO1 of elbow_pitch 100 late, 200 replaced; TPDO1 of elbow_pitch 20 replaced)"
    )
    many = tuple(frame(0x184 + n, late=0, replaced=9 - n) for n in range(3)) + tuple(
        frame(0x204 + n, late=n + 1) for n in range(3)
    )
    (metrics,) = bus_metrics(run.robot.description, [statistics("arm9-1", frames=many)])
    assert metrics.complaint().endswith("TPDO1 of elbow_pitch 7 replaced; 3 more)")


def test_the_summary_shows_the_loads_and_says_what_was_lost(run: Run, tmp_path: Path) -> None:
    messages = [statistics("arm9-0"), statistics("arm9-1", frames=LOST)]
    text = printed(summary_table(summarize(read_series(write_log(tmp_path / "run.mcap", run, *messages)))))
    assert "load of arm9-0, mean / busiest cycle" in text
    assert "40.0% / 50.0%" in text
    assert "bus arm9-1: 100 late, 220 replaced frames" in text
    assert "though the buses can carry this plan" in " ".join(text.split())


def test_a_plan_that_does_not_fit_is_to_blame(tmp_path: Path) -> None:
    run = load_run("arm9-transition", {"robot.compute_budget_s": 0.0015, "allow_overload": True})
    metrics = summarize(read_series(write_log(tmp_path / "run.mcap", run, statistics("arm9-1", frames=LOST))))
    assert not metrics.plan_fits
    assert "the buses cannot carry this plan" in " ".join(printed(summary_table(metrics)).split())


def test_metrics_json_holds_every_cob_id(run: Run, tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.mcap", run, statistics("arm9-1", frames=LOST))
    write_report(log, tmp_path, plots=False)
    (bus,) = json.loads((tmp_path / "metrics.json").read_text())["buses"]
    assert (bus["bus"], bus["late"], bus["replaced"]) == ("arm9-1", 100, 220)
    assert [(f["can_id"], f["what"], f["owner"], f["late"], f["replaced"]) for f in bus["frames"]] == [
        (0x080, "SYNC", "all", 0, 0),
        (0x186, "TPDO1", "elbow_pitch", 0, 20),
        (ELBOW_RPDO1, "RPDO1", "elbow_pitch", 100, 200),
        (0x300, "0x300", "", 0, 0),
    ]


def test_a_log_without_bus_statistics_is_summed_up_as_before(run: Run, tmp_path: Path) -> None:
    metrics = summarize(read_series(write_log(tmp_path / "run.mcap", run)))
    assert metrics.buses == ()
    text = printed(summary_table(metrics))
    assert "load of" not in text
    assert "replaced" not in text
