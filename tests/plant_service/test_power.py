"""The power state machine against the standard's diagram, written by hand; what the axis does in each state."""

from __future__ import annotations

import pytest

from schemas.messages import DriveState as S

SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80
WAY_UP = (SHUTDOWN, SWITCH_ON, ENABLE)
LEVELS = (S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED)

DIAGRAM = {
    S.SWITCH_ON_DISABLED: {SHUTDOWN: S.READY_TO_SWITCH_ON},
    S.READY_TO_SWITCH_ON: {
        SWITCH_ON: S.SWITCHED_ON,
        ENABLE: S.OPERATION_ENABLED,
        QUICK_STOP: S.SWITCH_ON_DISABLED,
        DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
    },
    S.SWITCHED_ON: {
        SHUTDOWN: S.READY_TO_SWITCH_ON,
        ENABLE: S.OPERATION_ENABLED,
        QUICK_STOP: S.SWITCH_ON_DISABLED,
        DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
    },
    S.OPERATION_ENABLED: {
        SHUTDOWN: S.READY_TO_SWITCH_ON,
        SWITCH_ON: S.SWITCHED_ON,
        QUICK_STOP: S.QUICK_STOP_ACTIVE,
        DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED,
    },
    S.QUICK_STOP_ACTIVE: {ENABLE: S.OPERATION_ENABLED, DISABLE_VOLTAGE: S.SWITCH_ON_DISABLED},
    S.FAULT: {RESET: S.SWITCH_ON_DISABLED},
}
"""State → controlword → next state; 0x605A is 6. What is not listed changes nothing."""
STATUS = {
    S.SWITCH_ON_DISABLED: (0x4F, 0x40),
    S.READY_TO_SWITCH_ON: (0x6F, 0x21),
    S.SWITCHED_ON: (0x6F, 0x23),
    S.OPERATION_ENABLED: (0x6F, 0x27),
    S.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    S.FAULT: (0x4F, 0x08),
}


def bring(bench, state: S) -> None:
    if state in LEVELS:
        words = WAY_UP[: LEVELS.index(state)]
    else:
        words = (*WAY_UP, QUICK_STOP) if state is S.QUICK_STOP_ACTIVE else ()
    for word in words:
        bench.write(0x6040, 0, word, 2)
    if state is S.FAULT:
        bench.device.fault(0x2310)


@pytest.mark.parametrize("word", [SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, RESET])
@pytest.mark.parametrize("state", list(DIAGRAM), ids=lambda state: state.name)
def test_every_state_and_controlword(bench, state, word):
    bring(bench, state)
    mask, value = STATUS[state]
    assert bench.status & mask == value
    bench.write(0x6040, 0, word, 2)
    mask, value = STATUS[DIAGRAM[state].get(word, state)]
    assert bench.status & mask == value


@pytest.mark.parametrize("state", list(DIAGRAM), ids=lambda state: state.name)
def test_torque_only_under_operation_or_stop(bench, state):
    bring(bench, state)
    powered = state in (S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE)
    assert bench.axis.motion == ("hold" if powered else "off")


def test_fault_reset_needs_a_rising_edge(bench):
    bench.write(0x6040, 0, RESET, 2)
    bench.device.fault(0x2310)
    bench.write(0x6040, 0, RESET, 2)
    assert bench.status & 0x4F == 0x08
    bench.write(0x6040, 0, 0, 2)
    bench.write(0x6040, 0, RESET, 2)
    assert bench.status & 0x4F == 0x40


def test_quick_stop_that_does_not_stay(bench):
    bench.write(0x605A, 0, 2, 2)
    bring(bench, S.OPERATION_ENABLED)
    bench.axis.velocity = 5.0e4
    bench.wait(2)
    bench.write(0x6040, 0, QUICK_STOP, 2)
    assert bench.device.state is S.QUICK_STOP_ACTIVE
    bench.write(0x6040, 0, ENABLE, 2)
    assert bench.device.state is S.QUICK_STOP_ACTIVE  # transition 16 exists with options 5 to 8 only
    bench.wait(200)
    assert (bench.device.state, bench.axis.motion) == (S.SWITCH_ON_DISABLED, "off")


