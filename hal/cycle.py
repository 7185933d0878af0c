"""The HAL's cycle without I/O and clock: frames in, state out; command in, frames out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final, Literal

import numpy as np

from hal.bus_trouble import BusTrouble
from hal.commands import CommandCheck
from hal.compose import Composer, placed
from hal.decode import Decoder, Measured, Notice, upload_request
from hal.drivers import Controlwords, DriverGroup, operation_mode
from hal.errors import CommandRefused, DriveFaultError, HalError
from hal.expected import expected_reports
from hal.guard import MotionGuard
from hal.holding import Predictor
from hal.limits import Onsets
from hal.profile.cia402 import Controlword, OperationMode
from hal.profile.objects import MODE_DISPLAY
from hal.profile.units import Array
from hal.setpoint import HAL_DECIDED, Setpoint, vector
from hal.supervision import Supervisor, controlword
from schemas.base import ControlMode
from schemas.messages import DriveState, Event, HalStatus, JointCommand, RobotState
from schemas.robot import RobotDescription

Severity = Literal["info", "warning", "error"]
_ExpectedKey = tuple[bool, frozenset[int], frozenset[str], frozenset[int]]
"""Mode change; silent joints, sensors and buses."""

SETTLE_S: Final = 0.1
"""Time that the HAL stays beyond the hold's ramp."""
UNHEARD_CYCLES: Final = 2
"""Without a report, after which a drive of a stopped robot is held where it is found."""


