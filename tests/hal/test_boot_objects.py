"""What the boot writes, against the standard's numbers."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.boot_objects import (
    PROFILE_VENDOR_ID,
    communication_writes,
    drive_writes,
    interpolation_period,
    pdo_writes,
)
from schemas.robot import Drive
from tests.hal.robots import robot


def drive(kind: str, vendor_id: int = 0x402) -> Drive:
    return Drive(
        kind=kind,
        bus="b",
        node_id=4,
        rated_motor_torque=0.5,
        position_gain=1.0,
        velocity_gain=0.0,
        vendor_id=vendor_id,
    )


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


def test_remapping_follows_the_standard() -> None:
    writes = [(w.index, w.subindex, w.value) for w in pdo_writes(drive("servo")) if w.index in (0x1400, 0x1600)]
    assert writes == [
        (0x1400, 1, 0x80000204),
        (0x1600, 0, 0),
        (0x1600, 1, 0x60400010),
        (0x1600, 2, 0x607A0020),
        (0x1600, 3, 0x60720010),
        (0x1600, 0, 3),
        (0x1400, 2, 1),
        (0x1400, 1, 0x00000204),
    ]


@pytest.mark.parametrize(("kind", "valid"), [("position_pd", [0x204]), ("torque", [0x204, 0x304]), ("servo", [0x204])])
def test_unused_rpdos_are_made_invalid(kind: str, valid: list[int]) -> None:
    last = {w.index: w.value for w in pdo_writes(drive(kind)) if w.subindex == 1 and 0x1400 <= w.index < 0x1600}
    assert set(last) == {0x1400, 0x1401}
    assert [value for value in last.values() if not value >> 31] == valid


def test_presets_of_other_makers_are_made_invalid_where_they_exist() -> None:
    writes = pdo_writes(drive("torque", vendor_id=0x1234))
    others = {(w.index, w.value, w.optional) for w in writes if w.index & 0xFF in (2, 3)}
    assert others == {
        (0x1402, 0x80000404, True),
        (0x1403, 0x80000504, True),
        (0x1802, 0xC0000384, True),
        (0x1803, 0xC0000484, True),
    }


def test_another_makers_drive_gets_no_parameter_of_ours() -> None:
    def written(vendor_id: int) -> dict[int, int]:
        description = robot("torque", drive={"vendor_id": vendor_id})
        joint = description.joints[0]
        writes = [*communication_writes(description, joint.drive), *drive_writes(description, joint)]
        return {write.index: write.value for write in [*writes, *pdo_writes(joint.drive)]}

    def own_range(writes: dict[int, int]) -> list[int]:
        return [index for index in writes if 0x2000 <= index < 0x6000]

    assert own_range(written(PROFILE_VENDOR_ID)) == [0x2001, 0x2002, 0x2003, 0x2004, 0x2005]
    foreign = written(0xFB)
    assert own_range(foreign) == []
    assert foreign[0x6007] == 3  # quick stop when the heartbeat is missing