@pytest.mark.parametrize(("option", "state"), [(0, S.FAULT), (2, S.FAULT_REACTION_ACTIVE)])
def test_fault_reaction(bench, option, state):
    bench.write(0x605E, 0, option, 2)
    bench.enable()
    bench.axis.velocity = 5.0e4
    bench.wait(2)
    bench.device.fault(0x7320)
    assert bench.device.state is state
    bench.wait(200)
    assert (bench.device.state, bench.axis.motion) == (S.FAULT, "off")


@pytest.mark.parametrize(("option", "state"), [(0, S.SWITCHED_ON), (1, S.OPERATION_ENABLED)])
def test_disable_operation_of_a_moving_axis(bench, option, state):
    bench.write(0x605C, 0, option, 2)
    bench.enable()
    bench.axis.velocity = 5.0e4
    bench.wait(2)
    bench.write(0x6040, 0, SWITCH_ON, 2)
    assert bench.device.state is state
    bench.wait(200)
    assert (bench.device.state, bench.axis.motion) == (S.SWITCHED_ON, "off")


def test_enabled_without_a_target_it_holds_where_it_stands(bench):
    bench.axis.position = 5000.0
    bench.enable()
    for _ in range(50):
        bench.sync()
        bench.wait(1)
    assert bench.axis.position_counts() == 5000


def test_target_sent_before_enabling_is_not_followed(bench):
    bench.write(0x607A, 0, 10000, 4)
    bench.enable()
    bench.sync()
    assert bench.axis.motion == "hold"


def test_position_then_torque(bench):
    bench.enable()
    for step in range(300):
        bench.command_position(min(1000, 10 * step))
        bench.sync()
        bench.wait(1)
    assert bench.axis.position_counts() == pytest.approx(1000, abs=2)
    assert bench.status & 0x1000  # follows the command
    bench.command_torque(50)
    answer = dict(bench.sync())
    assert answer[0x285] == b"\x0a\x00\x00"  # TPDO2: mode 10, no error
    assert (bench.axis.motion, bench.axis.target) == ("torque", 50)
    start = bench.axis.velocity
    bench.wait(3)
    assert bench.axis.velocity - start == pytest.approx(3e-3 * 50 * bench.axis.COUNTS_PER_MILLE)


def test_torque_above_the_limit_sets_bit_11(bench):
    bench.enable(mode=10)
    bench.write(0x6072, 0, 300, 2)
    bench.command_torque(301)
    bench.sync()
    assert bench.axis.limit == 300
    assert bench.status & 0x0800


def test_unsupported_mode_by_rpdo_is_ignored(bench):
    bench.enable()
    bench.command_position(100, mode=9)
    bench.sync()
    assert bench.read(0x6061) == 8
    assert (bench.axis.motion, bench.axis.target) == ("position", 100)


def test_mode_change_without_a_torque_holds(bench):
    bench.enable()
    bench.write(0x6071, 0, 400, 2)
    bench.write(0x6060, 0, 10, 1)
    bench.sync()
    assert bench.axis.motion == "hold"
    assert bench.read(0x6061) == 10


def test_halt(bench):
    bench.enable()
    bench.command_position(100)
    bench.sync()
    bench.command_position(200, word=0x10F)
    bench.sync()
    assert bench.axis.motion == "hold"
    bench.command_position(200)
    bench.sync()
    assert (bench.axis.motion, bench.axis.target) == ("position", 200)


def test_following_error(bench):
    bench.write(0x6065, 0, 500, 4)
    bench.enable()
    bench.command_position(10)
    bench.sync()
    bench.command_position(600)
    heard = bench.sync()
    assert heard[0] == (0x085, bytes.fromhex("1186210000000000"))
    assert bench.device.state is S.FAULT_REACTION_ACTIVE


def test_position_limit(bench):
    bench.write(0x607D, 2, 50, 4)
    bench.enable()
    bench.command_position(100)
    bench.sync()
    assert bench.axis.target == 50
    assert bench.status & 0x0800
