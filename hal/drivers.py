"""The three HRP-style drivers: which modes each kind of drive has, and how a set-point becomes its RPDO bytes.

A driver serves all drives of its kind at once: a cycle encodes a robot in a few array operations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from hal.errors import HalError
from hal.profile import identifiers
from hal.profile.cia402 import OperationMode
from hal.profile.firmware import SMOOTHING, FirmwareGains, inverse_with_band, smoothing_band
from hal.profile.frames import FRAME, FRAME_BYTES
from hal.profile.objects import POSITION_LAYOUT, SERVO_LAYOUT, TORQUE_LAYOUT
from hal.profile.units import DriveUnits
from hal.setpoint import Setpoint
from schemas.base import ControlMode
from schemas.robot import RobotDescription

Frames = npt.NDArray[np.void]
Controlwords = npt.NDArray[np.uint16]


def operation_mode(mode: ControlMode) -> OperationMode:
    """Mode of operation 0x6060 that carries a control mode: CST for torque, CSP for the others."""
    return OperationMode.CST if mode is ControlMode.TORQUE else OperationMode.CSP


class Rpdos:
    """One RPDO for each of some drives, made once and filled in every cycle.

    Args:
        can_ids: of the drives.
        layout: of the data.
        mode: of operation, for layouts that carry it.

    """

    def __init__(
        self, can_ids: npt.NDArray[np.uint32], layout: np.dtype[np.void], mode: OperationMode | None = None
    ) -> None:
        assert layout.names is not None
        assert layout.fields is not None
        body = [(name, layout.fields[name][0]) for name in layout.names]
        # Every byte belongs to a field: numpy does not promise to copy padding, and these bytes go on the bus.
        fields = [("can_id", "<u4"), ("length", "u1"), ("pad", "V3"), *body, ("tail", f"V{8 - layout.itemsize}")]
        if layout.itemsize == 8:
            fields.pop()
        self.frames: Frames = np.zeros(len(can_ids), np.dtype(fields))
        self.columns: dict[str, npt.NDArray[np.integer]] = {name: self.frames[name] for name in layout.names}
        """Fields of the data, each an array over the drives."""
        self.frames["can_id"] = can_ids
        self.frames["length"] = layout.itemsize
        if mode is not None:
            self.frames["mode"] = mode


class Driver(ABC):
    """All drives of one kind of a robot; `joints` are their indices in the robot's order."""

    modes: ClassVar[frozenset[ControlMode]]
    reports_torque: ClassVar[bool]

    def __init__(self, joints: npt.NDArray[np.intp], description: RobotDescription) -> None:
        self.joints = joints
        self.units = DriveUnits.of(description).select(joints)
        self.gains = FirmwareGains.of(description).select(joints)
        self._nodes = np.array([description.joints[index].drive.node_id for index in joints], dtype=np.uint32)
        every = np.arange(len(description.joints))
        self._own = slice(None) if np.array_equal(joints, every) else joints
        self._rpdo_position = Rpdos(self._nodes + identifiers.RPDO1, POSITION_LAYOUT, OperationMode.CSP)

    @abstractmethod
    def encode(self, setpoint: Setpoint, controlwords: Controlwords) -> Frames:
        """Make one RPDO for each of the drives, in the order of `joints`: a structured array of 16-byte frames.

        The next call may overwrite it.

        Args:
            setpoint: of the whole robot; its mode is one of `modes`.
            controlwords: of the whole robot.
        """

    def _position(self, setpoint: Setpoint, controlwords: Controlwords) -> Frames:
        rpdos = self._rpdo_position
        rpdos.columns["controlword"][:] = controlwords[self._own]
        rpdos.columns["position"][:] = self.units.counts_from_position(setpoint.target[self._own])
        return rpdos.frames


class PositionPD(Driver):
    """Position-PD drives: mode 8 only, no torque report."""

    modes = frozenset({ControlMode.POSITION})
    reports_torque = False

    def encode(self, setpoint: Setpoint, controlwords: Controlwords) -> Frames:
        """RPDO1 {6040, 6060, 607A}."""
        return self._position(setpoint, controlwords)


