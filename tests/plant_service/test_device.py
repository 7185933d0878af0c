"""NMT, heartbeat, EMCY and the watchdogs of a simulated drive; frames written out from CiA 301."""

from __future__ import annotations

import pytest

from schemas.messages import DriveState as S


def emcys(heard):
    return [data[:3].hex(" ") for can_id, data in heard if can_id == 0x085]


def test_boot_up_message(bench):
    assert bench.said == [(0x705, b"\x00")]


@pytest.mark.parametrize("command", [0x81, 0x82], ids=["reset node", "reset communication"])
def test_reset(bench, command):
    bench.write(0x1017, 0, 100, 2)
    bench.write(0x605E, 0, 0, 2)
    assert bench.send(0x000, bytes([command, 0])) == [(0x705, b"\x00")]
    assert bench.read(0x1017) == 0
    assert bench.read(0x605E) == (2 if command == 0x81 else 0)


def test_nmt_of_another_node(bench):
    bench.write(0x1017, 0, 10, 2)
    bench.send(0x000, b"\x01\x06")
    assert (0x705, b"\x7f") in bench.wait(11)


@pytest.mark.parametrize(("command", "state"), [(0x01, 0x05), (0x02, 0x04), (0x80, 0x7F)])
def test_heartbeat_carries_the_nmt_state(bench, command, state):
    bench.write(0x1017, 0, 10, 2)
    bench.send(0x000, bytes([command, 5]))
    beats = [data for can_id, data in bench.wait(41) if can_id == 0x705]
    assert beats == [bytes([state])] * 4


