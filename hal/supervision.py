"""What in the reports of a cycle is worth telling, and what must stop the robot."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from hal.decode import Measured, Notice
from hal.profile.cia402 import Controlword, OperationMode, next_controlword
from schemas.messages import DriveState
from schemas.robot import RobotDescription

Mask = npt.NDArray[np.bool_]

_ENABLED = int(DriveState.OPERATION_ENABLED)
DOUBT_CYCLES: Final = 2
"""In another mode than commanded, after each of which a drive is asked: some stacks leave TPDO2 to the application."""


class Supervisor:
    """Compares each cycle's reports with what they should be; tells each finding once, at its onset."""

    def __init__(self, robot: RobotDescription) -> None:
        count = len(robot.joints)
        self._joints = robot.joint_names
        self._patience = robot.safety.sync_timeout_cycles
        self._count = count
        self._wrong_mode = np.zeros(count, dtype=np.int64)
        self._right: tuple[npt.NDArray[np.int8], OperationMode] | None = None
        """Modes reported and commanded that were found to agree last."""
        self._states: npt.NDArray[np.int8] | None = None
        self._silent_sensors: frozenset[str] = frozenset()
        self.all_enabled = True
        """Every drive is in Operation Enabled."""
        self.enabled: Mask = np.ones(count, dtype=bool)
        """Drives in Operation Enabled."""
        self.silent_joints: frozenset[int] = frozenset()
        """Joints whose drives have been silent for `sync_timeout_cycles`."""
        self._lost: frozenset[int] = frozenset()
        """Of these, the ones that were told of."""
        self._absent: Mask = np.zeros(count, dtype=bool)

    @property
    def silent_sensors(self) -> frozenset[str]:
        """Sensors without a whole reading for `sync_timeout_cycles`."""
        return self._silent_sensors

    @property
    def doubtful_joints(self) -> list[int]:
        """Joints whose drives are to be asked for their mode now: none, as long as all modes reported are right."""
        if self._right is not None:
            return []
        joints: list[int] = np.flatnonzero((self._wrong_mode > 0) & (self._wrong_mode % DOUBT_CYCLES == 0)).tolist()
        return joints

    def excuse(self, joints: Mask) -> None:
        """Name the joints whose bus is in trouble: that they are silent, or in an old mode, is not told."""
        self._absent = joints

    def review(self, measured: Measured, mode: OperationMode, sensor_ages: dict[str, int]) -> list[Notice]:
        """List the findings of one cycle.

        Args:
            measured: the decoded cycle.
            mode: that every drive should be in since this SYNC.
            sensor_ages: cycles since the last whole reading of each sensor, of those whose bus is not in trouble.
        """
        notices = list(measured.notices)
        self._review_states(measured, notices)
        self._review_silence(measured, notices)
        self._review_modes(measured, mode, notices)
        self._review_sensors(sensor_ages, notices)
        return notices

    def _review_states(self, measured: Measured, notices: list[Notice]) -> None:
        if measured.drive_state is self._states:
            return
        self._states = measured.drive_state
        before, self.enabled = self.enabled, measured.drive_state == _ENABLED
        all_before, self.all_enabled = self.all_enabled, np.count_nonzero(self.enabled) == self._count
        if all_before and self.all_enabled:
            return
        for joint in np.flatnonzero(before & ~self.enabled).tolist():
            state = DriveState(int(measured.drive_state[joint])).name
            code = int(measured.error_code[joint])
            text = f"joint {self._joints[joint]}: drive went to {state}, error code {code:#06x}"
            notices.append(Notice("drive_fault", "error", text, joint, stops=True))
        for joint in np.flatnonzero(~before & self.enabled).tolist():
            text = f"joint {self._joints[joint]}: drive is enabled again"
            notices.append(Notice("drive_enabled", "info", text, joint))

    def _review_silence(self, measured: Measured, notices: list[Notice]) -> None:
        if not np.count_nonzero(measured.silent_cycles):
            self.silent_joints = self._lost = frozenset()
            return
        silent = np.where(self._absent, 0, measured.silent_cycles)
        for joint in np.flatnonzero(silent == 1).tolist():
            text = f"joint {self._joints[joint]}: no report of the drive in this cycle; the last one is kept"
            notices.append(Notice("report_missing", "warning", text, joint))
        lost = frozenset(np.flatnonzero(silent >= self._patience).tolist())
        for joint in sorted(lost - self._lost):
            text = f"joint {self._joints[joint]}: drive silent for {self._patience} cycles; check its power and its bus"
            notices.append(Notice("node_lost", "error", text, joint, stops=True))
        self._lost = lost
        self.silent_joints = frozenset(np.flatnonzero(measured.silent_cycles >= self._patience).tolist())

    def _review_modes(self, measured: Measured, mode: OperationMode, notices: list[Notice]) -> None:
        right = self._right
        if right is not None and measured.mode is right[0] and mode is right[1]:
            return
        wrong = measured.mode != int(mode)
        if not np.count_nonzero(wrong):
            self._wrong_mode[:] = 0
            self._right = measured.mode, mode
            return
        self._right = None
        wrong &= self.enabled & ~self._absent
        self._wrong_mode = np.where(wrong, self._wrong_mode + 1, 0)
        for joint in np.flatnonzero(self._wrong_mode == self._patience).tolist():
            text = (
                f"joint {self._joints[joint]}: drive reports mode {int(measured.mode[joint])}, commanded is {int(mode)}"
                f" for {self._patience} cycles"
            )
            notices.append(Notice("mode_refused", "error", text, joint, stops=True))

    def _review_sensors(self, ages: dict[str, int], notices: list[Notice]) -> None:
        if not self._silent_sensors and max(ages.values(), default=0) < self._patience:
            return
        silent = frozenset(name for name, age in ages.items() if age >= self._patience)
        if silent == self._silent_sensors:
            return
        lost = f"no reading for {self._patience} cycles; check its power and its bus"
        notices.extend(
            Notice("sensor_silent", "warning", f"sensor {name}: {lost}")
            for name in sorted(silent - self._silent_sensors)
        )
        notices.extend(
            Notice("sensor_back", "info", f"sensor {name}: readings arrive again")
            for name in sorted(self._silent_sensors - silent)
        )
        self._silent_sensors = silent


_COMMANDED: Final = (
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY_TO_SWITCH_ON,
    DriveState.SWITCHED_ON,
    DriveState.OPERATION_ENABLED,
)
"""States that a drive leaves by command alone."""


def controlword(state: DriveState, *, keep: bool) -> int:
    """Controlword for a drive of a stopped robot; `keep`: nothing is powered up.

    So it is in an emergency stop before its reset, and for a drive that was lost or has reported an error.
    """
    if state is DriveState.QUICK_STOP_ACTIVE:
        return Controlword.QUICK_STOP  # "disable voltage" would cut the ramp short
    if state not in _COMMANDED:
        return Controlword.DISABLE_VOLTAGE  # a fault is reset by the boot alone, when somebody has looked at its cause
    return next_controlword(state, state if keep else DriveState.OPERATION_ENABLED)
