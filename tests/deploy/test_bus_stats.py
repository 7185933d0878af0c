from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from deploy.bus_frames import BusFrame, in_time
from deploy.bus_stats import BusReport, counted_report, logged_report
from hal.profile.bits import frame_bits
from hal.profile.frames import CAN_ERR_FLAG, pack
from schemas.load import load_robot
from schemas.log import LogReader, LogWriter
from schemas.messages import BusStatistics, FrameStatistics
from tests.deploy.bus_logs import recorded

ARM9 = load_robot("arm9").description
SYNC, REPORT = pack(0x080, b""), pack(0x181, bytes(range(8)))


def frames(*each: bytes, bus: str = "arm9-0") -> list[BusFrame]:
    return [BusFrame(0, bus, frame, sent=False) for frame in each]


def shown(report: BusReport) -> str:
    console = Console(file=StringIO(), width=100)
    for heading, table in report.tables():
        console.print(heading)
        console.print(table)
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_loads_are_the_bits_of_a_period_of_syncs_whatever_the_clock() -> None:
    report = counted_report(ARM9, frames(REPORT, SYNC, REPORT, SYNC, REPORT, REPORT))
    (bus,) = report.metrics
    one, three = frame_bits(SYNC) + frame_bits(REPORT), frame_bits(SYNC) + 2 * frame_bits(REPORT)
    assert (bus.bus, bus.cycles) == ("arm9-0", 2)
    assert bus.load_max == pytest.approx(three / 2000)
    assert bus.load_mean == pytest.approx((one + three) / 4000)
    assert [(each.can_id, each.frames) for each in bus.frames] == [(0x080, 2), (0x181, 3)]  # not those before a SYNC


def test_error_frames_count_but_take_no_time() -> None:
    with_error = counted_report(ARM9, frames(SYNC, pack(CAN_ERR_FLAG | 4, bytes(8)))).metrics[0]
    assert with_error.load_max == pytest.approx(frame_bits(SYNC) / 2000)
    assert sum(each.frames for each in with_error.frames) == 2


def test_what_is_counted_tells_no_times_and_no_losses() -> None:
    report = counted_report(ARM9, frames(SYNC, REPORT))
    (values,) = report.as_json()
    assert values["timed"] is False
    assert "late" not in values
    assert "command_end_max_s" not in values
    assert values["frames"][1] == {"can_id": 0x181, "what": "TPDO1", "owner": "scapula_yaw", "frames": 1}
    text = shown(report)
    assert "late" not in text
    assert "scapula_yaw" in text


def test_a_bus_without_sync_is_left_out() -> None:
    assert counted_report(ARM9, frames(REPORT)).metrics == ()


def test_counted_loads_of_a_run_are_those_the_simulated_wire_tells(tmp_path: Path) -> None:
    log = recorded("arm9")
    counted = counted_report(ARM9, in_time(ARM9, log.frames))
    for bus in counted.metrics:
        last = max(each.sequence for each in log.frames)
        assert bus.cycles == last + 1
        busy = sum(
            frame_bits(each.frame) for each in in_time(ARM9, log.frames) if each.bus == bus.bus and each.time_ns >= 0
        )
        assert bus.load_mean == pytest.approx(busy / 2000 / bus.cycles)


def test_a_log_tells_what_its_buses_told(tmp_path: Path) -> None:
    log = recorded("arm9")
    path = tmp_path / "run.mcap"
    frame = FrameStatistics(can_id=0x201, frames=500, late=3, replaced=1, wait_mean_s=1e-4, wait_max_s=2e-4)
    told = BusStatistics(
        sequence=499, time_ns=998_000_000, bus="arm9-0", cycles=500, load_mean=0.4, load_max=0.5,
        report_end_max_s=6e-4, command_end_max_s=1.8e-3, frames=(frame,),
    )  # fmt: skip
    with LogWriter(path, log.run, {}) as writer:
        writer.write("load/arm9-0", told)
        writer.write("load/arm9-0", told.model_copy(update={"sequence": 999}))
    report = logged_report(LogReader(path), ["arm9-0", "arm9-1"])
    assert report is not None
    (values,) = report.as_json()
    assert (values["timed"], values["cycles"], values["late"], values["replaced"]) == (True, 1000, 6, 2)
    text = shown(report)
    assert "load 40.0% on average, 50.0% at most, 1000 cycles" in text
    assert "last report 0.600 ms, last command 1.800 ms after its SYNC" in text
    assert "200 µs" in text
    assert logged_report(LogReader(path), ["arm9-1"]) is None
