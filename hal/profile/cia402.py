"""The power state machine, modes and codes of CiA 402 (IEC 61800-7-201) as tables and pure functions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import ProfileError
from schemas.messages import DriveState


class UndefinedStatuswordError(ProfileError):
    """A statusword that no state of the standard's table matches."""


STATUSWORD_OF_STATE: Final[dict[DriveState, tuple[int, int]]] = {
    DriveState.NOT_READY_TO_SWITCH_ON: (0x4F, 0x00),
    DriveState.SWITCH_ON_DISABLED: (0x4F, 0x40),
    DriveState.READY_TO_SWITCH_ON: (0x6F, 0x21),
    DriveState.SWITCHED_ON: (0x6F, 0x23),
    DriveState.OPERATION_ENABLED: (0x6F, 0x27),
    DriveState.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    DriveState.FAULT_REACTION_ACTIVE: (0x4F, 0x0F),
    DriveState.FAULT: (0x4F, 0x08),
}
"""State → (mask, value) of the statusword 0x6041."""


class StatusBit(IntFlag):
    """Bits of the statusword beside the state."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    FOLLOWS_COMMAND = 1 << 12
    """In the cyclic synchronous modes: the drive follows the command value."""
    FOLLOWING_ERROR = 1 << 13
    """In cyclic synchronous position mode."""


STATE_BITS: Final = 0x6F
UNDEFINED: Final = -1

STATE_TABLE: Final = np.full(STATE_BITS + 1, UNDEFINED, dtype=np.int8)
"""`STATE_TABLE[statusword & STATE_BITS]` is the state's number, or `UNDEFINED`."""
for _word in range(STATE_BITS + 1):
    for _state, (_mask, _value) in STATUSWORD_OF_STATE.items():
        if _word & _mask == _value:
            STATE_TABLE[_word] = int(_state)
STATE_TABLE.flags.writeable = False


def decode_state(statusword: int) -> DriveState:
    """State of one statusword.

    Raises:
        UndefinedStatuswordError: no state has these bits.
    """
    state = int(STATE_TABLE[statusword & STATE_BITS])
    if state == UNDEFINED:
        raise UndefinedStatuswordError(f"statusword {statusword:#06x} is no state of CiA 402")
    return DriveState(state)


def decode_states(statuswords: npt.NDArray[np.integer]) -> npt.NDArray[np.int8]:
    """States of many statuswords as `DriveState` numbers, the same shape.

    Raises:
        UndefinedStatuswordError: names the first element that is no state.
    """
    states: npt.NDArray[np.int8] = STATE_TABLE[statuswords & STATE_BITS]
    if (states == UNDEFINED).any():
        first = int(np.flatnonzero(states == UNDEFINED)[0])
        word = int(statuswords.flat[first])
        raise UndefinedStatuswordError(f"element {first}: statusword {word:#06x} is no state of CiA 402")
    return states


def encode_statusword(state: DriveState, bits: int = 0) -> int:
    """Statusword of a state, with further `StatusBit`s set."""
    return STATUSWORD_OF_STATE[state][1] | bits


class Controlword(IntEnum):
    """Commands of the controlword 0x6040."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    """Also "disable operation" when sent in Operation Enabled."""
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80
    """Acts on the rising edge of bit 7."""


HALT_BIT: Final = 0x100
FAULT_RESET_BIT: Final = 0x80

COMMAND_MASK: Final[dict[Controlword, int]] = {
    Controlword.DISABLE_VOLTAGE: 0x82,
    Controlword.QUICK_STOP: 0x86,
    Controlword.SHUTDOWN: 0x87,
    Controlword.SWITCH_ON: 0x8F,
    Controlword.ENABLE_OPERATION: 0x8F,
}
"""Bits of the controlword that make up each command; the others do not matter."""

_S = DriveState
_C = Controlword


@dataclass(frozen=True, slots=True)
class Transition:
    """One row of the state machine: what a command does in a state, with the standard's number."""

    number: str
    source: DriveState
    command: Controlword
    target: DriveState


