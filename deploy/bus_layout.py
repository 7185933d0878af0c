"""Layouts of all frames of a bus, signal by signal: what the monitor names and the DBC file states.

They follow from the profile's PDOs (`hal.profile.objects`), the drives' scales (`hal.profile.units`) and the object
types of the EDS file, so a monitor's line, a DBC signal and the HAL's own decoder mean the same number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import canopen
from canopen.objectdictionary import INTEGER8, INTEGER16, INTEGER32, ObjectDictionary, ODVariable

from hal.profile import identifiers as cob
from hal.profile import objects, sensors
from hal.profile.cia402 import STATE_TABLE, UNDEFINED, Controlword, EmergencyCode, ErrorRegister, OperationMode
from hal.profile.units import DriveUnits
from schemas.messages import DriveState
from schemas.robot import ForceTorqueSensor, Imu, Joint, RobotDescription

ALL: Final = "all"
HAL: Final = "hal"

RADIAN: Final = "rad"
NEWTON: Final = "N"
NEWTON_METRE: Final = "N·m"
RADIAN_PER_SECOND: Final = "rad/s"
METRE_PER_SECOND_SQUARED: Final = "m/s²"

NMT_COMMANDS: Final[Mapping[int, str]] = {
    cob.NMT_START: "start",
    cob.NMT_STOP: "stop",
    cob.NMT_PRE_OPERATIONAL: "pre-operational",
    cob.NMT_RESET_NODE: "reset node",
    cob.NMT_RESET_COMMUNICATION: "reset communication",
}
NMT_STATES: Final[Mapping[int, str]] = {
    cob.HEARTBEAT_BOOT_UP: "boot-up",
    cob.HEARTBEAT_STOPPED: "stopped",
    cob.HEARTBEAT_OPERATIONAL: "operational",
    cob.HEARTBEAT_PRE_OPERATIONAL: "pre-operational",
}


def _words(name: str) -> str:
    return name.lower().replace("_", " ")


DRIVE_STATES: Final[Mapping[int, str]] = {
    bits: _words(DriveState(int(STATE_TABLE[bits & 0x6F])).name)
    for bits in range(0x80)
    if int(STATE_TABLE[bits & 0x6F]) != UNDEFINED
}
"""By the lowest seven bits of the statusword, voltage enabled (bit 4) either way."""
MODES: Final[Mapping[int, str]] = {int(mode): mode.name for mode in OperationMode}
CONTROLWORDS: Final[Mapping[int, str]] = {int(word): _words(word.name) for word in Controlword}
EMERGENCIES: Final[Mapping[int, str]] = {int(code): _words(code.name) for code in EmergencyCode}
SENSOR_COMMANDS: Final[Mapping[int, str]] = {sensors.FORCE_TORQUE_START: "start", sensors.FORCE_TORQUE_STOP: "stop"}


@dataclass(frozen=True, slots=True)
class Signal:
    """A number in a frame: value = offset + scale · raw, in `unit`.

    `start` counts bits from the first byte's lowest; a big-endian signal is whole bytes, `start` bit 0 of its first.
    """

    name: str
    start: int
    bits: int
    signed: bool = False
    big_endian: bool = False
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    choices: Mapping[int, str] = field(default_factory=dict)
    """What raw values are called."""

    def raw(self, data: bytes) -> int:
        """Integer on the bus."""
        if self.big_endian:
            first = self.start // 8
            return int.from_bytes(data[first : first + self.bits // 8], "big", signed=self.signed)
        value = int.from_bytes(data, "little") >> self.start & (1 << self.bits) - 1
        return value - (1 << self.bits) if self.signed and value >> (self.bits - 1) else value

    def value(self, data: bytes) -> float | int | str:
        """Give the number in `unit`, the name of a choice, or the integer where there is neither."""
        raw = self.raw(data)
        if self.unit:
            return self.offset + raw * self.scale
        return self.choices.get(raw, raw)

    @property
    def decimals(self) -> int:
        """Decimals that show one count, two at least."""
        return max(2, math.ceil(-math.log10(abs(self.scale))))


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """One kind of frame: identifier, who sends and who reads it, data length and signals."""

    can_id: int
    what: str
    owner: str
    """Joint or sensor that it is of; `ALL` for NMT and SYNC, `HAL` for the HAL's heartbeat."""
    from_hal: bool
    length: int
    signals: tuple[Signal, ...] = ()
    comment: str = ""
    cyclic: bool = False
    """Once a cycle."""


@dataclass(frozen=True, slots=True)
class _Scales:
    """One joint's, from `DriveUnits`."""

    radian: float
    zero: float
    newton_metre: float


