"""Whether a joint command is fit to be applied."""

from __future__ import annotations

from math import isfinite
from typing import Final

import numpy as np

from hal.drivers import DriverGroup
from hal.errors import CommandRefused
from hal.profile.units import Array
from schemas.base import ControlMode
from schemas.messages import JointCommand
from schemas.robot import RobotDescription

REQUIRED: Final[dict[ControlMode, tuple[str, ...]]] = {
    ControlMode.POSITION: ("position",),
    ControlMode.TORQUE: ("torque",),
    ControlMode.SERVO: ("position", "torque_limit"),
}
"""Arrays that make a command of each mode complete; others are ignored."""


class CommandCheck:
    """The checks of one robot."""

    def __init__(self, robot: RobotDescription, drivers: DriverGroup) -> None:
        self._joints = robot.joint_names
        self._drivers = drivers

    def check(self, command: JointCommand, sequence: int, session: str | None) -> dict[str, Array]:
        """Return the arrays that the command's mode uses.

        Args:
            command: as received.
            sequence: of the last state, which the command must answer.
            session: the controller obeyed; None: any.

        Raises:
            CommandRefused: foreign session, wrong sequence, a mode that a drive lacks, an array absent, of wrong length
                or not finite.
        """
        if session is not None and command.session != session:
            raise CommandRefused("session", command.session, f"{session!r}, the controller this HAL obeys")
        if command.sequence != sequence:
            raise CommandRefused("sequence", command.sequence, f"{sequence}, that of the last state")
        if command.mode not in self._drivers.modes:
            names = ", ".join(sorted(self._drivers.modes))
            first = int(self._drivers.lacking(command.mode)[0])
            raise CommandRefused("mode", command.mode.value, f"one of {names}", self._joints[first])
        arrays = {}
        for field in REQUIRED[command.mode]:
            values = getattr(command, field)
            if values is None:
                raise CommandRefused(field, None, f"given in mode {command.mode.value}")
            if len(values) != len(self._joints):
                raise CommandRefused(f"length of {field}", len(values), f"{len(self._joints)}, one a joint")
            if not all(map(isfinite, values)):
                joint = next(joint for joint, value in enumerate(values) if not isfinite(value))
                raise CommandRefused(field, values[joint], "finite", self._joints[joint])
            arrays[field] = np.array(values, dtype=np.float64)
        return arrays