def test_emcy_register_and_history_keep_step(bench):
    bench.enable()
    bench.device.fault(0x2310)
    assert emcys(bench.sync()) == ["10 23 03"]  # generic | current
    assert bench.read(0x603F) == 0x2310
    bench.device.fault(0x7305)
    assert emcys(bench.sync()) == ["05 73 23"]
    assert (bench.read(0x1003), bench.read(0x1003, 1), bench.read(0x1003, 2)) == (2, 0x7305, 0x2310)
    bench.wait(50)
    bench.write(0x6040, 0, 0, 2)
    bench.said.clear()
    bench.write(0x6040, 0, 0x80, 2)
    assert emcys(bench.said) == ["00 00 00"]
    assert (bench.read(0x1001), bench.read(0x603F), bench.read(0x1003)) == (0, 0, 2)
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert bench.sdo("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"


def test_disabled_emcy_is_silent(bench):
    bench.write(0x1014, 0, 0x8000_0085, 4)
    bench.device.fault(0x2310)
    assert emcys(bench.wait(2)) == []
    assert bench.read(0x603F) == 0x2310


@pytest.mark.parametrize(
    ("option", "state", "motion"),
    [
        (0, S.OPERATION_ENABLED, "hold"),
        (1, S.FAULT, "off"),
        (2, S.SWITCH_ON_DISABLED, "off"),
        (3, S.QUICK_STOP_ACTIVE, "hold"),
    ],
)
def test_lost_heartbeat(bench, option, state, motion):
    bench.write(0x6007, 0, option, 2)
    bench.write(0x1016, 1, 127 << 16 | 30, 4)
    bench.enable()
    assert emcys(bench.wait(100)) == []  # none heard yet: not watched
    for _ in range(5):
        bench.send(0x77F, b"\x05")
        assert emcys(bench.wait(20)) == []
    assert emcys(bench.wait(100)) == ["30 81 11"]
    assert (bench.device.state, bench.axis.motion) == (state, motion)


def test_fault_stays_while_the_heartbeat_is_missing(bench):
    bench.write(0x6007, 0, 1, 2)
    bench.write(0x1016, 1, 127 << 16 | 30, 4)
    bench.enable()
    bench.send(0x77F, b"\x05")
    bench.wait(100)
    for word in (0, 0x80):
        bench.write(0x6040, 0, word, 2)
    assert bench.device.state is S.FAULT
    bench.send(0x77F, b"\x05")
    for word in (0, 0x80):
        bench.write(0x6040, 0, word, 2)
    assert bench.device.state is S.SWITCH_ON_DISABLED


def run_torque(bench, cycles: int) -> None:
    for _ in range(cycles):
        bench.command_torque(5)
        bench.sync()
        bench.wait(1)


@pytest.mark.parametrize(
    ("loss", "code"),
    [("sync", "00 81 11"), ("rpdo", "50 82 11")],
    ids=["no SYNC, RPDOs go on", "no RPDO, SYNC goes on"],
)
def test_watchdog_holds_within_five_cycles(bench, loss, code):
    bench.enable(mode=10)
    run_torque(bench, 20)
    assert bench.axis.motion == "torque"
    bench.said.clear()
    for cycle in range(4):
        if loss == "sync":
            bench.command_torque(5)
        else:
            bench.sync()
        assert bench.axis.motion == "torque", cycle
        bench.wait(1)
    assert bench.axis.motion == "hold"
    assert emcys(bench.said) == [code]
    assert bench.read(0x6061) == 8
    assert bench.status & 0x106F == 0x0027  # operation enabled, does not follow

    run_torque(bench, 10)  # the master is back as if nothing had happened
    assert bench.axis.motion == "hold"
    assert bench.read(0x6061) == 8
    for word in (0x06, 0x07):
        bench.command_torque(5, word=word)
        bench.sync()
    run_torque(bench, 3)
    assert bench.axis.motion == "torque"
    assert (bench.read(0x6061), bench.read(0x1001), bench.read(0x603F)) == (10, 0, 0)


def test_watchdog_switched_off(bench):
    bench.write(0x2004, 0, 0, 2)
    bench.enable(mode=10)
    run_torque(bench, 3)
    bench.wait(50)
    assert bench.axis.motion == "torque"


def test_reset_communication_frees_the_hold(bench):
    bench.enable(mode=10)
    run_torque(bench, 3)
    bench.wait(10)
    bench.send(0x000, b"\x82\x05")
    assert (bench.device.state, bench.axis.motion) == (S.OPERATION_ENABLED, "hold")
    bench.write(0x1401, 1, 0x305, 4)
    bench.send(0x000, b"\x01\x05")
    run_torque(bench, 2)
    assert bench.axis.motion == "torque"


@pytest.mark.parametrize("command", [0x02, 0x80], ids=["stop", "pre-operational"])
def test_leaving_operational_holds(bench, command):
    bench.enable(mode=10)
    run_torque(bench, 3)
    bench.send(0x000, bytes([command, 5]))
    assert bench.axis.motion == "hold"


def test_torque_by_sdo_grows_stale(bench):
    bench.enable(mode=10)
    bench.write(0x1006, 0, 0, 4)
    bench.write(0x6071, 0, 5, 2)
    bench.wait(99)
    assert bench.axis.motion == "torque"
    assert emcys(bench.wait(1)) == ["50 82 11"]
    assert bench.axis.motion == "hold"


def test_rpdo_deadline(bench):
    bench.enable()
    bench.write(0x1006, 0, 0, 4)
    bench.write(0x1400, 5, 20, 2)
    bench.command_position(0)
    bench.sync()
    assert emcys(bench.wait(19)) == []
    assert emcys(bench.wait(1)) == ["50 82 11"]


def test_sync_with_data_is_not_taken(bench):
    bench.enable()
    assert bench.send(0x080, b"\x01") == [(0x085, bytes.fromhex("4082110000000000"))]


def test_gains_reach_the_axis(bench):
    bench.write(0x2001, 0, 1_500_000, 4)
    bench.write(0x2005, 0, 250, 2)
    first, second = bench.axis.gains
    assert first.position_gain == pytest.approx(1500.0)
    assert second.hold_ramp_s == pytest.approx(0.25)


def test_a_tick_is_never_late_for_what_became_due_after_the_tick_before(bench):
    bench.enable(mode=10)
    bench.sync()
    bench.wait(1)
    bench.write(0x1017, 0, 1, 2)  # a heartbeat, asked for between two ticks that had nothing to do
    assert [can_id for can_id, _ in bench.wait(2)] == [0x705]
    bench.write(0x1017, 0, 0, 2)
    bench.device.fault(0x5400)
    assert [can_id for can_id, _ in bench.wait(1)] == [0x085]


@pytest.mark.parametrize("mode", [8, 10])
def test_a_target_torque_by_sdo_before_enabling_arms_no_watchdog(bench, mode):
    bench.write(0x1006, 0, 1000, 4)
    assert bench.write(0x6071, 0, 0, 2) == 0
    bench.wait(50)
    bench.enable(8)
    for _ in range(50):
        bench.wait(1)
        if mode == 10:
            bench.command_torque(0)
        bench.sync()
    assert emcys(bench.said) == []
    assert bench.device.state is S.OPERATION_ENABLED
    assert not bench.device.power.left_alone