TRANSITIONS: Final[tuple[Transition, ...]] = (
    Transition("2", _S.SWITCH_ON_DISABLED, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition("3", _S.READY_TO_SWITCH_ON, _C.SWITCH_ON, _S.SWITCHED_ON),
    Transition("3+4", _S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    Transition("4", _S.SWITCHED_ON, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    Transition("5", _S.OPERATION_ENABLED, _C.SWITCH_ON, _S.SWITCHED_ON),
    Transition("6", _S.SWITCHED_ON, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition("7", _S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition("7", _S.READY_TO_SWITCH_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition("8", _S.OPERATION_ENABLED, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition("9", _S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition("10", _S.SWITCHED_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition("10", _S.SWITCHED_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition("11", _S.OPERATION_ENABLED, _C.QUICK_STOP, _S.QUICK_STOP_ACTIVE),
    Transition("12", _S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition("15", _S.FAULT, _C.FAULT_RESET, _S.SWITCH_ON_DISABLED),
    Transition("16", _S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
)
"""All transitions that a master commands; 0, 1, 13, 14 are the drive's own."""

_TARGET: Final = {(row.source, row.command): row for row in TRANSITIONS}


def command_of(controlword: int, previous_controlword: int) -> Controlword | None:
    """Command that a controlword means, or None: bit 7 high without an edge commands nothing."""
    if controlword & FAULT_RESET_BIT:
        return None if previous_controlword & FAULT_RESET_BIT else Controlword.FAULT_RESET
    for command, mask in COMMAND_MASK.items():
        if controlword & mask == command & mask:
            return command
    return None


def next_state(
    state: DriveState, controlword: int, previous_controlword: int, *, leave_quick_stop: bool = False
) -> DriveState:
    """State after a drive received a controlword; a command with no row in `TRANSITIONS` changes nothing.

    Args:
        state: state before.
        controlword: received 0x6040.
        previous_controlword: the one before it, for the edge of bit 7.
        leave_quick_stop: transition 16 exists (option code 0x605A of 5 to 8).
    """
    command = command_of(controlword, previous_controlword)
    row = None if command is None else _TARGET.get((state, command))
    if row is None or (row.number == "16" and not leave_quick_stop):
        return state
    return row.target


_WAY_UP: Final = {
    _S.SWITCH_ON_DISABLED: _C.SHUTDOWN,
    _S.READY_TO_SWITCH_ON: _C.SWITCH_ON,
    _S.SWITCHED_ON: _C.ENABLE_OPERATION,
    _S.OPERATION_ENABLED: _C.ENABLE_OPERATION,
}
_LEVEL: Final = {
    _S.SWITCH_ON_DISABLED: 0,
    _S.READY_TO_SWITCH_ON: 1,
    _S.SWITCHED_ON: 2,
    _S.OPERATION_ENABLED: 3,
}
_ARRIVE: Final = (_C.DISABLE_VOLTAGE, _C.SHUTDOWN, _C.SWITCH_ON, _C.ENABLE_OPERATION)
"""Command that leads to, and keeps, each level from above."""


def next_controlword(state: DriveState, target: DriveState) -> int:
    """Controlword for one step from a state towards a target, or that stays there.

    From Fault the step is the reset: whoever may not reset faults must not ask. It needs bit 7 low in the controlword
    before. In the states a drive leaves by itself the answer is `DISABLE_VOLTAGE`, which does nothing there but in
    Quick Stop Active, whose ramp it ends.

    Args:
        state: what the drive reports.
        target: Switch On Disabled, Ready To Switch On, Switched On, Operation Enabled or Quick Stop Active.

    Raises:
        ProfileError: the target is not a state that a master can command.
    """
    if target is _S.QUICK_STOP_ACTIVE:
        if state in (_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE):
            return _C.QUICK_STOP
        target = _S.OPERATION_ENABLED
    if target not in _LEVEL:
        raise ProfileError(f"{target.name} cannot be commanded; ask for one of {', '.join(s.name for s in _LEVEL)}")
    if state is _S.FAULT:
        return _C.FAULT_RESET
    if state not in _LEVEL:
        return _C.DISABLE_VOLTAGE
    if _LEVEL[state] >= _LEVEL[target]:
        return _ARRIVE[_LEVEL[target]]
    return _WAY_UP[state]


class OperationMode(IntEnum):
    """Modes of operation, objects 0x6060 and 0x6061."""

    NONE = 0
    CSP = 8
    """Cyclic synchronous position."""
    CSV = 9
    """Cyclic synchronous velocity."""
    CST = 10
    """Cyclic synchronous torque."""


def supported_modes_bit(mode: OperationMode) -> int:
    """Bit of a mode in object 0x6502: bit n − 1 stands for mode n."""
    return 0 if mode is OperationMode.NONE else 1 << (mode - 1)


SUPPORTED_MODES: Final[dict[str, int]] = {
    "position_pd": supported_modes_bit(OperationMode.CSP),
    "torque": supported_modes_bit(OperationMode.CSP) | supported_modes_bit(OperationMode.CST),
    "servo": supported_modes_bit(OperationMode.CSP),
}
"""Object 0x6502 of each kind of drive."""


class AbortConnectionOption(IntEnum):
    """Object 0x6007: what a drive does on its own when the master is gone."""

    NO_ACTION = 0
    FAULT_SIGNAL = 1
    DISABLE_VOLTAGE = 2
    QUICK_STOP = 3


class EmergencyCode(IntEnum):
    """Error codes of EMCY messages and object 0x603F (CiA 301 table 26, CiA 402)."""

    NO_ERROR = 0x0000
    GENERIC = 0x1000
    CONTINUOUS_OVERCURRENT = 0x2310
    DRIVE_TEMPERATURE = 0x4310
    INCREMENTAL_SENSOR_FAULT = 0x7305
    POSITION_SENSOR_FAULT = 0x7320
    COMMUNICATION = 0x8100
    """Generic; the simulated drives report a missing SYNC by it."""
    CAN_OVERRUN = 0x8110
    CAN_PASSIVE = 0x8120
    HEARTBEAT_LOST = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    PDO_LENGTH = 0x8210
    """Not processed: shorter than its mapping."""
    PDO_LENGTH_EXCEEDED = 0x8220
    """Longer than its mapping: the mapped bytes are used."""
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250
    FOLLOWING_ERROR = 0x8611


class ErrorRegister(IntFlag):
    """Object 0x1001, CiA 301 table 25."""

    GENERIC = 1 << 0
    CURRENT = 1 << 1
    VOLTAGE = 1 << 2
    TEMPERATURE = 1 << 3
    COMMUNICATION = 1 << 4
    PROFILE = 1 << 5
    MANUFACTURER = 1 << 7
