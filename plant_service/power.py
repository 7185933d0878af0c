"""CiA 402 on the drive's side: power state machine, modes, set-points, stops, and the hold of a drive left alone.

The controlword counts by its level: a word sent again in another state is taken again; only bit 7 counts by its edge.
All ramps of the option codes are one and the same: the firmware brings the axis to rest as fast as its torque allows.

The axis gives torque in Operation Enabled only, and while Quick Stop Active or Fault Reaction Active bring it to rest;
in every other state the power stage is off and the brake holds.

A drive follows a set-point only if it arrived after the drive was enabled (or after the mode changed): before that it
holds where it stands. `lose_command` is what the watchdogs call: the axis holds by its own means, the mode display
becomes 8, the state stays Operation Enabled, and every set-point is ignored until the master takes the drive out of
Operation Enabled and back, or resets its communication.
"""

from __future__ import annotations

from typing import Any, Final

from hal.profile import objects
from hal.profile.cia402 import HALT_BIT, OperationMode, StatusBit, encode_statusword, next_state
from hal.profile.stop_options import DisableOperationOption, FaultReactionOption, QuickStopOption
from plant_service.axis import Axis
from plant_service.object_dictionary import key_of
from schemas.messages import DriveState

STANDSTILL_COUNTS: Final = 2
"""An axis that moved no more than this between two ticks stands."""
LONGEST_STOP_NS: Final = 1_000_000_000
"""A ramp ends after this even if the axis still moves: the brake takes over."""
WINDOW_OFF: Final = (0, 0xFFFF_FFFF)

K_CONTROLWORD, K_MODE, K_DISPLAY = map(key_of, (objects.CONTROLWORD, objects.MODE, objects.MODE_DISPLAY))
K_POSITION, K_TORQUE, K_MAX_TORQUE = map(key_of, (objects.TARGET_POSITION, objects.TARGET_TORQUE, objects.MAX_TORQUE))
K_VELOCITY, K_TORQUE_ACTUAL = key_of(objects.VELOCITY_ACTUAL), key_of(objects.TORQUE_ACTUAL)
K_WINDOW = key_of(objects.FOLLOWING_ERROR_WINDOW)
K_LOWEST, K_HIGHEST = (key_of(objects.SOFTWARE_POSITION_LIMIT, subindex) for subindex in (1, 2))
K_QUICK_STOP, K_FAULT_REACTION = key_of(objects.QUICK_STOP_OPTION), key_of(objects.FAULT_REACTION_OPTION)
K_SHUTDOWN, K_DISABLE_OPERATION = key_of(objects.SHUTDOWN_OPTION), key_of(objects.DISABLE_OPERATION_OPTION)
STAY_OPTIONS: Final = (5, 6, 7)
"""Values of 0x605A with which the drive stays in Quick Stop Active."""

_S = DriveState
STATUS_OF_STATE: Final = {
    state: int(encode_statusword(state, StatusBit.VOLTAGE_ENABLED | StatusBit.REMOTE)) for state in DriveState
}
"""The power supply is always on, and the controlword is always obeyed, by SDO as well as by PDO."""
FOLLOWS, LIMITED = int(StatusBit.FOLLOWS_COMMAND), int(StatusBit.INTERNAL_LIMIT)
WARNING, REACHED, LAGS = map(int, (StatusBit.WARNING, StatusBit.TARGET_REACHED, StatusBit.FOLLOWING_ERROR))
OPERATION_ENABLED: Final = DriveState.OPERATION_ENABLED
CST: Final = int(OperationMode.CST)
SET_POINT: Final = {int(OperationMode.CSP): K_POSITION, CST: K_TORQUE}
"""Object that commands the axis in each mode."""
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
        self._judged_in = self.state
        """State that `_word` led to, or stayed in."""
        self._fresh = False
        """A set-point of the present mode arrived since it may be followed."""
        self._follows = False
        self._limited = False
        self._following_error = False
        self._ramp_to: DriveState | None = None
        """State to take with the power off once the axis stands."""
        self._ramp_end_ns: int | None = None
        self._counts = axis.position_counts()
        self._counts_ns = self._moved = 0
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
            if word != self._word or self.state is not self._judged_in:
                reset = self._command(word, can_reset=can_reset)
                self._judged_in = self.state
        if before is _S.OPERATION_ENABLED and not self.left_alone and SET_POINT.get(self.mode) in keys:
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
                self._following_error = True
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
        option = self._values[K_FAULT_REACTION]
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
        """Object 0x6041.

        Bit 10 says that the axis stands after a halt or a quick stop that stays; in modes 8 and 10 it has no other use.
        """
        word = STATUS_OF_STATE[self.state]
        if self._follows:
            return word | FOLLOWS | LIMITED if self._limited else word | FOLLOWS
        if self.left_alone:
            word |= WARNING
        if self._following_error:
            word |= LAGS
        stopped = self.halted if self.state is _S.OPERATION_ENABLED else self.state is _S.QUICK_STOP_ACTIVE
        if stopped and self._ramp_to is None and abs(self._moved) <= STANDSTILL_COUNTS:
            word |= REACHED
        return word

    def _change_mode(self, mode: int) -> bool:
        if mode == 0 or not self.supports(mode) or self.left_alone:
            return False
        self.mode = self._values[K_DISPLAY] = mode
        self._fresh = False
        return True

    def _command(self, word: int, *, can_reset: bool) -> bool:
        if self.state is _S.FAULT and not can_reset:
            self._word = word
            return False
        option = self._values[K_QUICK_STOP]
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
            option = self._values[K_DISABLE_OPERATION if target is _S.SWITCHED_ON else K_SHUTDOWN]
            if option == DisableOperationOption.DISABLE:
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
        option = self._values[K_QUICK_STOP]
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
        if abs(self._moved) <= STANDSTILL_COUNTS and self.state not in STOPPING:
            self._switch_off(target)

    def _hold(self) -> None:
        self._follows = self._limited = False
        self._axis.hold()

    def _switch_off(self, state: DriveState) -> None:
        self.state = state
        self._axis.power_off()
        self.left_alone = self._fresh = self._follows = self._limited = self.halted = False
        self._following_error = self._following_error and state is _S.FAULT
        self._ramp_to = self._ramp_end_ns = None
