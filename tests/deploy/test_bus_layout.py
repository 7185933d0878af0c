from __future__ import annotations

import pytest

from deploy.bus_frames import hal_identifiers
from deploy.bus_layout import Signal, bus_layouts
from schemas.robot import RobotDescription
from tests.deploy.bus_logs import SCENARIOS, recorded


def robot(name: str) -> RobotDescription:
    return recorded(name).run.robot.description


@pytest.mark.parametrize(
    ("signal", "data", "raw"),
    [
        (Signal("x", 0, 16), "0102", 0x0201),
        (Signal("x", 0, 16, big_endian=True), "0102", 0x0102),
        (Signal("x", 8, 16, signed=True), "00feff", -2),
        (Signal("x", 8, 16, signed=True, big_endian=True), "00fffe", -2),
        (Signal("x", 4, 8), "3412", 0x23),
        (Signal("x", 0, 7), "b7", 0x37),
        (Signal("x", 7, 1), "b7", 1),
    ],
)
def test_raw_values(signal: Signal, data: str, raw: int) -> None:
    assert signal.raw(bytes.fromhex(data)) == raw


def test_values_are_scaled_named_or_plain() -> None:
    assert Signal("x", 0, 8, True, scale=-0.5, offset=1.0, unit="rad").value(b"\xfe") == 2.0
    assert Signal("x", 0, 8, choices={5: "operational"}).value(b"\x05") == "operational"
    assert Signal("x", 0, 8, choices={5: "operational"}).value(b"\x06") == 6


@pytest.mark.parametrize(("scale", "decimals"), [(6.97e-6, 6), (-0.08, 2), (0.12, 2), (5e-4, 4), (1.0, 2)])
def test_decimals_show_one_count(scale: float, decimals: int) -> None:
    assert Signal("x", 0, 16, scale=scale, unit="rad").decimals == decimals


@pytest.mark.parametrize("name", SCENARIOS)
def test_identifiers_are_distinct_and_those_of_the_hal_are_told(name: str) -> None:
    for bus in robot(name).buses:
        layouts = bus_layouts(robot(name), bus.name)
        ids = [layout.can_id for layout in layouts]
        assert len(ids) == len(set(ids))
        assert {layout.can_id for layout in layouts if layout.from_hal} <= hal_identifiers(robot(name), bus.name)
        for layout in layouts:
            assert all(signal.start + signal.bits <= 8 * layout.length for signal in layout.signals)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_frame_of_a_run_has_a_layout_of_its_length(name: str) -> None:
    for message in recorded(name).frames:
        lengths = {layout.can_id: layout.length for layout in bus_layouts(robot(name), message.bus)}
        for packet in (message.sent, message.received):
            for start in range(0, len(packet), 16):
                assert packet[start + 4] == lengths[int.from_bytes(packet[start : start + 4], "little")]