def bus_layouts(robot: RobotDescription, bus: str) -> tuple[FrameLayout, ...]:
    """All frames that the profile puts on one bus of a robot, in the order of joints and sensors."""
    units = DriveUnits.of(robot)
    on_bus = [(index, joint) for index, joint in enumerate(robot.joints) if joint.drive.bus == bus]
    nodes = {0: ALL, **{joint.drive.node_id: joint.name for _, joint in on_bus}}
    layouts = [
        FrameLayout(cob.SYNC, "SYNC", ALL, from_hal=True, length=0, cyclic=True),
        FrameLayout(
            cob.NMT, "NMT", ALL, from_hal=True, length=2,
            signals=(Signal("command", 0, 8, choices=NMT_COMMANDS), Signal("node", 8, 8, choices=nodes)),
        ),
        _heartbeat(HAL, cob.HAL_NODE_ID),
    ]  # fmt: skip
    for index, joint in on_bus:
        scales = _Scales(
            float(units.radian_per_count[index]),
            float(units.zero_offset[index]),
            float(units.newton_metre_per_mille[index]),
        )
        layouts += _drive(joint, scales)
    for sensor in robot.force_torque_sensors:
        if sensor.bus == bus:
            layouts += _force_torque(sensor)
    for imu in robot.imus:
        if imu.bus == bus:
            layouts += _imu(imu)
    return tuple(layouts)


def pdo_signals(pdo: objects.Pdo, radian: float, zero: float, newton_metre: float) -> tuple[Signal, ...]:
    """Signals of a PDO, from its mapping.

    Args:
        pdo: the mapping.
        radian: [rad] a count, signed by the joint's direction.
        zero: [rad] at zero counts.
        newton_metre: [N·m] at the joint a ‰ of rated torque, signed.
    """
    scales, signals, start = _Scales(radian, zero, newton_metre), [], 0
    for mapped in pdo.entries:
        index, bits = mapped >> 16, mapped & 0xFF
        signals += _object_signals(index, start, bits, scales)
        start += bits
    return tuple(signals)


@lru_cache(maxsize=1)
def dictionary() -> ObjectDictionary:
    """Objects of the drive's EDS file."""
    return canopen.import_od(objects.eds_path())


def _object_signals(index: int, start: int, bits: int, scales: _Scales) -> list[Signal]:
    if index == objects.STATUSWORD:
        flags = {
            7: "warning", 8: "manufacturer_bit", 9: "remote", 10: "target_reached", 11: "internal_limit",
            12: "follows_command", 13: "bit_13", 14: "bit_14", 15: "bit_15",
        }  # fmt: skip
        state = Signal("state", start, 7, choices=DRIVE_STATES)
        return [state, *(Signal(name, start + bit, 1) for bit, name in flags.items())]
    name, kind = _OBJECTS[index]
    variable = dictionary()[index]
    signed = isinstance(variable, ODVariable) and variable.data_type in (INTEGER8, INTEGER16, INTEGER32)
    if kind == RADIAN:
        return [Signal(name, start, bits, signed, scale=scales.radian, offset=scales.zero, unit=RADIAN)]
    if kind == NEWTON_METRE:
        # A limit (unsigned) bounds the magnitude: it has no direction.
        scale = scales.newton_metre if signed else abs(scales.newton_metre)
        return [Signal(name, start, bits, signed, scale=scale, unit=NEWTON_METRE)]
    return [Signal(name, start, bits, signed, choices=_CHOICES[index])]


_OBJECTS: Final[Mapping[int, tuple[str, str]]] = {
    objects.POSITION_ACTUAL: ("position", RADIAN),
    objects.TORQUE_ACTUAL: ("torque", NEWTON_METRE),
    objects.TARGET_POSITION: ("target_position", RADIAN),
    objects.TARGET_TORQUE: ("target_torque", NEWTON_METRE),
    objects.MAX_TORQUE: ("torque_limit", NEWTON_METRE),
    objects.CONTROLWORD: ("control", ""),
    objects.MODE: ("mode", ""),
    objects.MODE_DISPLAY: ("mode", ""),
    objects.ERROR_CODE: ("error", ""),
}
_CHOICES: Final[Mapping[int, Mapping[int, str]]] = {
    objects.CONTROLWORD: CONTROLWORDS,
    objects.MODE: MODES,
    objects.MODE_DISPLAY: MODES,
    objects.ERROR_CODE: EMERGENCIES,
}


