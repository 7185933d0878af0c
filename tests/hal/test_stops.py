"""What the core does with drives that are not enabled, with left-out SYNCs, and when it leaves."""

from __future__ import annotations

import struct

import pytest

from hal.guard import OVERSPEED
from schemas.base import ControlMode
from schemas.messages import HalStatus
from tests.hal.robots import ENABLED
from tests.hal.test_cycle import Loop

P, T = ControlMode.POSITION, ControlMode.TORQUE
SWITCH_ON_DISABLED, READY, SWITCHED_ON, QUICK_STOP_ACTIVE = 0x0240, 0x0221, 0x0223, 0x0207


def controlword(loop: Loop, statusword: int) -> int:
    """Answer to a first joint that reports a statusword."""
    loop.statusword[0] = statusword
    loop.sync()
    data = loop.answer(None)
    return int(struct.unpack_from("<H", data.get(0x201) or data[0x301])[0])


@pytest.mark.parametrize(
    ("statusword", "stays", "next_word"),
    [(SWITCH_ON_DISABLED, 0x00, 0x06), (READY, 0x06, 0x07), (SWITCHED_ON, 0x07, 0x0F)],
)
def test_an_emergency_stop_powers_nothing_up_before_its_reset(statusword: int, stays: int, next_word: int) -> None:
    loop = Loop()
    loop.cycle(P, position=(0.0, 0.0))
    loop.core.stop("button", emergency=True)
    assert {controlword(loop, statusword) for _ in range(5)} == {stays}
    loop.core.reset()
    assert controlword(loop, statusword) == next_word


@pytest.mark.parametrize("emergency", [False, True])
def test_a_quick_stops_ramp_is_not_cut_short(emergency: bool) -> None:
    loop = Loop()
    loop.cycle(P, position=(0.0, 0.0))
    loop.core.stop("test", emergency=emergency)
    assert {controlword(loop, QUICK_STOP_ACTIVE) for _ in range(5)} == {0x02}


def test_left_out_syncs_are_no_overspeed() -> None:
    loop = Loop("torque", positions=[-1.0])
    for cycle in range(40):
        if cycle in (20, 30):  # two SYNCs left out: the joint moves on
            loop.sequence += 2
            loop.position = loop.position + 2 * loop.velocity * loop.robot.period_s
        loop.cycle(T, torque=(0.0,))
        loop.velocity[:] = 0.97 * OVERSPEED * loop.robot.joints[0].velocity_limit
    assert [event.text for event in loop.core.drain_events() if event.severity == "error"] == []
    assert loop.core.status is HalStatus.ACTIVE


@pytest.mark.parametrize("delay", [1, 2])
def test_the_hal_stays_until_its_offset_is_gone(delay: int) -> None:
    loop = Loop("torque", command_delay_cycles=delay)
    safety = loop.robot.safety
    ramp = round(safety.hold_ramp_s * loop.robot.rate_hz)
    short = delay + 1
    loop.cycle(P, position=(0.0,))
    assert loop.statusword == [ENABLED]
    assert loop.core.cycles_to_hold == short
    loop.cycle(T, torque=(20.0,))
    assert loop.core.cycles_to_hold > ramp + delay
    for _ in range(5):
        loop.cycle(T, torque=(20.0,))
    for _ in range(delay + 1):
        loop.cycle(P, position=(0.0,))
        assert loop.core.cycles_to_hold > ramp + delay
    for _ in range(ramp + delay):
        loop.cycle(P, position=(0.0,))
    assert loop.core.cycles_to_hold == short
    loop.core.stop("test")
    assert loop.core.cycles_to_hold > ramp + delay
