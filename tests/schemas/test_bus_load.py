"""Bits, loads and cycle times against the arithmetic of Davis, Burns, Bril and Lukkien (2007)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from schemas.bus_load import BLOCKING_BITS, bus_loads, cycle_plan, worst_case_bits


@pytest.mark.parametrize(("data_bytes", "bits"), [(0, 55), (1, 65), (4, 95), (6, 115), (8, 135)])
def test_worst_case_bits(data_bytes: int, bits: int) -> None:
    assert worst_case_bits(data_bytes) == bits


def test_load_of_a_cycle(run: Any) -> None:
    drives, sensors = bus_loads(run.robot.description)
    assert drives.bits == 55 + 2 * 135 + 2 * worst_case_bits(3) + 2 * worst_case_bits(7)
    assert drives.cycle_fraction == pytest.approx(drives.bits / 2000.0)
    assert sensors.bits == 55 + 2 * 135
    assert sensors.commands == ()
    assert drives.report_time_s + drives.command_time_s == pytest.approx(drives.bits * 1e-6)


def test_heartbeats_take_their_share_of_the_time_and_may_all_fall_into_one_cycle(files: Any) -> None:
    files.robot["safety"] = {"heartbeat_s": 0.05}
    drives, sensors = bus_loads(files.load().robot.description)
    assert (drives.heartbeats, sensors.heartbeats) == (3, 1)  # of two drives and the HAL, of the HAL alone
    assert drives.fraction == pytest.approx(drives.bits / 2000.0 + 3 * 65 / 50_000.0)
    assert drives.first_reports == ()  # the worst cycle, a change of mode, holds those of torque drives
    assert drives.peak_fraction == pytest.approx((drives.bits + 3 * 65) / 2000.0)
    assert "3×heartbeat(65 bit) in 50 ms = 0.4%" in drives.explain()


def test_a_frame_of_lower_priority_blocks_once_and_is_no_longer_than_a_heartbeat(run: Any) -> None:
    drives, _ = bus_loads(run.robot.description)
    assert worst_case_bits(1) == BLOCKING_BITS
    assert drives.blocking_s == pytest.approx(65e-6)


@pytest.mark.parametrize("kind", ["position_pd", "servo"])
def test_drives_of_one_mode_report_it_on_an_error_alone(files: Any, kind: str) -> None:
    for joint in files.robot["joints"]:
        joint["drive"]["kind"] = kind
    drives, _ = bus_loads(files.load().robot.description)
    assert [name for name, _ in drives.reports] == ["TPDO1", "TPDO1", "TPDO2"]
    # After the boot, once, all of them tell it: here one more.
    assert [name for name, _ in drives.first_reports] == ["TPDO2"]
    assert drives.first_report_time_s == pytest.approx(85e-6)
    assert drives.peak_fraction == pytest.approx((drives.bits + 85 + 3 * 65) / 2000.0)


def test_a_cycle_waits_for_the_slowest_reports_and_the_slowest_commands(run: Any) -> None:
    plan = cycle_plan(run.robot.description)
    drives, sensors = plan.loads
    assert plan.report_time_s == max(drives.report_time_s, sensors.report_time_s)
    assert plan.needed_s == pytest.approx(plan.report_time_s + 1e-3 + drives.command_time_s)
    assert plan.available_s == pytest.approx(2e-3)
    assert plan.fits
    assert plan.faults() == ()
    assert plan.remedies() == ""


def test_a_plan_that_takes_its_period_exactly_fits_and_a_bit_more_does_not(run: Any) -> None:
    plan = cycle_plan(run.robot.description)
    budget = plan.available_s - plan.report_time_s - plan.command_time_s
    assert replace(plan, compute_budget_s=budget).in_time
    late = replace(plan, compute_budget_s=budget + 1e-6)
    assert not late.in_time
    assert not late.overloaded
    assert late.faults() == (f"commands miss their SYNC: {late.timing()}",)
    assert "0.495 ms" in late.timing()
    assert "2.001 ms > 2.000 ms = 1 × 2.000 ms" in late.timing()
    assert "set command_delay_cycles to 2" in late.remedies()


def test_a_second_cycle_of_delay_gives_a_second_period(run: Any) -> None:
    plan = replace(cycle_plan(run.robot.description), compute_budget_s=2e-3)
    assert not plan.in_time
    assert replace(plan, command_delay_cycles=2).in_time


def test_commands_kept_for_a_cycle_still_share_one_with_the_slowest_reports_of_another_bus(run: Any) -> None:
    plan = replace(cycle_plan(run.robot.description), command_delay_cycles=2)
    drives, sensors = plan.loads
    imus = tuple(("IMU", 8) for _ in range((2000 - 55) // 135))
    slow = replace(plan, loads=(drives, replace(sensors, reports=imus)))
    assert slow.fits
    assert slow.crowded
    assert not plan.crowded
    assert "command_delay_cycles" not in replace(slow, command_delay_cycles=1).remedies()


def test_what_fits_may_still_not_fit_beside_two_heartbeats(run: Any) -> None:
    plan = cycle_plan(run.robot.description)
    slack_s = plan.available_s - plan.needed_s
    assert plan.in_time_if_blocked
    tight = replace(plan, compute_budget_s=plan.compute_budget_s + slack_s - 100e-6)
    assert tight.in_time
    assert not tight.in_time_if_blocked


def test_faults_give_the_fullest_bus_with_its_arithmetic_and_name_the_others(files: Any) -> None:
    files.robot["rate_hz"] = 4000.0
    files.scenario["plant"] = {"substep_s": 0.00025}
    plan = cycle_plan(files.load(allow_overload=True).robot.description)
    drives, sensors = plan.loads
    overload, timing = plan.faults()
    assert overload == f"bus can0 is overloaded: {drives.explain()}; likewise can1 ({sensors.fraction:.1%})"
    assert timing.startswith("commands miss their SYNC: ")