def _drive(joint: Joint, scales: _Scales) -> list[FrameLayout]:
    node, name = joint.drive.node_id, joint.name
    layouts = []
    for pdo in objects.TPDOS:
        signals = pdo_signals(pdo, scales.radian, scales.zero, scales.newton_metre)
        if joint.drive.kind == "position_pd":  # it measures no torque, whatever its object 0x6077 holds
            signals = tuple(signal for signal in signals if signal.name != "torque")
        cyclic = pdo.transmission_type == objects.TransmissionType.EVERY_SYNC
        layouts.append(
            FrameLayout(pdo.cob_id(node), f"TPDO{pdo.number + 1}", name, False, pdo.size, signals, cyclic=cyclic)
        )
    for pdo in objects.RPDOS[joint.drive.kind]:
        signals = pdo_signals(pdo, scales.radian, scales.zero, scales.newton_metre)
        comment = "before the current's dead zone" if pdo is objects.RPDO_TORQUE else ""
        layouts.append(
            FrameLayout(pdo.cob_id(node), f"RPDO{pdo.number + 1}", name, True, pdo.size, signals, comment, cyclic=True)
        )
    flags = [
        Signal(f"register_{_words(flag.name or '')}", 16 + bit, 1)
        for flag in ErrorRegister
        for bit in [int(flag).bit_length() - 1]
    ]
    code = Signal("error", 0, 16, choices=EMERGENCIES)
    layouts.append(FrameLayout(cob.EMCY + node, "EMCY", name, False, 8, (code, *flags, Signal("maker", 24, 40))))
    layouts.append(_heartbeat(name, node))
    sdo = (Signal("command", 0, 8), Signal("index", 8, 16), Signal("subindex", 24, 8), Signal("data", 32, 32))
    layouts.append(FrameLayout(cob.SDO_RX + node, "SDO request", name, True, 8, sdo))
    layouts.append(FrameLayout(cob.SDO_TX + node, "SDO answer", name, False, 8, sdo))
    return layouts


def _heartbeat(owner: str, node: int) -> FrameLayout:
    state = Signal("nmt_state", 0, 8, choices=NMT_STATES)
    return FrameLayout(cob.HEARTBEAT + node, "heartbeat", owner, owner == HAL, 1, (state,))


def _big(name: str, first: int, size: int, scale: float, unit: str, signed: bool = True) -> Signal:
    return Signal(name, 8 * first, 8 * size, signed, big_endian=True, scale=scale, unit=unit)


def _force_torque(sensor: ForceTorqueSensor) -> list[FrameLayout]:
    force, torque = sensor.force_resolution, sensor.torque_resolution
    first = (
        Signal("mark", 0, 8),
        *(_big(f"force_{axis}", 1 + 2 * number, 2, force, NEWTON) for number, axis in enumerate("xyz")),
        _big("torque_x_high", 7, 1, 256 * torque, NEWTON_METRE),
    )
    second = (
        _big("torque_x_low", 0, 1, torque, NEWTON_METRE, signed=False),
        *(_big(f"torque_{axis}", 1 + 2 * number, 2, torque, NEWTON_METRE) for number, axis in enumerate("yz")),
        Signal("overload", 40, 8),
    )
    split = "torque x = torque_x_high of the first frame + torque_x_low of the second"
    command = (Signal("command", 0, 8, choices=SENSOR_COMMANDS),)
    name = sensor.name
    return [
        FrameLayout(sensor.can_id, "F/T 1", name, False, 8, first, split, cyclic=True),
        FrameLayout(sensor.can_id + 1, "F/T 2", name, False, 8, second, split, cyclic=True),
        FrameLayout(sensor.command_id, "F/T command", name, True, 8, command),
    ]


def _imu(imu: Imu) -> list[FrameLayout]:
    def triple(name: str, scale: float, unit: str) -> tuple[Signal, ...]:
        return tuple(_big(f"{name}_{axis}", 2 * number, 2, scale, unit) for number, axis in enumerate("xyz"))

    gyro = triple("angular_velocity", sensors.GYRO_RESOLUTION, RADIAN_PER_SECOND)
    acceleration = triple("acceleration", sensors.ACCELERATION_RESOLUTION, METRE_PER_SECOND_SQUARED)
    quaternion = tuple(
        Signal(f"orientation_{axis}", 16 * number, 16, True, big_endian=True, scale=sensors.QUATERNION_RESOLUTION)
        for number, axis in enumerate("wxyz")
    )
    base, name = imu.base_id, imu.name
    return [
        FrameLayout(base + sensors.GYRO_ID, "gyro", name, False, 6, gyro, cyclic=True),
        FrameLayout(base + sensors.ACCELERATION_ID, "acceleration", name, False, 6, acceleration, cyclic=True),
        FrameLayout(base + sensors.QUATERNION_ID, "orientation", name, False, 8, quaternion, cyclic=True),
    ]
