"""CiA 402 on the drive's side: power state machine, modes, set-points, stops, and the hold of a drive left alone.

The axis gives torque in Operation Enabled only, and while Quick Stop Active or Fault Reaction Active bring it to rest;
in every other state the power stage is off and the brake holds.

A drive follows a set-point only if it arrived after the drive was enabled (or after the mode changed): before that it
holds where it stands. `lose_command` is what the watchdogs call: the axis holds by its own means, the mode display
becomes 8, the state stays Operation Enabled, and every set-point is ignored until the master takes the drive out of
Operation Enabled and back, or resets its communication.
"""

from __future__ import annotations

from typing import Any, Final

from hal.profile.cia402 import (
    FAULT_RESET_BIT,
    HALT_BIT,
    DisableOperationOption,
    FaultReactionOption,
    OperationMode,
    QuickStopOption,
    StatusBit,
    encode_statusword,
    next_state,
)
from hal.profile.objects import (
    CONTROLWORD,
    DISABLE_OPERATION_OPTION,
    FAULT_REACTION_OPTION,
    FOLLOWING_ERROR_WINDOW,
    MAX_TORQUE,
    MODE,
    MODE_DISPLAY,
    QUICK_STOP_OPTION,
    SHUTDOWN_OPTION,
    SOFTWARE_POSITION_LIMIT,
    TARGET_POSITION,
    TARGET_TORQUE,
    TORQUE_ACTUAL,
    VELOCITY_ACTUAL,
)
from plant_service.axis import Axis
from plant_service.object_dictionary import key_of
from schemas.messages import DriveState

STANDSTILL_COUNTS: Final = 2
"""An axis that moved no more than this between two ticks stands."""
LONGEST_STOP_NS: Final = 1_000_000_000
"""A ramp ends after this even if the axis still moves: the brake takes over."""
WINDOW_OFF: Final = (0, 0xFFFF_FFFF)

K_CONTROLWORD, K_MODE, K_DISPLAY = key_of(CONTROLWORD), key_of(MODE), key_of(MODE_DISPLAY)
K_POSITION, K_TORQUE, K_MAX_TORQUE = key_of(TARGET_POSITION), key_of(TARGET_TORQUE), key_of(MAX_TORQUE)
K_TORQUE_ACTUAL, K_WINDOW = key_of(TORQUE_ACTUAL), key_of(FOLLOWING_ERROR_WINDOW)
K_VELOCITY = key_of(VELOCITY_ACTUAL)
K_LOWEST, K_HIGHEST = key_of(SOFTWARE_POSITION_LIMIT, 1), key_of(SOFTWARE_POSITION_LIMIT, 2)
STAY_OPTIONS: Final = (5, 6, 7, 8)

_S = DriveState
STATUS_OF_STATE: Final = {state: int(encode_statusword(state, StatusBit.VOLTAGE_ENABLED)) for state in DriveState}
FOLLOWS, LIMITED, WARNING = (
    int(bit) for bit in (StatusBit.FOLLOWS_COMMAND, StatusBit.INTERNAL_LIMIT, StatusBit.WARNING)
)
OPERATION_ENABLED: Final = DriveState.OPERATION_ENABLED
CST: Final = int(OperationMode.CST)
STOPPING: Final = (_S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE)


