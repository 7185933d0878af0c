"""CiA 301 sections 7.2.8 and 7.3.2: NMT states, commands and which service works in which state."""

from __future__ import annotations

import pytest

STATES = {"operational": ("01", "05"), "stopped": ("02", "04"), "pre-operational": ("80", "7f")}
"""State → command that leads to it, its byte in the heartbeat."""
COMMANDS = {
    "start": ("01", "05"),
    "stop": ("02", "04"),
    "enter pre-operational": ("80", "7f"),
    "reset node": ("81", "7f"),
    "reset communication": ("82", "7f"),
}


def state_of(wire, *, producing: bool) -> str:
    if not producing:
        wire.set("2b 17 10 00 0a 00 00 00")
    return next(frame[4:] for frame in wire.wait(30) if frame.startswith("705"))


def test_boot_up(wire):
    assert wire.bench.said == [(0x705, b"\x00")]
    assert state_of(wire, producing=False) == "7f"


@pytest.mark.parametrize("node", ["05", "00"], ids=["this node", "all nodes"])
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("state", STATES)
def test_every_command_in_every_state(wire, state, command, node):
    wire.set("2b 17 10 00 0a 00 00 00")
    wire.send(f"000 {STATES[state][0]} 05")
    code, byte = COMMANDS[command]
    reset = command.startswith("reset")
    assert [f for f in wire.send(f"000 {code} {node}") if not f.startswith(("185", "285"))] == (
        ["705 00"] if reset else []
    )
    assert state_of(wire, producing=not reset) == byte


@pytest.mark.parametrize(
    "frame", ["01 06", "01", "01 05 00", "03 05", "00 05", "7f 05", "ff 05", ""], ids=lambda data: data or "empty"
)
def test_what_is_no_command_for_this_node(wire, frame):
    assert wire.send(f"000 {frame}") == []
    assert state_of(wire, producing=False) == "7f"


class TestServices:
    """Table 36 of CiA 301: which objects work in which state."""

    def enter(self, wire, state: str) -> None:
        wire.send(f"000 {STATES[state][0]} 05")

    @pytest.mark.parametrize(("state", "works"), [("operational", True), ("pre-operational", True), ("stopped", False)])
    def test_sdo(self, wire, state, works):
        self.enter(wire, state)
        assert wire.sdo("40 00 10 00 00 00 00 00") == ("43 00 10 00 92 01 02 00" if works else "")

    @pytest.mark.parametrize("state", STATES)
    def test_tpdos_and_rpdos(self, wire, state):
        wire.enable()
        self.enter(wire, state)
        answers = wire.send("205 0f 00 08 64 00 00 00", "080")
        works = state == "operational"
        assert [frame[:3] for frame in answers] == (["185", "285"] if works else [])
        assert wire.axis.motion == ("position" if works else "hold")

    @pytest.mark.parametrize(("state", "works"), [("operational", True), ("pre-operational", True), ("stopped", False)])
    def test_emcy(self, wire, state, works):
        self.enter(wire, state)
        wire.bench.device.fault(0x2310)
        assert [frame for frame in wire.wait(2) if frame.startswith("085")] == (
            ["085 10 23 03 00 00 00 00 00"] if works else []
        )
        wire.send("000 80 05")
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 10 23 00 00"

    @pytest.mark.parametrize("state", STATES)
    def test_heartbeats_are_consumed_and_produced(self, wire, state):
        wire.set("2b 17 10 00 0a 00 00 00", "23 16 10 01 1e 00 7f 00")
        self.enter(wire, state)
        wire.send("77f 05")
        beats = [frame for frame in wire.wait(50) if frame.startswith("705")]
        assert beats == [f"705 {STATES[state][1]}"] * 4
        wire.send("000 80 05")
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 30 81 00 00"

    def test_pdos_from_before_operational_are_not_latched(self, wire):
        wire.send("205 06 00 08 00 00 00 00", "000 01 05", "080")
        assert wire.statusword() & 0x4F == 0x40

    def test_pdos_waiting_for_a_sync_are_dropped_when_the_node_leaves_operational(self, wire):
        wire.enable()
        wire.send("205 02 00 08 64 00 00 00", "000 80 05", "000 01 05", "080")
        assert wire.statusword() & 0x6F == 0x27

    def test_an_sdo_transfer_does_not_survive_a_reset(self, wire):
        wire.sdo("40 08 10 00 00 00 00 00")
        wire.send("000 82 05")
        assert wire.sdo("60 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


class TestResets:
    """Reset node: all objects at their power-on values. Reset communication: 1000h to 1FFFh only."""

    @pytest.mark.parametrize(("command", "heartbeat", "option"), [("81", "00 00", "02 00"), ("82", "00 00", "00 00")])
    def test_values(self, wire, command, heartbeat, option):
        wire.set("2b 17 10 00 64 00 00 00", "2b 5e 60 00 00 00 00 00")
        assert wire.send(f"000 {command} 05") == ["705 00"]
        assert wire.sdo("40 17 10 00 00 00 00 00") == f"4b 17 10 00 {heartbeat} 00 00"
        assert wire.sdo("40 5e 60 00 00 00 00 00") == f"4b 5e 60 00 {option} 00 00"

    def test_pdos_are_those_of_power_on(self, wire):
        wire.set("23 00 18 01 85 01 00 c0", "2f 00 1a 00 00 00 00 00")
        wire.send("000 82 05", "000 01 05")
        assert wire.sync() == ["185 50 02 00 00 00 00 00 00", "285 00 00 00"]

    def test_power_after_reset_node(self, wire):
        wire.enable()
        wire.send("000 81 05")
        assert (wire.statusword(), wire.axis.motion) == (0x0250, "off")

    def test_power_after_reset_communication(self, wire):
        """The power state is not the communication's; what moves the axis is gone, so it holds."""
        wire.enable(10)
        wire.send("305 0f 00 0a 05 00", "080", "000 82 05")
        assert (wire.statusword(), wire.axis.motion) == (0x0237, "hold")

    def test_fault_and_its_code_after_reset_node(self, wire):
        wire.bench.device.fault(0x2310)
        wire.send("000 81 05")
        assert wire.statusword() == 0x0250
        assert wire.sdo("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 00 00 00 00"
        assert wire.sdo("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"
        assert wire.sdo("40 03 10 00 00 00 00 00") == "4f 03 10 00 00 00 00 00"
