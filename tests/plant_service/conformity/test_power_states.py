"""CiA 402-2, section "Device control": the finite state automaton, its commands and transitions, written by hand."""

from __future__ import annotations

import pytest

STATUS = {
    "Switch On Disabled": (0x4F, 0x40),
    "Ready To Switch On": (0x6F, 0x21),
    "Switched On": (0x6F, 0x23),
    "Operation Enabled": (0x6F, 0x27),
    "Quick Stop Active": (0x6F, 0x07),
    "Fault Reaction Active": (0x4F, 0x0F),
    "Fault": (0x4F, 0x08),
}
"""State → mask and value of the statusword. The eighth, Not Ready To Switch On, ends before the drive can speak."""

WAY = {
    "Switch On Disabled": (),
    "Ready To Switch On": (0x06,),
    "Switched On": (0x06, 0x07),
    "Operation Enabled": (0x06, 0x07, 0x0F),
    "Quick Stop Active": (0x06, 0x07, 0x0F, 0x02),
}

COMMANDS = {
    "shutdown": (0x0006, 0x000E, 0x0076, 0xFE06),
    "switch on": (0x0007, 0x0077, 0xFE07, 0x0107),
    "enable operation": (0x000F, 0x007F, 0xFE0F, 0x010F),
    "quick stop": (0x0002, 0x0003, 0x000A, 0x000B, 0x0072, 0xFF02),
    "disable voltage": (0x0000, 0x0001, 0x0004, 0x0005, 0x0008, 0x000D, 0x0070, 0xFF00),
    "fault reset": (0x0080, 0x008F, 0x0086, 0xFF80),
}
"""Command → controlwords that mean it: the plain one, then with bits that the standard's table marks X and with bits 4
to 6 and 8 to 15, which do not belong to commands. In Operation Enabled `switch on` is named "disable operation"."""

AUTOMATON = {
    ("Switch On Disabled", "shutdown"): ("2", "Ready To Switch On"),
    ("Ready To Switch On", "switch on"): ("3", "Switched On"),
    ("Ready To Switch On", "enable operation"): ("3+4", "Operation Enabled"),
    ("Switched On", "enable operation"): ("4", "Operation Enabled"),
    ("Operation Enabled", "switch on"): ("5", "Switched On"),
    ("Switched On", "shutdown"): ("6", "Ready To Switch On"),
    ("Ready To Switch On", "quick stop"): ("7", "Switch On Disabled"),
    ("Ready To Switch On", "disable voltage"): ("7", "Switch On Disabled"),
    ("Operation Enabled", "shutdown"): ("8", "Ready To Switch On"),
    ("Operation Enabled", "disable voltage"): ("9", "Switch On Disabled"),
    ("Switched On", "quick stop"): ("10", "Switch On Disabled"),
    ("Switched On", "disable voltage"): ("10", "Switch On Disabled"),
    ("Operation Enabled", "quick stop"): ("11", "Quick Stop Active"),
    ("Quick Stop Active", "disable voltage"): ("12", "Switch On Disabled"),
    ("Fault", "fault reset"): ("15", "Switch On Disabled"),
    ("Quick Stop Active", "enable operation"): ("16", "Operation Enabled"),
}
"""(state, command) → (number of the transition, next state); every other pair changes nothing. 0x605A is 6 here: with
0 to 4 transition 16 does not exist and 12 comes by itself."""

CASES = [
    pytest.param(state, word, *AUTOMATON.get((state, command), ("none", state)), id=f"{state}-{command}-{word:04x}h")
    for state in STATUS
    for command, words in COMMANDS.items()
    for word in words
]


def bring(wire, state: str) -> None:
    if state in WAY:
        wire.control(*WAY[state])
    elif state == "Fault":
        wire.bench.device.fault(0x2310)
    else:
        wire.control(0x06, 0x07, 0x0F)
        wire.move()
        wire.bench.device.fault(0x2310)
    mask, value = STATUS[state]
    assert wire.statusword() & mask == value


def test_the_table_has_every_transition_that_a_controlword_makes():
    numbers = sorted(int(part) for number, _ in AUTOMATON.values() for part in number.split("+"))
    assert sorted(set(numbers)) == [2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 15, 16]
    assert len(CASES) == 7 * 30


@pytest.mark.parametrize(("state", "word", "transition", "after"), CASES)
def test_controlword_by_sdo(wire, state, word, transition, after):
    bring(wire, state)
    wire.control(word)
    mask, value = STATUS[after]
    assert wire.statusword() & mask == value, f"transition {transition}"


