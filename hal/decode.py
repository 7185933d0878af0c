"""From the frames of a cycle to what the robot measured."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from hal.bus.error_frames import ErrorReport, decode_error
from hal.emergency import emergency_text
from hal.errors import HalError, ProfileError
from hal.profile import identifiers, sensors
from hal.profile.cia402 import STATE_BITS, STATE_TABLE, UNDEFINED, EmergencyCode, OperationMode
from hal.profile.frames import CAN_ERR_FLAG, FRAME_BYTES, pack, view
from hal.profile.objects import (
    EMCY_STRUCT,
    ERROR_CODE,
    MODE_DISPLAY,
    MODE_STRUCT,
    STATE_LAYOUT,
    TPDO_MODE,
    TPDO_STATE,
)
from hal.profile.units import Array, DriveUnits
from hal.readings import ACCELERATION, FORCE, GYRO, QUATERNION, TORQUE, ForceTorqueReading, InertialReading
from schemas.messages import DriveState, ImuSample, WrenchSample
from schemas.robot import RobotDescription

_UNKNOWN, _STATE, _MODE, _EMCY, _HEARTBEAT, _SDO = range(6)
_FRAME_NAMES: Final = {_STATE: "TPDO1", _MODE: "TPDO2", _EMCY: "EMCY", _HEARTBEAT: "heartbeat", _SDO: "SDO answer"}
_NO_ID: Final = 0x800
"""Row of all identifiers that are not 11-bit data frames."""
_ANY_BUS: Final = _NO_ID + 1
_DATA: Final = 8
"""Where the data begin in a frame."""
_PLANS: Final = 256
"""Plans kept; more orders of frames than this mean that none repeats."""
_NOBODY: Final[frozenset[int]] = frozenset()
_NONE_MALFORMED: Final[frozenset[tuple[int, int, int, int]]] = frozenset()
_SDO_HEAD: Final = struct.Struct("<BHB")
_ONE_BYTE, _TWO_BYTES = 0x4F, 0x4B
"""Commands of an expedited upload's answer, CiA 301 section 7.2.4.3.6."""
_UPLOAD: Final = 0x40
MODE_ALONE_BYTES: Final = 1
"""TPDO2 of a drive that has no error code, object 0x603F."""

HARMLESS_EMERGENCIES: Final = frozenset(
    {
        EmergencyCode.NO_ERROR,
        EmergencyCode.CAN_OVERRUN,
        EmergencyCode.CAN_PASSIVE,
        EmergencyCode.BUS_OFF_RECOVERED,
    }
)
"""Emergencies that tell of the bus and do not stop the robot."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Something found in the frames that happened once; `stops` asks for the safe stop."""

    kind: str
    severity: Literal["info", "warning", "error"]
    text: str
    joint: int | None = None
    stops: bool = False


@dataclass(frozen=True, slots=True)
class Measured:
    """What the robot reported, arrays over the joints; an array that did not change is the one of the cycle before."""

    position: Array
    """[rad]."""
    motor_torque: Array
    """[N·m] at the joint; meaningless for drives that report none."""
    drive_state: npt.NDArray[np.int8]
    """Numbers of `DriveState`."""
    mode: npt.NDArray[np.int8]
    """0x6061, last report."""
    error_code: npt.NDArray[np.uint16]
    """0x603F, last report."""
    silent_cycles: npt.NDArray[np.int64]
    """Cycles since the last TPDO1; 0: it came in this cycle."""
    wrenches: tuple[WrenchSample, ...]
    imus: tuple[ImuSample, ...]
    notices: tuple[Notice, ...]
    heard: tuple[bool, ...]
    """Buses on which frames of the wire came in this cycle."""
    errors: tuple[tuple[int, ErrorReport], ...]
    """Index of the bus and content of each error frame of its controller."""
    answered: frozenset[int]
    """Joints whose mode came by SDO in this cycle (see `upload_request`)."""
    reset: frozenset[int]
    """Joints whose drives have announced their boot-up in this cycle."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """Where in a cycle's frames everything is."""

    joints: npt.NDArray[np.intp]
    """Of the TPDO1s, in their order."""
    words: npt.NDArray[np.intp]
    """Their data among the words of 8 bytes."""
    complete: bool
    """Every joint is among them."""
    others: tuple[tuple[int, int, int, int], ...]
    """Kind, index of joint or sensor, and the data's first and last byte of every other known frame."""
    heard: tuple[bool, ...]
    """Buses with frames of the wire."""
    errors: tuple[tuple[int, int], ...]
    """Bus and first byte of each error frame."""
    malformed: frozenset[tuple[int, int, int, int]]
    """Kind, index, length and expected length of frames of a known identifier with a wrong one."""


