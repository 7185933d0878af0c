"""What the boot writes, against the standard's numbers."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.boot_objects import (
    Need,
    SdoWrite,
    communication_writes,
    drive_writes,
    interpolation_period,
    pdo_plans,
    torque_limit_per_mille,
)
from schemas.robot import Drive
from tests.hal.robots import robot


def drive(kind: str) -> Drive:
    return Drive(kind=kind, bus="b", node_id=4, rated_motor_torque=0.5, position_gain=1.0, velocity_gain=0.0)


@pytest.mark.parametrize(
    ("period_s", "expected"),
    [(0.002, (2, -3)), (0.001, (1, -3)), (0.005, (5, -3)), (0.004, (4, -3)), (0.0125, (125, -4)), (1.0, (1, 0))],
)
def test_interpolation_period_of_usual_rates(period_s: float, expected: tuple[int, int]) -> None:
    assert interpolation_period(period_s) == expected


@given(st.floats(1e-4, 10.0))
def test_interpolation_period_fits_its_object_and_is_near(period_s: float) -> None:
    mantissa, exponent = interpolation_period(period_s)
    assert 1 <= mantissa <= 255
    assert -128 <= exponent <= 127
    assert math.isclose(mantissa * 10.0**exponent, period_s, rel_tol=0.02)


@pytest.mark.parametrize(("kind", "valid"), [("position_pd", [0x204]), ("torque", [0x204, 0x304]), ("servo", [0x204])])
def test_the_pdos_of_each_kind(kind: str, valid: list[int]) -> None:
    plans = {plan.name: plan for plan in pdo_plans(drive(kind), foreign=False)}
    assert list(plans) == ["TPDO1", "RPDO1", "TPDO2", "RPDO2"]
    assert [plan.cob_id for name, plan in plans.items() if name[0] == "R" and plan.pdo is not None] == valid
    assert {name: (plan.communication, plan.mapping) for name, plan in plans.items()} == {
        "TPDO1": (0x1800, 0x1A00),
        "RPDO1": (0x1400, 0x1600),
        "TPDO2": (0x1801, 0x1A01),
        "RPDO2": (0x1401, 0x1601),
    }
    assert [plans[name].cob_id for name in ("TPDO1", "TPDO2")] == [0x40000184, 0x40000284]
    assert [plan.types for plan in plans.values() if plan.pdo is not None][::2] == [(1,), (0,)]


def test_another_makers_presets_are_not_used_and_its_types_are_tried() -> None:
    plans = {plan.name: plan for plan in pdo_plans(drive("torque"), foreign=True)}
    assert [name for name, plan in plans.items() if plan.pdo is None] == ["TPDO3", "RPDO3", "TPDO4", "RPDO4"]
    assert plans["TPDO1"].types == (1,), "the cycle is built on reports at each SYNC"
    assert plans["TPDO2"].types == (1, 0, 255, 254)
    assert plans["RPDO1"].types == plans["RPDO2"].types == (1, 0, 255, 254)


def test_another_makers_drive_gets_no_parameter_of_ours() -> None:
    def writes(kind: str, *, foreign: bool) -> dict[int, SdoWrite]:
        description = robot(kind)
        joint = description.joints[0]
        every = [
            *communication_writes(description, foreign=foreign),
            *drive_writes(description, joint, foreign=foreign),
        ]
        return {write.index: write for write in every}

    own, foreign = writes("torque", foreign=False), writes("torque", foreign=True)
    assert [index for index in own if 0x2000 <= index < 0x6000] == [0x2001, 0x2002, 0x2003, 0x2004, 0x2005]
    assert [index for index in foreign if 0x2000 <= index < 0x6000] == []
    assert {write.need for write in own.values()} == {Need.ALWAYS}
    assert [index for index, write in foreign.items() if write.need is Need.ALWAYS] == [0x1017]
    assert [index for index, write in foreign.items() if write.need is Need.WISH] == [0x1006, 0x6007]
    assert foreign[0x6007].value == 3  # quick stop when the heartbeat is missing
    assert writes("servo", foreign=True)[0x6072].need is Need.ALWAYS, "it is part of the servo's command"


@given(st.floats(0.01, 30.0), st.integers(1, 5000), st.floats(20.0, 300.0))
def test_the_torque_limit_is_never_rounded_up(share: float, rated_mnm: int, gear: float) -> None:
    rated = rated_mnm / 1000.0
    limit = share * rated * gear
    description = robot(
        "torque", joint={"gear_ratio": gear, "torque_limit": limit}, drive={"rated_motor_torque": rated}
    )
    per_mille = torque_limit_per_mille(description.joints[0])
    unit = rated * gear / 1000.0
    assert per_mille * unit <= limit * (1.0 + 1e-9)
    assert (per_mille + 1) * unit > limit * (1.0 - 1e-9)
