"""From a checked command and the set-point before it to the next set-point: limits and the holding rule."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hal.holding import HoldingRule, Predictor
from hal.limits import Limited, Limits, Mask
from hal.profile.units import Array
from hal.setpoint import HAL_DECIDED, Hold, Setpoint
from schemas.base import ControlMode
from schemas.robot import RobotDescription


@dataclass(frozen=True, slots=True)
class Composed:
    """A set-point and the limits that acted on it."""

    setpoint: Setpoint
    acted: tuple[tuple[str, Mask], ...] = ()


class Composer:
    """Composes the set-points of one robot."""

    def __init__(self, robot: RobotDescription) -> None:
        self._limits = Limits.of(robot)
        self._rule = HoldingRule(robot)
        self._naive = robot.safety.holding == "none"

    def command(
        self,
        sequence: int,
        mode: ControlMode,
        arrays: dict[str, Array],
        previous: Setpoint,
        predictor: Predictor,
        delay: int,
        motor_torque: Array,
    ) -> Composed:
        """Limit a command against the set-point before it.

        Args:
            sequence: the state it answers.
            mode: its mode.
            arrays: its arrays, checked.
            previous: latched the cycle before this one will be.
            predictor: of the positions measured so far.
            delay: cycles until the latch.
            motor_torque: measured [N·m], the torque before a change from position to torque.
        """
        if mode is ControlMode.TORQUE:
            torque = self._limits.torque(arrays["torque"], motor_torque if previous.torque is None else previous.torque)
            return Composed(Setpoint(sequence, mode, torque=torque.value), torque.acted)
        position, hold = self._position(arrays["position"], previous, predictor, delay)
        if mode is ControlMode.POSITION:
            return Composed(Setpoint(sequence, mode, position.value, hold=hold), position.acted)
        limit = self._limits.servo_limit(arrays["torque_limit"])
        setpoint = Setpoint(sequence, mode, position.value, torque_limit=limit.value, hold=hold)
        return Composed(setpoint, (*position.acted, *limit.acted))

    def repeat(self, previous: Setpoint) -> Setpoint:
        """Return the last good set-point again; a holding offset goes on to ramp."""
        return replace(previous, hold=None if previous.hold is None else previous.hold.advanced())

    def safe(self, previous: Setpoint, predictor: Predictor) -> Setpoint:
        """Hold from the next SYNC on: from torque mode where the joints will be then, else the last applied target."""
        if previous.torque is None:
            return replace(self.repeat(previous), sequence=HAL_DECIDED)
        position, velocity = predictor.ahead(1)
        entry = self._rule.target(previous.torque, position, velocity) - position
        hold = Hold(entry, self._rule.cycles, self._rule.cycles)
        return Setpoint(HAL_DECIDED, ControlMode.POSITION, position, hold=hold)

    def holding(self, position: Array, motor_torque: Array) -> Array:
        """Targets [rad] at which drives at these positions [rad] go on with the torques [N·m] that they report.

        Their velocity is left out: after an outage it is not known, and the firmware damps it.
        """
        return self._rule.target(motor_torque, position, np.zeros_like(position))

    def _position(
        self, commanded: Array, previous: Setpoint, predictor: Predictor, delay: int
    ) -> tuple[Limited, Hold | None]:
        if previous.torque is None:
            assert previous.position is not None
            hold = None if previous.hold is None else previous.hold.advanced()
            return self._limits.position(commanded, previous.position), hold
        position, velocity = predictor.ahead(delay)
        limited = self._limits.position(commanded, position)
        if self._naive:
            return limited, None
        entry = self._rule.target(previous.torque, position, velocity) - limited.value
        return limited, Hold(entry, self._rule.cycles, self._rule.cycles)


def placed(setpoint: Setpoint, joints: Mask, targets: Array) -> Setpoint:
    """Give some joints targets [rad] of their own, without an offset; in torque mode nothing changes."""
    if setpoint.position is None:
        return setpoint
    hold = setpoint.hold
    if hold is not None:
        hold = Hold(np.where(joints, 0.0, hold.entry), hold.cycles, hold.left)
    return replace(setpoint, position=np.where(joints, targets, setpoint.position), hold=hold)