class HalCore:
    """One robot's cycle: `decode` after each SYNC's reports, then `apply` once; `stop` and `reset` at any time.

    A set-point passes from composed to sent (`apply`, at once or a cycle later by `command_delay_cycles`) to latched
    (the next SYNC). Only the safe stop overtakes the delay.
    """

    def __init__(self, robot: RobotDescription, session: str | None = None) -> None:
        """Prepare for a robot.

        Args:
            robot: checked description.
            session: the controller to obey; None: the first whose command is accepted.
        """
        self.robot = robot
        self.missed_commands = 0
        """Cycles without a command fit to be applied, since the first one that was."""
        self.cause: HalError | None = None
        """What made the HAL stop by itself; None while it has not."""
        self._session = session
        self._drivers = DriverGroup(robot)
        self._check = CommandCheck(robot, self._drivers)
        self._composer = Composer(robot)
        self._supervisor = Supervisor(robot)
        self._guard = MotionGuard(robot)
        self._onsets = Onsets(len(robot.joints))
        self._events: list[Event] = []
        self._queue: deque[Setpoint] = deque()
        self._all_enabled: Controlwords = np.full(len(robot.joints), Controlword.ENABLE_OPERATION, dtype=np.uint16)
        self._reports_torque = bool(self._drivers.reports_torque.all())
        self._seen: Measured | None = None
        """Measured that the tuples below were made of."""
        self._seen_mode = ControlMode.POSITION
        self._servo = np.array([joint.drive.kind == "servo" for joint in robot.joints])
        self._sequence = HAL_DECIDED
        self._missed_in_a_row = 0
        self._refusal: tuple[str, str | None] | None = None
        self._foreign: set[str] = set()
        """Foreign sessions that have been told of, once each: an intruder may answer every state."""
        self._commanded = False
        self._safe_stop = False
        self._emergency_stop = False
        self._holding = False
        self._silent_before = np.zeros(len(robot.joints), dtype=np.int64)
        """Cycles without a report of each drive, at the decode before."""
        self._expected: dict[_ExpectedKey, tuple[frozenset[int], ...]] = {}
        self._trouble = BusTrouble(robot)
        self._reset_joints: set[int] = set()
        """Joints whose drives were reset in operation: what the boot has set is gone, so they are not enabled."""
        self._lost_joints: set[int] = set()
        """Joints whose drives were lost or reported an error: none that is off after that is enabled again."""
        self._modes: tuple[ControlMode, ...] = (ControlMode.POSITION,) * len(robot.joints)
        self._states: tuple[DriveState, ...] = (DriveState.OPERATION_ENABLED,) * len(robot.joints)
        self._errors: tuple[int, ...] = (0,) * len(robot.joints)
        self._measured: Measured | None = None
        self._foreign_joints: frozenset[int] = frozenset()

    def start(self, positions: Array, foreign_joints: frozenset[int] = frozenset()) -> None:
        """Begin after the boot: every drive in Operation Enabled, mode 8, holding.

        Args:
            positions: where the joints stand [rad].
            foreign_joints: indices of joints with other makers' drives.

        Raises:
            HalError: the number of positions is not the number of joints.
        """
        positions = np.array(positions, dtype=np.float64)
        if positions.shape != (len(self.robot.joints),):
            raise HalError(
                f"start with {positions.shape} positions for {len(self.robot.joints)} joints; give one a joint"
            )
        self._foreign_joints = foreign_joints
        self._decoder = Decoder(self.robot, positions)
        self._predictor = Predictor(positions, self.robot.period_s)
        self._composed = self._sent = self._latched = Setpoint(HAL_DECIDED, ControlMode.POSITION, positions)

    @property
    def status(self) -> HalStatus:
        """Who decides what the drives do."""
        if self._emergency_stop:
            return HalStatus.EMERGENCY_STOP
        return HalStatus.SAFE_STOP if self._safe_stop else HalStatus.ACTIVE

    @property
    def cycles_to_hold(self) -> int:
        """Cycles that the HAL stays when it leaves: until its last target is latched and any holding offset is gone."""
        waiting = (self._composed, self._sent, self._latched)
        if self.status is HalStatus.ACTIVE and all(each.torque is None and each.hold is None for each in waiting):
            return self.robot.command_delay_cycles + 1
        return round((self.robot.safety.hold_ramp_s + SETTLE_S) * self.robot.rate_hz)

    @property
    def session(self) -> str | None:
        """The controller obeyed."""
        return self._session

    @property
    def expected_reports(self) -> tuple[frozenset[int], ...]:
        """Identifiers per bus to await after the SYNC that latches what `apply` sent last; ask before `decode`."""
        # At the first SYNC after the boot a TPDO2 of type 0 is new to its drive and comes as well.
        change = self._measured is None or operation_mode(self._sent.mode) is not operation_mode(self._latched.mode)
        silent = self._trouble.silent_buses
        key = (change, self._supervisor.silent_joints, self._supervisor.silent_sensors, silent)
        if key not in self._expected:
            expected = expected_reports(
                self.robot,
                mode_change=change,
                silent_joints=key[1],
                silent_sensors=key[2],
                foreign_joints=self._foreign_joints,
            )
            self._expected[key] = tuple(
                frozenset() if index in silent else identifiers for index, identifiers in enumerate(expected)
            )
        return self._expected[key]

    @property
    def troubled_buses(self) -> tuple[str, ...]:
        """Names of the buses in trouble, and of those whose drives have not yet been found to hold after one."""
        return self._trouble.buses

    def set_bus_down(self, index: int, reason: str | None) -> None:
        """Say that a bus takes and gives no frames now, and why, or that it does again; the next `apply` acts on it."""
        self._trouble.set_down(index, reason)
        self._supervisor.excuse(self._trouble.joints)

    def decode(self, sequence: int, frames_per_bus: Sequence[bytes]) -> RobotState:
        """Read the reports of SYNC `sequence`, frames of each bus in the order of the robot's buses.

        Raises:
            ProfileError: a buffer is not a whole number of frames.
        """
        elapsed = sequence - self._sequence if self._measured is not None else 1
        self._sequence = sequence
        if self._sent.mode is not self._latched.mode:
            self._tell("mode_change", "info", f"mode {self._latched.mode.value} → {self._sent.mode.value}")
        self._latched = self._sent
        if self._measured is not None:
            self._silent_before = self._measured.silent_cycles
        measured = self._measured = self._decoder.decode(frames_per_bus)
        self._predictor.update(measured.position, elapsed)
        self._review(measured)
        self._update_tuples(measured)
        torque = vector(measured.motor_torque) if self._reports_torque else None
        self._reset_joints |= measured.reset
        return RobotState(
            sequence=sequence,
            time_ns=sequence * self.robot.period_ns,
            status=self.status,
            position_measured=vector(measured.position),
            motor_torque_measured=torque,
            drive_state=self._states,
            mode=self._modes,
            error_code=self._errors,
            applied=self._latched.applied(),
            wrenches=measured.wrenches,
            imus=measured.imus,
        )

    def accepts(self, command: JointCommand) -> bool:
        """Whether `apply` would take a command as the answer to the last state; a refusal is told as an event."""
        return self._checked(command) is not None

    def apply(self, command: JointCommand | None) -> tuple[bytes, ...]:
        """Compose the next set-point and return the RPDOs to send on each bus.

        Args:
            command: answer to the state decoded last; None: none came in time, the last good one is held.

        Raises:
            HalError: nothing has been decoded yet.
        """
        measured = self._measured
        if measured is None:
            raise HalError("apply before the first decode; every cycle decodes its reports first")
        if measured.errors or self._trouble.active:
            self._act_on(self._trouble.review(measured, self._supervisor.enabled), measured)
            self._supervisor.excuse(self._trouble.joints)
        arrays = None if command is None else self._checked(command)
        if self.status is HalStatus.ACTIVE:
            self._count(arrays is not None)
        active = self.status is HalStatus.ACTIVE
        self._sent = self._follow(command, arrays, measured) if active else self._hold(measured)
        packets = self._drivers.encode(self._sent, self._controlwords(measured))
        if self._trouble.active:
            packets = self._trouble.passing(packets, measured)
        doubtful = self._supervisor.doubtful_joints
        return self._asking(packets, doubtful) if doubtful else packets

    def stop(self, reason: str, emergency: bool = False) -> None:
        """Stop from the next `apply` on; `emergency` latches until `reset`."""
        if emergency:
            if not self._emergency_stop:
                self._emergency_stop = True
                self._tell("emergency_stop", "error", f"emergency stop: {reason}; the HAL holds until it is reset")
        elif not self._safe_stop:
            self._safe_stop = True
            self._tell("safe_stop", "error", f"safe stop: {reason}; the HAL holds until the run ends")

    def leave(self) -> None:
        """Hold from the next `apply` on because the run is over: as a safe stop, but nothing is wrong."""
        self._safe_stop = True
        self._tell("run_end", "info", "the run is over; the HAL holds and leaves")

    def reset(self) -> None:
        """Clear a latched emergency stop; a safe stop stays."""
        if not self._emergency_stop:
            self._tell("reset", "warning", "reset without an emergency stop: nothing to clear")
            return
        self._emergency_stop = False
        self._missed_in_a_row = 0
        self._tell("reset", "info", f"emergency stop cleared, the HAL is in {self.status.value}")

    def drain_events(self) -> list[Event]:
        """Return the events since the last call, oldest first."""
        events, self._events = self._events, []
        return events

    def _asking(self, packets: tuple[bytes, ...], joints: list[int]) -> tuple[bytes, ...]:
        """Add questions for the modes of some joints' drives."""
        asked = list(packets)
        for joint in joints:
            drive = self.robot.joints[joint].drive
            asked[self.robot.bus_index(drive.bus)] += upload_request(drive.node_id, MODE_DISPLAY)
        return tuple(asked)

    def _follow(self, command: JointCommand | None, arrays: dict[str, Array] | None, measured: Measured) -> Setpoint:
        self._holding = False
        previous, delay = self._composed, self.robot.command_delay_cycles
        if command is None or arrays is None:
            composed = self._composer.repeat(previous)
        else:
            result = self._composer.command(
                command.sequence, command.mode, arrays, previous, self._predictor, delay, measured.motor_torque
            )
            composed = result.setpoint
            for limit, joint in self._onsets.update(result.acted):
                name = self.robot.joint_names[joint]
                self._tell("limited", "warning", f"joint {name}: command held to the {limit}", joint)
        self._queue.append(composed)
        while len(self._queue) < delay:
            self._queue.appendleft(previous)
        self._composed = composed
        return self._queue.popleft()

    def _hold(self, measured: Measured) -> Setpoint:
        """Compose one cycle of a stop; the first drops what waits in the queue, so the stop acts at the next SYNC."""
        previous = self._composed if self._holding else self._latched
        self._queue.clear()
        self._holding = True
        held = self._composer.safe(previous, self._predictor)
        # What a drive did unheard is not known: a target from before would throw its joint back.
        back = (self._silent_before >= UNHEARD_CYCLES) & (measured.silent_cycles == 0) & self._drivers.reports_torque
        if np.count_nonzero(back):
            held = placed(held, back, self._composer.holding(measured.position, measured.motor_torque))
        if not self._supervisor.all_enabled:  # led along with where they are, so that enabling one cannot throw it
            held = placed(held, ~self._supervisor.enabled, measured.position)
        self._composed = held
        return held

    def _checked(self, command: JointCommand) -> dict[str, Array] | None:
        try:
            arrays = self._check.check(command, self._sequence, self._session)
        except CommandRefused as refusal:
            evidence = (refusal.field, refusal.joint)
            told = command.session in self._foreign if refusal.field == "session" else evidence == self._refusal
            if self.status is HalStatus.ACTIVE and not told:
                if refusal.field == "session":
                    self._foreign.add(command.session)
                self._refusal = evidence
                joint = None if refusal.joint is None else self.robot.joint_names.index(refusal.joint)
                self._tell("command_refused", "warning", f"command refused: {refusal}", joint)
            return None
        self._refusal = None
        if self._session is None:
            self._session = command.session
        return arrays

    def _count(self, good: bool) -> None:
        if good:
            self._commanded, self._missed_in_a_row = True, 0
            return
        if not self._commanded and self._refusal is None:
            return
        self.missed_commands += 1
        self._missed_in_a_row += 1
        if self._missed_in_a_row == 1:
            self._tell("command_missed", "warning", f"no command for sequence {self._sequence}; the last one is held")
        if self._missed_in_a_row >= self.robot.safety.missed_commands:
            self.stop(f"{self._missed_in_a_row} cycles in a row without a valid command")

    def _review(self, measured: Measured) -> None:
        mode = operation_mode(self._latched.mode)
        ages = self._decoder.sensor_ages
        if self._trouble.active:
            ages = self._trouble.expected_ages(ages)
        notices = self._supervisor.review(measured, mode, ages)
        self._lost_joints |= self._supervisor.silent_joints
        if self._latched.mode is ControlMode.TORQUE and self.status is HalStatus.ACTIVE:
            notices += self._guard.review(measured.position, self._predictor.mean_velocity)
        self._act_on(notices, measured)

    def _act_on(self, notices: Iterable[Notice], measured: Measured) -> None:
        for notice in notices:
            self._tell(notice.kind, notice.severity, notice.text, notice.joint)
            if notice.stops:
                if notice.kind in _LOSSES and notice.joint is not None:
                    self._lost_joints.add(notice.joint)
                self.cause = self.cause or self._cause(notice, measured)
                self.stop(notice.text)

    def _cause(self, notice: Notice, measured: Measured) -> HalError:
        joint = notice.joint
        if joint is None or notice.kind in MotionGuard.KINDS:
            return HalError(notice.text)
        state = DriveState(int(measured.drive_state[joint])).name
        return DriveFaultError(self.robot.joint_names[joint], state, int(measured.error_code[joint]), notice.text)

    def _controlwords(self, measured: Measured) -> Controlwords:
        if self._supervisor.all_enabled and not self._reset_joints:
            return self._all_enabled
        words = [
            controlword(DriveState(state), keep=self._emergency_stop or joint in self._lost_joints)
            for joint, state in enumerate(measured.drive_state.tolist())
        ]
        for joint in self._reset_joints:
            words[joint] = Controlword.DISABLE_VOLTAGE
        return np.array(words, dtype=np.uint16)

    def _update_tuples(self, measured: Measured) -> None:
        seen, mode = self._seen, self._latched.mode
        if (
            seen is not None
            and measured.drive_state is seen.drive_state
            and measured.mode is seen.mode
            and measured.error_code is seen.error_code
            and mode is self._seen_mode
        ):
            return
        self._seen, self._seen_mode = measured, mode
        self._errors = tuple(measured.error_code.tolist())
        self._states = tuple(map(_STATES.__getitem__, measured.drive_state.tolist()))
        csp = ControlMode.SERVO if self._latched.mode is ControlMode.SERVO else ControlMode.POSITION
        self._modes = tuple(
            ControlMode.TORQUE
            if mode == OperationMode.CST
            else (csp if servo else ControlMode.POSITION)
            if mode == OperationMode.CSP
            else before
            for mode, servo, before in zip(measured.mode.tolist(), self._servo.tolist(), self._modes, strict=True)
        )

    def _tell(self, kind: str, severity: Severity, text: str, joint: int | None = None) -> None:
        self._events.append(
            Event(
                sequence=self._sequence,
                time_ns=self._sequence * self.robot.period_ns,
                service="hal",
                kind=kind,
                severity=severity,
                text=text,
                joint=None if joint is None else self.robot.joint_names[joint],
            )
        )


_STATES = tuple(DriveState)
_LOSSES: Final = frozenset({"node_lost", "drive_emergency"})
"""Kinds of notices after which a drive's power stage is left to whoever boots it again."""