class Decoder:
    """Keeps what is reported on change between the cycles; unknown identifiers and wrong lengths change nothing.

    Error frames of the controllers are handed out by themselves, remote and 29-bit frames are passed over.
    """

    def __init__(self, robot: RobotDescription, positions: Array) -> None:
        """Start from drives in Operation Enabled, mode 8, at `positions` [rad] (as the boot leaves them).

        Raises:
            HalError: two nodes or sensors of one bus use the same identifier.
        """
        count = len(robot.joints)
        self._joints = robot.joint_names
        self._units = DriveUnits.of(robot)
        self._reports = np.zeros(count, dtype="<u8")
        """Data of the last TPDO1 of each joint."""
        reports = self._reports.view(STATE_LAYOUT)
        self._statusword, self._counts, self._per_mille = reports["statusword"], reports["position"], reports["torque"]
        self._counts[:] = self._units.counts_from_position(np.asarray(positions, dtype=np.float64))
        self._decoded = b""
        """Statuswords that `_state` holds; empty when one is undefined."""
        self._state = np.full(count, DriveState.OPERATION_ENABLED, dtype=np.int8)
        self._mode = np.full(count, OperationMode.CSP, dtype=np.int8)
        self._error = np.zeros(count, dtype=np.uint16)
        self._none_silent = np.zeros(count, dtype=np.int64)
        self._silent = self._none_silent
        self._force_torque = [ForceTorqueReading(sensor) for sensor in robot.force_torque_sensors]
        self._inertial = [InertialReading(imu) for imu in robot.imus]
        self._sensors: list[ForceTorqueReading | InertialReading] = [*self._force_torque, *self._inertial]
        self._malformed = _NONE_MALFORMED
        self._answered: set[int] = set()
        self._reset: set[int] = set()
        self._plans: dict[tuple[tuple[int, ...], bytes], _Plan] = {}
        self._bus_base = np.arange(len(robot.buses)) * _ANY_BUS
        self._kind = np.full(len(robot.buses) * _ANY_BUS, _UNKNOWN, dtype=np.uint8)
        self._index = np.zeros(len(self._kind), dtype=np.intp)
        self._length = np.zeros(len(self._kind), dtype=np.uint8)
        self._fill_table(robot)

    @property
    def sensor_ages(self) -> dict[str, int]:
        """Cycles since each sensor's last whole reading, by its name."""
        return {unit.sensor.name: unit.age for unit in self._sensors}

    def decode(self, frames_per_bus: Sequence[bytes]) -> Measured:
        """Read all frames of one cycle, in the order of the robot's buses.

        Raises:
            ProfileError: a buffer is not a whole number of frames.
        """
        if any(len(frames) % FRAME_BYTES for frames in frames_per_bus):
            sizes = ", ".join(str(len(frames)) for frames in frames_per_bus)
            raise ProfileError(f"buffers of {sizes} bytes: each must hold whole frames of {FRAME_BYTES} bytes")
        packet = b"".join(frames_per_bus)
        words = np.frombuffer(packet, "<u8")
        plan = self._plan(tuple(map(len, frames_per_bus)), packet, words[0::2])
        notices: list[Notice] = []
        self._silent = self._none_silent if plan.complete else self._silent + 1
        if len(plan.joints):
            self._reports[plan.joints] = words[plan.words]
            self._read_states(plan, notices)
        for kind, index, start, end in plan.others:
            self._read_other(kind, index, packet[start:end], notices)
        if plan.malformed is not self._malformed:
            notices += [self._wrong_length(*found) for found in sorted(plan.malformed - self._malformed)]
            self._malformed = plan.malformed
        errors = tuple((bus, decode_error(packet[start : start + FRAME_BYTES])) for bus, start in plan.errors)
        answered, reset = _NOBODY, _NOBODY
        if self._answered or self._reset:
            answered, reset = frozenset(self._answered), frozenset(self._reset)
            self._answered.clear()
            self._reset.clear()
        wrenches = [unit.sample() for unit in self._force_torque]
        imus = [unit.sample() for unit in self._inertial]
        return Measured(
            self._units.position_from_counts(self._counts),
            self._units.torque_from_per_mille(self._per_mille),
            self._state,
            self._mode,
            self._error,
            self._silent,
            tuple(sample for sample in wrenches if sample is not None),
            tuple(sample for sample in imus if sample is not None),
            tuple(notices),
            plan.heard,
            errors,
            answered,
            reset,
        )

    def _plan(self, sizes: tuple[int, ...], packet: bytes, heads: npt.NDArray[np.uint64]) -> _Plan:
        """Sort the frames of a cycle; cycles with the same identifiers and lengths in the same order share a plan."""
        signature = (sizes, heads.tobytes())
        plan = self._plans.get(signature)
        if plan is None:
            if len(self._plans) >= _PLANS:
                self._plans.clear()
            plan = self._plans[signature] = self._sort(sizes, view(packet))
        return plan

    def _sort(self, sizes: tuple[int, ...], frames: npt.NDArray[np.void]) -> _Plan:
        counts = [size // FRAME_BYTES for size in sizes]
        bus = np.repeat(np.arange(len(sizes)), counts)
        key = self._bus_base[bus] + np.minimum(frames["can_id"], _NO_ID)
        right = frames["length"] == self._length[key]
        right |= (self._kind[key] == _MODE) & (frames["length"] == MODE_ALONE_BYTES)
        kind = np.where(right, self._kind[key], _UNKNOWN)
        is_error = frames["can_id"] & np.uint32(CAN_ERR_FLAG) != 0
        errors = [(int(bus[row]), row * FRAME_BYTES) for row in np.flatnonzero(is_error).tolist()]
        malformed = frozenset(
            (
                int(self._kind[key[row]]),
                int(self._index[key[row]]),
                int(frames["length"][row]),
                int(self._length[key[row]]),
            )
            for row in np.flatnonzero(~right & (self._kind[key] != _UNKNOWN)).tolist()
        )
        heard = tuple(count > int(is_error[bus == index].sum()) for index, count in enumerate(counts))
        rows = np.flatnonzero(kind == _STATE)
        others = []
        for row in np.flatnonzero(kind > _STATE).tolist():
            start = row * FRAME_BYTES + _DATA
            others.append((int(kind[row]), int(self._index[key[row]]), start, start + int(frames["length"][row])))
        joints = self._index[key[rows]]
        complete = len(np.unique(joints)) == len(self._joints)
        return _Plan(joints, 2 * rows + 1, complete, tuple(others), heard, tuple(errors), malformed or _NONE_MALFORMED)

    def _read_states(self, plan: _Plan, notices: list[Notice]) -> None:
        joints = plan.joints
        if not plan.complete:
            self._silent[joints] = 0
        seen = self._statusword.tobytes()
        if seen == self._decoded:
            return
        statuswords = self._statusword[joints]
        states = STATE_TABLE[statuswords & STATE_BITS]
        # What was handed out before stays as it was: new arrays for what changes.
        self._state = self._state.copy()
        known = states != UNDEFINED
        if np.count_nonzero(known) == len(known):
            self._state[joints] = states
            self._decoded = seen
            return
        self._decoded = b""
        self._state[joints[known]] = states[known]
        for joint, word in zip(joints[~known].tolist(), statuswords[~known].tolist(), strict=True):
            text = f"joint {self._joints[joint]}: statusword {word:#06x} is no state of CiA 402; check the drive"
            notices.append(Notice("drive_fault", "error", text, joint, stops=True))

    def _read_other(self, kind: int, index: int, data: bytes, notices: list[Notice]) -> None:
        if kind in (FORCE, TORQUE):
            if kind == TORQUE or data[0] == sensors.FORCE_TORQUE_START:
                self._force_torque[index].parts[kind] = data
        elif kind in (GYRO, ACCELERATION, QUATERNION):
            if kind != QUATERNION or any(data):
                self._inertial[index].parts[kind] = data
        elif kind == _MODE:
            self._mode = self._mode.copy()
            if len(data) == MODE_ALONE_BYTES:
                self._mode[index] = int.from_bytes(data, "little", signed=True)
            else:
                self._error = self._error.copy()
                self._mode[index], self._error[index] = MODE_STRUCT.unpack(data)
        elif kind == _EMCY:
            notices.append(self._emergency(index, data))
        elif kind == _SDO:
            self._read_answer(index, data)
        elif data[0] != identifiers.HEARTBEAT_OPERATIONAL:
            if data[0] == identifiers.HEARTBEAT_BOOT_UP:
                self._reset.add(index)
            what = (
                "was reset" if data[0] == identifiers.HEARTBEAT_BOOT_UP else f"left OPERATIONAL (NMT state {data[0]})"
            )
            text = f"joint {self._joints[index]}: the drive {what} during operation; restart the HAL to boot it again"
            notices.append(Notice("node_lost", "error", text, index, stops=True))

    def _read_answer(self, index: int, data: bytes) -> None:
        """Take mode and error code from an expedited answer; all other answers are some tool's."""
        command, object_index, subindex = _SDO_HEAD.unpack_from(data)
        if (command, object_index, subindex) == (_ONE_BYTE, MODE_DISPLAY, 0):
            self._mode = self._mode.copy()
            self._mode[index] = int.from_bytes(data[4:5], "little", signed=True)
            self._answered.add(index)
        elif (command, object_index, subindex) == (_TWO_BYTES, ERROR_CODE, 0):
            self._error = self._error.copy()
            self._error[index] = int.from_bytes(data[4:6], "little")

    def _wrong_length(self, kind: int, index: int, length: int, expected: int) -> Notice:
        if kind in _FRAME_NAMES:
            where, joint = f"joint {self._joints[index]}: {_FRAME_NAMES[kind]}", index
        else:
            units: list[ForceTorqueReading | InertialReading] = [
                *(self._force_torque if kind < GYRO else self._inertial)
            ]
            where, joint = f"sensor {units[index].sensor.name}: a frame", None
        text = f"{where} has {length} bytes, expected {expected}"
        stops = kind in (_STATE, _MODE)
        if stops:
            text += "; is its PDO mapping the HAL's?"
        return Notice("frame_length", "error" if stops else "warning", text, joint, stops=stops)

    def _emergency(self, index: int, data: bytes) -> Notice:
        code, register, extra = EMCY_STRUCT.unpack(data)
        name = self._joints[index]
        if code == EmergencyCode.NO_ERROR:
            return Notice("drive_emergency", "info", f"joint {name}: EMCY error reset", index)
        text = f"joint {name}: EMCY {code:#06x} ({emergency_text(code)}), register {register:#04x}"
        text += f", data {extra.hex(' ')}"
        harmless = code in HARMLESS_EMERGENCIES
        return Notice("drive_emergency", "warning" if harmless else "error", text, index, stops=not harmless)

    def _fill_table(self, robot: RobotDescription) -> None:
        for index, joint in enumerate(robot.joints):
            bus, node = robot.bus_index(joint.drive.bus), joint.drive.node_id
            self._claim(bus, identifiers.TPDO1 + node, _STATE, index, TPDO_STATE.size, joint.name)
            self._claim(bus, identifiers.TPDO2 + node, _MODE, index, TPDO_MODE.size, joint.name)
            self._claim(bus, identifiers.EMCY + node, _EMCY, index, EMCY_STRUCT.size, joint.name)
            self._claim(bus, identifiers.HEARTBEAT + node, _HEARTBEAT, index, 1, joint.name)
            self._claim(bus, identifiers.SDO_TX + node, _SDO, index, 8, joint.name)
        for index, sensor in enumerate(robot.force_torque_sensors):
            bus = robot.bus_index(sensor.bus)
            self._claim(bus, sensor.can_id, FORCE, index, 8, sensor.name)
            self._claim(bus, sensor.can_id + 1, TORQUE, index, 8, sensor.name)
        for index, imu in enumerate(robot.imus):
            bus = robot.bus_index(imu.bus)
            self._claim(bus, imu.base_id + sensors.GYRO_ID, GYRO, index, 6, imu.name)
            self._claim(bus, imu.base_id + sensors.ACCELERATION_ID, ACCELERATION, index, 6, imu.name)
            self._claim(bus, imu.base_id + sensors.QUATERNION_ID, QUATERNION, index, 8, imu.name)

    def _claim(self, bus: int, can_id: int, kind: int, index: int, length: int, owner: str) -> None:
        row = bus * _ANY_BUS + can_id
        if self._kind[row] != _UNKNOWN:
            raise HalError(
                f"{owner}: identifier {can_id:#05x} is used twice on its bus; give it another node or base id"
            )
        self._kind[row], self._index[row], self._length[row] = kind, index, length


def upload_request(node_id: int, index: int) -> bytes:
    """Frame that asks a node for an object by SDO; `Measured.answered` tells of the answer to 0x6061."""
    return pack(identifiers.SDO_RX + node_id, _SDO_HEAD.pack(_UPLOAD, index, 0) + bytes(4))