class Torque(Driver):
    """Torque drives: mode 10, and mode 8 for start-up and fallback; the motor's torque is reported."""

    modes = frozenset({ControlMode.POSITION, ControlMode.TORQUE})
    reports_torque = True

    def __init__(self, joints: npt.NDArray[np.intp], description: RobotDescription) -> None:
        super().__init__(joints, description)
        self._rpdo_torque = Rpdos(self._nodes + identifiers.RPDO2, TORQUE_LAYOUT, OperationMode.CST)
        self._band = smoothing_band(self.gains.dead_zone, SMOOTHING)

    def encode(self, setpoint: Setpoint, controlwords: Controlwords) -> Frames:
        """RPDO1 {6040, 6060, 607A} or RPDO2 {6040, 6060, 6071}; the latter holds D⁻¹ of the torque to be delivered."""
        if setpoint.torque is None:
            return self._position(setpoint, controlwords)
        rpdos = self._rpdo_torque
        rpdos.columns["controlword"][:] = controlwords[self._own]
        effort = inverse_with_band(setpoint.torque[self._own], self.gains.dead_zone, self._band)
        rpdos.columns["torque"][:] = self.units.per_mille_from_torque(effort)
        return rpdos.frames


class Servo(Driver):
    """Position servos with a torque limit every cycle; in mode `position` the limit is the joint's own."""

    modes = frozenset({ControlMode.POSITION, ControlMode.SERVO})
    reports_torque = True

    def __init__(self, joints: npt.NDArray[np.intp], description: RobotDescription) -> None:
        super().__init__(joints, description)
        self._rpdo_servo = Rpdos(self._nodes + identifiers.RPDO1, SERVO_LAYOUT)

    def encode(self, setpoint: Setpoint, controlwords: Controlwords) -> Frames:
        """RPDO1 {6040, 607A, 6072}."""
        columns = self._rpdo_servo.columns
        columns["controlword"][:] = controlwords[self._own]
        columns["position"][:] = self.units.counts_from_position(setpoint.target[self._own])
        limit = self.gains.torque_limit if setpoint.torque_limit is None else setpoint.torque_limit[self._own]
        columns["max_torque"][:] = self.units.per_mille_from_limit(limit)
        return self._rpdo_servo.frames


DRIVERS: Final[dict[str, type[Driver]]] = {"position_pd": PositionPD, "torque": Torque, "servo": Servo}


class DriverGroup:
    """The drivers of a robot, kinds mixed as they may be."""

    def __init__(self, description: RobotDescription) -> None:
        kinds = np.array([joint.drive.kind for joint in description.joints])
        buses = np.array([description.bus_index(joint.drive.bus) for joint in description.joints])
        order = np.argsort(buses, kind="stable")
        self._ends = np.searchsorted(buses[order], np.arange(len(description.buses)), side="right").tolist()
        self._rows = tuple(np.flatnonzero(kinds[order] == kind) for kind in DRIVERS if kind in kinds)
        self.drivers: tuple[Driver, ...] = tuple(
            driver(order[kinds[order] == kind], description) for kind, driver in DRIVERS.items() if kind in kinds
        )
        """One a kind; each has its joints in the order of the buses."""
        self.modes = frozenset.intersection(*(driver.modes for driver in self.drivers))
        """Modes that every drive of the robot has."""
        self.reports_torque = np.zeros(len(kinds), dtype=bool)
        for driver in self.drivers:
            self.reports_torque[driver.joints] = driver.reports_torque

    def lacking(self, mode: ControlMode) -> npt.NDArray[np.intp]:
        """Find the indices of the joints whose drives do not have a mode."""
        groups = [driver.joints for driver in self.drivers if mode not in driver.modes]
        return np.sort(np.concatenate(groups)) if groups else np.empty(0, dtype=np.intp)

    def encode(self, setpoint: Setpoint, controlwords: Controlwords) -> tuple[bytes, ...]:
        """RPDOs of one cycle: for each bus its frames, in the order of the joints.

        Raises:
            HalError: a drive does not have the set-point's mode.
        """
        if setpoint.mode not in self.modes:
            raise HalError(f"mode {setpoint.mode} is not one of this robot's: {', '.join(sorted(self.modes))}")
        if len(self.drivers) == 1:
            return _split(self.drivers[0].encode(setpoint, controlwords).tobytes(), self._ends)
        frames = np.zeros(len(self.reports_torque), FRAME)
        for driver, rows in zip(self.drivers, self._rows, strict=True):
            frames[rows] = np.frombuffer(driver.encode(setpoint, controlwords).tobytes(), FRAME)
        return _split(frames.tobytes(), self._ends)


def _split(frames: bytes, ends: Sequence[int]) -> tuple[bytes, ...]:
    return tuple(frames[start * FRAME_BYTES : end * FRAME_BYTES] for start, end in zip((0, *ends), ends, strict=False))
