"""Bits and loads against the arithmetic of Davis, Burns, Bril and Lukkien (2007)."""

from __future__ import annotations

from typing import Any

import pytest

from schemas.bus_load import bus_loads, worst_case_bits


@pytest.mark.parametrize(("data_bytes", "bits"), [(0, 55), (4, 95), (6, 115), (8, 135)])
def test_worst_case_bits(data_bytes: int, bits: int) -> None:
    assert worst_case_bits(data_bytes) == bits


def test_load_of_a_cycle(run: Any) -> None:
    drives, sensors = bus_loads(run.robot.description)
    assert drives.bits == 55 + 2 * 135 + 2 * worst_case_bits(3) + 2 * worst_case_bits(7)
    assert drives.fraction == pytest.approx(drives.bits / 2000.0)
    assert sensors.bits == 55 + 2 * 135
    assert sensors.commands == ()
    assert drives.report_time_s + drives.command_time_s == pytest.approx(drives.bits * 1e-6)


@pytest.mark.parametrize("kind", ["position_pd", "servo"])
def test_drives_of_one_mode_report_it_on_an_error_alone(files: Any, kind: str) -> None:
    for joint in files.robot["joints"]:
        joint["drive"]["kind"] = kind
    reports = bus_loads(files.load().robot.description)[0].reports
    assert [name for name, _ in reports] == ["TPDO1", "TPDO1", "TPDO2"]