class Power:
    """State machine of one drive over its object values and its axis; knows nothing of the bus."""

    def __init__(self, values: dict[int, Any], axis: Axis, supported_modes: int) -> None:
        self._values = values
        self._axis = axis
        self._supported = supported_modes
        self.state = _S.SWITCH_ON_DISABLED
        self.mode = 0
        self.left_alone = False
        """The watchdog latch."""
        self.halted = False
        self._word = 0
        self._fresh = False
        """A set-point of the present mode arrived since it may be followed."""
        self._follows = False
        self._limited = False
        self._ramp_to: DriveState | None = None
        """State to take with the power off once the axis stands."""
        self._ramp_end_ns: int | None = None
        self._counts = axis.position_counts()
        self._counts_ns = 0
        self._moved = 0
        axis.power_off()

    def reset(self) -> None:
        """Node reset: power off, as after switching on."""
        self._switch_off(_S.SWITCH_ON_DISABLED)
        self.mode = self._values[K_DISPLAY] = 0
        self._word = 0
        self.release()

    def release(self) -> None:
        """Communication reset: what was commanded is void, what the watchdogs latched is free."""
        self.left_alone = False
        self._fresh = False
        if self.state is _S.OPERATION_ENABLED:
            self._hold()

    def supports(self, mode: int) -> bool:
        """Whether 0x6502 names a mode; 0 (no change) is always allowed."""
        return mode == 0 or (0 < mode <= 32 and bool(self._supported >> (mode - 1) & 1))

    @property
    def following(self) -> bool:
        """A set-point of the master acts now."""
        return self._follows

    def receive(self, keys: tuple[int, ...], *, can_reset: bool = True) -> bool:
        """Act on objects that were just written, all of them: mode first, then controlword, then set-points.

        Returns:
            Whether a fault was reset.

        """
        values = self._values
        if self._fresh and values[K_CONTROLWORD] == self._word and values[K_MODE] == self.mode:
            return False  # nothing but a newer set-point
        mode_changed = K_MODE in keys and values[K_MODE] != self.mode and self._change_mode(values[K_MODE])
        before = self.state
        reset = False
        if K_CONTROLWORD in keys:
            word = values[K_CONTROLWORD]
            if word != self._word:
                reset = self._command(word, can_reset=can_reset)
        if before is _S.OPERATION_ENABLED and not self.left_alone:
            wanted = K_POSITION if self.mode == OperationMode.CSP else K_TORQUE
            if wanted in keys:
                self._fresh = True
        if mode_changed and not self._fresh and self.state is _S.OPERATION_ENABLED and self._ramp_to is None:
            self._hold()
        return reset

    def latch(self) -> bool:
        """Hand the set-point of the present mode to the axis. Returns whether the following error is too large."""
        if (
            not self._fresh
            or self.state is not OPERATION_ENABLED
            or self.left_alone
            or self.halted
            or self._ramp_to is not None
        ):
            self._follows = self._limited = False
            return False
        values = self._values
        limit = values[K_MAX_TORQUE]
        if self.mode == CST:
            torque = values[K_TORQUE]
            self._axis.follow_torque(torque, limit)
            self._limited = abs(torque) > limit
        else:
            target = values[K_POSITION]
            window = values[K_WINDOW]
            if window not in WINDOW_OFF and self._follows and abs(target - self._axis.position_counts()) > window:
                return True
            allowed = min(max(target, values[K_LOWEST]), values[K_HIGHEST])
            self._axis.follow_position(allowed, limit)
            self._limited = allowed != target or abs(values[K_TORQUE_ACTUAL]) >= limit
        self._follows = True
        return False

    def lose_command(self) -> None:
        """Nobody commands any more: hold by the drive's own means until a fresh start (see the module)."""
        if self.state is _S.OPERATION_ENABLED and not self.left_alone:
            self.left_alone = True
            self.mode = self._values[K_DISPLAY] = int(OperationMode.CSP)
            self._hold()

    def quick_stop(self, now_ns: int) -> None:
        """Start the quick stop of option 0x605A, as by the controlword."""
        if self.state is _S.OPERATION_ENABLED:
            self._word = 0
            self._quick_stop()
            self.tick(now_ns)

    def disable_voltage(self) -> None:
        """Power off at once."""
        if self.state not in (_S.FAULT, _S.FAULT_REACTION_ACTIVE, _S.NOT_READY_TO_SWITCH_ON):
            self._switch_off(_S.SWITCH_ON_DISABLED)

    def fault(self) -> None:
        """Transitions 13 and 14, by way of the reaction 0x605E if the axis is under power."""
        if self.state in (_S.FAULT, _S.FAULT_REACTION_ACTIVE):
            return
        powered = self.state in (_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE)
        option = self._values[key_of(FAULT_REACTION_OPTION)]
        if powered and option != FaultReactionOption.DISABLE:
            self.state = _S.FAULT_REACTION_ACTIVE
            self._ramp(_S.FAULT)
        else:
            self._switch_off(_S.FAULT)

    def tick(self, now_ns: int) -> None:
        """Time has passed: measure the speed, end a ramp whose axis stands."""
        counts = self._axis.position_counts()
        if now_ns > self._counts_ns:
            self._moved = counts - self._counts
            velocity = self._moved * 1_000_000_000 // (now_ns - self._counts_ns)
            self._values[K_VELOCITY] = velocity if abs(velocity) < 2**31 else 0
            self._counts, self._counts_ns = counts, now_ns
        if self._ramp_to is None:
            return
        if self._ramp_end_ns is None:
            self._ramp_end_ns = now_ns + LONGEST_STOP_NS
        if abs(self._moved) <= STANDSTILL_COUNTS or now_ns >= self._ramp_end_ns:
            self._switch_off(self._ramp_to)

    def statusword(self) -> int:
        """Object 0x6041, without the remote bit, which belongs to the communication."""
        word = STATUS_OF_STATE[self.state]
        if self._follows:
            word |= FOLLOWS
        if self._limited:
            word |= LIMITED
        if self.left_alone:
            word |= WARNING
        return word

    def _change_mode(self, mode: int) -> bool:
        if mode == 0 or not self.supports(mode) or self.left_alone:
            return False
        self.mode = self._values[K_DISPLAY] = mode
        self._fresh = False
        return True

    def _command(self, word: int, *, can_reset: bool) -> bool:
        edge = word & FAULT_RESET_BIT and not self._word & FAULT_RESET_BIT
        if edge and self.state is _S.FAULT and not can_reset:
            self._word = word
            return False
        option = self._values[key_of(QUICK_STOP_OPTION)]
        target = next_state(self.state, word, self._word, leave_quick_stop=option in STAY_OPTIONS)
        before, self._word = self.state, word
        if target is before:
            halt = bool(word & HALT_BIT)
            if halt and not self.halted and before is _S.OPERATION_ENABLED:
                self._hold()
            self.halted = halt
            return False
        if target is _S.OPERATION_ENABLED:
            self._enable(halt=bool(word & HALT_BIT))
        elif target is _S.QUICK_STOP_ACTIVE:
            self._quick_stop()
        elif before is _S.OPERATION_ENABLED and target is not _S.SWITCH_ON_DISABLED:
            ramp = DISABLE_OPERATION_OPTION if target is _S.SWITCHED_ON else SHUTDOWN_OPTION
            if self._values[key_of(ramp)] == DisableOperationOption.DISABLE:
                self._switch_off(target)
            else:
                self._ramp(target)
        else:
            self._switch_off(target)
        return before is _S.FAULT

    def _enable(self, *, halt: bool) -> None:
        self.state = _S.OPERATION_ENABLED
        self.left_alone = False
        self.halted = halt
        self._fresh = False
        self._ramp_to = None
        self._hold()

    def _quick_stop(self) -> None:
        option = self._values[key_of(QUICK_STOP_OPTION)]
        self.left_alone = False
        if option == QuickStopOption.DISABLE:
            self._switch_off(_S.SWITCH_ON_DISABLED)
            return
        self.state = _S.QUICK_STOP_ACTIVE
        if option in STAY_OPTIONS:
            self._ramp_to = None
            self._hold()
        else:
            self._ramp(_S.SWITCH_ON_DISABLED)

    def _ramp(self, target: DriveState) -> None:
        self._hold()
        self._ramp_to, self._ramp_end_ns = target, None
        at_rest = abs(self._moved) <= STANDSTILL_COUNTS
        if at_rest and self.state not in STOPPING:
            self._switch_off(target)

    def _hold(self) -> None:
        self._follows = self._limited = False
        self._axis.hold()

    def _switch_off(self, state: DriveState) -> None:
        self.state = state
        self._axis.power_off()
        self.left_alone = self._fresh = self._follows = self._limited = self.halted = False
        self._ramp_to = self._ramp_end_ns = None