@pytest.mark.parametrize(("state", "word", "transition", "after"), [case for case in CASES if case.values[0] in WAY])
def test_controlword_by_pdo(wire, state, word, transition, after):
    wire.send("000 01 05")
    for previous in WAY[state]:
        wire.send(f"205 {previous:02x} 00 08 00 00 00 00", "080")
    answer = wire.send(f"205 {word & 0xFF:02x} {word >> 8:02x} 08 00 00 00 00", "080")[0]
    assert answer.startswith("185 ")
    low, high = bytes.fromhex(answer[4:9])
    mask, value = STATUS[after]
    assert (low | high << 8) & mask == value, f"transition {transition}"


@pytest.mark.parametrize("reset", [None, "000 81 05", "000 81 00"], ids=["power on", "reset node", "reset all nodes"])
def test_transitions_0_and_1_come_by_themselves(wire, reset):
    if reset:
        wire.enable()
        assert wire.send(reset) == ["705 00"]
    assert wire.statusword() & 0x4F == 0x40


@pytest.mark.parametrize("state", ["Switch On Disabled", "Ready To Switch On", "Switched On"])
def test_transitions_13_and_14_without_power(wire, state):
    bring(wire, state)
    wire.bench.device.fault(0x2310)
    assert wire.statusword() & 0x4F == 0x08
    assert wire.axis.motion == "off"


@pytest.mark.parametrize("state", ["Operation Enabled", "Quick Stop Active"])
def test_transition_13_then_14_once_the_axis_stands(wire, state):
    bring(wire, state)
    wire.move()
    wire.bench.device.fault(0x2310)
    assert wire.statusword() & 0x4F == 0x0F
    assert wire.axis.motion == "hold"
    wire.wait(200)
    assert wire.statusword() & 0x4F == 0x08
    assert wire.axis.motion == "off"


@pytest.mark.parametrize("state", ["Fault Reaction Active", "Fault"])
def test_a_second_fault_changes_nothing(wire, state):
    bring(wire, state)
    before = wire.statusword()
    wire.bench.device.fault(0x7305)
    assert wire.statusword() == before


class TestFaultResetIsAnEdge:
    """Transition 15: bit 7 goes from 0 to 1."""

    def test_bit_7_that_was_high_before_the_fault_resets_nothing(self, wire):
        wire.control(0x80)
        wire.bench.device.fault(0x2310)
        wire.control(0x80, 0x86, 0x8F)
        assert wire.statusword() & 0x4F == 0x08
        wire.control(0x00, 0x80)
        assert wire.statusword() & 0x4F == 0x40

    def test_held_high_it_commands_nothing_more(self, wire):
        wire.bench.device.fault(0x2310)
        wire.control(0x80, 0x86)
        assert wire.statusword() & 0x4F == 0x40
        wire.control(0x06)
        assert wire.statusword() & 0x6F == 0x21

    def test_by_pdo_every_cycle_it_acts_once(self, wire):
        wire.send("000 01 05")
        wire.bench.device.fault(0x2310)
        frame = "205 80 00 08 00 00 00 00"
        # the EMCY of the fault and of its reset, Switch On Disabled in TPDO1, mode 8 and no error in TPDO2
        assert wire.send(frame, "080") == [
            "085 10 23 03 00 00 00 00 00",
            "085 00 00 00 00 00 00 00 00",
            "185 50 02 00 00 00 00 00 00",
            "285 08 00 00",
        ]
        wire.bench.device.fault(0x2310)
        for _ in range(3):
            assert "185 18 02 00 00 00 00 00 00" in wire.send(frame, "080")


class TestCommandsAreLevels:
    """All bits but bit 7 count by their level: a word that is sent every cycle acts as soon as the state allows it."""

    def test_enable_that_came_during_the_ramp_of_disable_operation(self, wire):
        wire.enable()
        wire.move()
        wire.control(0x07)
        wire.send("205 0f 00 08 00 00 00 00", "080")
        assert wire.statusword() & 0x6F == 0x27  # still on its ramp
        wire.wait(200)
        assert wire.statusword() & 0x6F == 0x23
        assert wire.axis.motion == "off"
        wire.send("205 0f 00 08 00 00 00 00", "080")
        assert wire.statusword() & 0x6F == 0x27

    def test_shutdown_held_while_the_drive_lost_its_power_by_6007(self, wire):
        wire.set("2b 07 60 00 02 00 00 00")
        wire.send("000 01 05")
        wire.control(0x06)
        wire.send("000 80 05")
        assert wire.statusword() & 0x4F == 0x40
        wire.control(0x06)
        assert wire.statusword() & 0x6F == 0x21
