from __future__ import annotations

import numpy as np
import pytest

from hal.errors import ProfileError
from hal.profile.cia402 import (
    STATUSWORD_OF_STATE,
    SUPPORTED_MODES,
    Controlword,
    OperationMode,
    StatusBit,
    UndefinedStatuswordError,
    decode_state,
    decode_states,
    encode_statusword,
    next_controlword,
    next_state,
    supported_modes_bit,
)
from schemas.messages import DriveState as S

# CiA 402-2, table "state coding": xxxx xxxx x0xx 0000 and so on, written as patterns.
PATTERNS = {
    S.NOT_READY_TO_SWITCH_ON: "x0xx0000",
    S.SWITCH_ON_DISABLED: "x1xx0000",
    S.READY_TO_SWITCH_ON: "x01x0001",
    S.SWITCHED_ON: "x01x0011",
    S.OPERATION_ENABLED: "x01x0111",
    S.QUICK_STOP_ACTIVE: "x00x0111",
    S.FAULT_REACTION_ACTIVE: "x0xx1111",
    S.FAULT: "x0xx1000",
}


def matches(word: int, pattern: str) -> bool:
    return all(p in ("x", b) for p, b in zip(pattern, f"{word & 0xFF:08b}", strict=True))


@pytest.mark.parametrize("word", range(256))
def test_every_statusword_follows_the_standards_patterns(word: int) -> None:
    states = [state for state, pattern in PATTERNS.items() if matches(word, pattern)]
    for high in (0, 0x1200):
        if states:
            assert [decode_state(word | high)] == states
        else:
            with pytest.raises(UndefinedStatuswordError):
                decode_state(word | high)


def test_vectorised_decoding_agrees_and_names_the_undefined() -> None:
    words = np.array([0x0627, 0x0208, 0x0250, 0x1237], dtype=np.uint16)
    assert decode_states(words).tolist() == [S.OPERATION_ENABLED, S.FAULT, S.SWITCH_ON_DISABLED, S.OPERATION_ENABLED]
    with pytest.raises(UndefinedStatuswordError, match="element 1: statusword 0x0001"):
        decode_states(np.array([0x0627, 0x0001]))


@pytest.mark.parametrize("state", S)
def test_encoding_is_decoded_back_whatever_the_other_bits(state: S) -> None:
    assert (
        decode_state(encode_statusword(state, StatusBit.VOLTAGE_ENABLED | StatusBit.REMOTE | StatusBit.WARNING))
        is state
    )
    assert set(STATUSWORD_OF_STATE) == set(S)


# Rows: state; columns: shutdown, switch on, enable, disable voltage, quick stop, fault reset (rising edge).
COMMANDS = (0x06, 0x07, 0x0F, 0x00, 0x02, 0x80)
TABLE = {
    S.NOT_READY_TO_SWITCH_ON: "......",
    S.SWITCH_ON_DISABLED: "R.....",
    S.READY_TO_SWITCH_ON: ".SEDD.",
    S.SWITCHED_ON: "R.EDD.",
    S.OPERATION_ENABLED: "RS.DQ.",
    S.QUICK_STOP_ACTIVE: "...D..",
    S.FAULT_REACTION_ACTIVE: "......",
    S.FAULT: ".....D",
}
LETTERS = {
    "R": S.READY_TO_SWITCH_ON,
    "S": S.SWITCHED_ON,
    "E": S.OPERATION_ENABLED,
    "D": S.SWITCH_ON_DISABLED,
    "Q": S.QUICK_STOP_ACTIVE,
}


@pytest.mark.parametrize("state", S)
def test_the_whole_state_machine(state: S) -> None:
    for command, letter in zip(COMMANDS, TABLE[state], strict=True):
        assert next_state(state, command, 0x00) is LETTERS.get(letter, state), (state, hex(command))
        # Bits that belong to no command, such as the operation mode's 4 to 6 and halt, change nothing.
        assert next_state(state, command | 0x170, 0x00) is LETTERS.get(letter, state)


def test_fault_reset_needs_the_rising_edge() -> None:
    assert next_state(S.FAULT, 0x80, 0x80) is S.FAULT
    assert next_state(S.FAULT, 0x8F, 0x0F) is S.SWITCH_ON_DISABLED
    assert next_state(S.SWITCH_ON_DISABLED, 0x86, 0x80) is S.SWITCH_ON_DISABLED


def test_transition_16_only_where_the_option_stays_in_quick_stop() -> None:
    assert next_state(S.QUICK_STOP_ACTIVE, 0x0F, 0x02) is S.QUICK_STOP_ACTIVE
    assert next_state(S.QUICK_STOP_ACTIVE, 0x0F, 0x02, leave_quick_stop=True) is S.OPERATION_ENABLED


COMMANDED = (S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED)


@pytest.mark.parametrize("target", COMMANDED)
@pytest.mark.parametrize("start", [*COMMANDED, S.QUICK_STOP_ACTIVE, S.FAULT])
def test_next_controlword_leads_from_anywhere_to_the_target_and_stays(start: S, target: S) -> None:
    state, previous = start, 0x00
    for _ in range(6):
        word = next_controlword(state, target)
        state, previous = next_state(state, word, previous), word
    assert state is target
    assert next_state(state, next_controlword(state, target), previous) is target


def test_quick_stop_is_reached_from_below_and_kept() -> None:
    assert next_controlword(S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE) == 0x02
    assert next_controlword(S.QUICK_STOP_ACTIVE, S.QUICK_STOP_ACTIVE) == 0x02
    assert next_controlword(S.SWITCHED_ON, S.QUICK_STOP_ACTIVE) == 0x0F


def test_states_of_the_drive_alone_cannot_be_asked_for() -> None:
    assert next_controlword(S.FAULT_REACTION_ACTIVE, S.OPERATION_ENABLED) == Controlword.DISABLE_VOLTAGE
    with pytest.raises(ProfileError, match="FAULT cannot be commanded"):
        next_controlword(S.SWITCHED_ON, S.FAULT)


def test_supported_modes_bits() -> None:
    assert [supported_modes_bit(mode) for mode in OperationMode] == [0, 0x80, 0x100, 0x200]
    assert SUPPORTED_MODES == {"position_pd": 0x80, "torque": 0x280, "servo": 0x80}
