"""What a frame of a bus says, in SI units and words: drives by their joints' names, objects by the EDS file's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError

from deploy.bus_layout import (
    ALL,
    HAL,
    METRE_PER_SECOND_SQUARED,
    NEWTON,
    NEWTON_METRE,
    RADIAN,
    RADIAN_PER_SECOND,
    FrameLayout,
    Signal,
    bus_layouts,
    dictionary,
    pdo_signals,
)
from hal.bus.error_frames import decode_error
from hal.errors import ProfileError
from hal.profile import identifiers as cob
from hal.profile import objects, sensors
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, pack
from hal.profile.units import DriveUnits
from schemas.robot import ForceTorqueSensor, RobotDescription

Value = float | int | str | tuple[float, ...]

CONTROLLER: Final = "controller"
"""Who sends error frames: the interface's own CAN controller."""
BUS_ERROR: Final = "bus error"
SUFFIXES: Final = {
    RADIAN: "_rad", NEWTON: "_n", NEWTON_METRE: "_nm", RADIAN_PER_SECOND: "_rad_s", METRE_PER_SECOND_SQUARED: "_m_s2",
}  # fmt: skip
"""Of the names of values in JSON."""
_HEX: Final = frozenset({"control", "error", "command", "maker"})
_SELF_EXPLAINING: Final = frozenset({"state", "control", "nmt_state", "command", "mode"})
_LABELS: Final = {
    "position": "", "torque": "", "target_position": "target", "target_torque": "target", "torque_limit": "limit",
}  # fmt: skip
_ORDINARY: Final = frozenset({"remote", "follows_command"})
"""Flags of a drive that works, left out of the words."""
_REGISTER: Final = "register_"
"""Begins the names of the error register's bits."""
_PDO_RECORDS: Final = range(objects.RPDO_COMMUNICATION, 0x1C00)
_FORCE_DECIMALS, _TORQUE_DECIMALS = 2, 4


@dataclass(frozen=True, slots=True)
class Decoded:
    """What a frame means: `who` sends it or is meant by it, `what` it is, its content in words and as SI values."""

    who: str
    what: str
    content: str
    values: Mapping[str, Value] = field(default_factory=dict)
    """By names with units, e.g. `position_rad`, `torque_nm`."""


class FrameNames:
    """Decoder of one bus of a robot; keeps the first frame of each force/torque sensor until the second."""

    def __init__(self, robot: RobotDescription, bus: str) -> None:
        self._layouts = {layout.can_id: layout for layout in bus_layouts(robot, bus)}
        self._names = {joint.drive.node_id: joint.name for joint in robot.joints if joint.drive.bus == bus}
        self._sensors = {sensor.name: sensor for sensor in robot.force_torque_sensors if sensor.bus == bus}
        self._first: dict[str, bytes] = {}
        units = DriveUnits.of(robot)
        self._objects = {
            joint.drive.node_id: _object_signals(
                float(units.radian_per_count[index]),
                float(units.zero_offset[index]),
                float(units.newton_metre_per_mille[index]),
            )
            for index, joint in enumerate(robot.joints)
            if joint.drive.bus == bus
        }

    def decode(self, can_id: int, data: bytes) -> Decoded:
        """Name one frame; one that is nobody's, or of a wrong length, is shown raw.

        Args:
            can_id: identifier with its flags (`hal.profile.frames.CAN_EFF_FLAG`, …).
            data: at most 8 bytes.
        """
        if can_id & CAN_ERR_FLAG:
            report = decode_error(pack(can_id, data))
            return Decoded(CONTROLLER, BUS_ERROR, str(report), {"class": can_id & ~CAN_ERR_FLAG, "data": data.hex()})
        if can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG):
            what = "29-bit frame" if can_id & CAN_EFF_FLAG else "remote request"
            return Decoded(self._node(can_id & 0x7F) if can_id & CAN_RTR_FLAG else "?", what, data.hex(" "))
        layout = self._layouts.get(can_id)
        if layout is None or layout.length != len(data):
            return self._raw(can_id, data, layout)
        if layout.what in ("SDO request", "SDO answer"):
            return self._sdo(layout, can_id & 0x7F, data)
        if layout.owner in self._sensors and layout.what != "F/T command":
            return self._force_torque(layout, self._sensors[layout.owner], data)
        if layout.what in _INERTIAL:
            return _inertial(layout, data)
        who, signals = layout.owner, layout.signals
        if layout.what == "NMT":
            who, signals = str(layout.signals[1].value(data)), layout.signals[:1]
            who = who if who in (ALL, *self._names.values()) else self._node(data[1])
        values = {_key(signal): signal.value(data) for signal in signals if signal.bits > 1}
        flags = [signal.name for signal in signals if signal.bits == 1 and signal.raw(data)]
        if flags:
            values["flags"] = " ".join(flags)
        texts = [_text(signal, data) for signal in signals if signal.bits > 1 and not _is_idle(signal, data)]
        texts += _flag_texts(flags)
        return Decoded(who, layout.what, ", ".join(texts), values)

    def _raw(self, can_id: int, data: bytes, layout: FrameLayout | None) -> Decoded:
        if layout is not None:
            wrong = f"{data.hex(' ')} ({len(data)} bytes, must be {layout.length})".strip()
            return Decoded(layout.owner, layout.what, wrong)
        node = can_id & 0x7F
        base = can_id - node
        return Decoded(self._node(node) if base else "?", f"0x{base:03X}", data.hex(" "))

    def _node(self, node: int) -> str:
        if node == 0:
            return ALL
        return HAL if node == cob.HAL_NODE_ID else self._names.get(node, f"node {node}")

    def _force_torque(self, layout: FrameLayout, sensor: ForceTorqueSensor, data: bytes) -> Decoded:
        """Force from the first frame, the torque when its second half has come."""
        if layout.what == "F/T 1":
            self._first[sensor.name] = data
            second = bytes(8)
        else:
            second = data
        first = self._first.get(sensor.name) if layout.what == "F/T 1" else self._first.pop(sensor.name, None)
        if first is None:
            return Decoded(sensor.name, layout.what, f"without its first frame: {data.hex(' ')}")
        try:
            force, torque = sensors.decode_force_torque(
                first, second, sensor.force_resolution, sensor.torque_resolution
            )
        except ProfileError:
            return Decoded(sensor.name, layout.what, data.hex(" "))
        if layout.what == "F/T 1":
            return Decoded(
                sensor.name, layout.what, f"force {_triple(force, _FORCE_DECIMALS)} N", {"force_in_sensor_n": force}
            )
        text = f"torque {_triple(torque, _TORQUE_DECIMALS)} N·m"
        text += f", OVERLOAD 0x{data[5]:02X}" if data[5] else ""
        values: dict[str, Value] = {
            "force_in_sensor_n": force,
            "torque_in_sensor_nm": torque,
            "overload": data[5],
        }
        return Decoded(sensor.name, layout.what, text, values)

    def _sdo(self, layout: FrameLayout, node: int, data: bytes) -> Decoded:
        """Expedited transfers and aborts in words (CiA 301 section 7.2.4.3); segments and blocks by their kind."""
        request = layout.can_id == cob.SDO_RX + node
        specifier = data[0] >> 5
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        values: dict[str, Value] = {"index": index, "subindex": subindex}
        name = _object_name(index, subindex)
        if specifier == _ABORT:
            code = int.from_bytes(data[4:], "little")
            reason = SdoAbortedError.CODES.get(code, "unknown code")
            values |= {"transfer": "abort", "abort_code": code}
            return Decoded(layout.owner, layout.what, f"ABORT {name}: {reason} (0x{code:08X})", values)
        kind = (_REQUESTS if request else _ANSWERS).get(specifier)
        if kind is None:
            return Decoded(layout.owner, layout.what, f"{'block' if specifier > _ABORT else 'unknown'} {data.hex(' ')}")
        values["transfer"] = kind
        if "segment" in kind:
            return Decoded(layout.owner, layout.what, f"{kind} {data[1:].hex(' ')}", {"transfer": kind})
        if kind not in ("write", "value"):
            return Decoded(layout.owner, layout.what, f"{kind} {name}", values)
        if not data[0] & 0b10:
            size = int.from_bytes(data[4:], "little")
            return Decoded(layout.owner, layout.what, f"{kind} {name}: {size} bytes in segments", values)
        payload = data[4 : 8 - (data[0] >> 2 & 0b11)] if data[0] & 0b1 else data[4:]
        signal = self._objects.get(node, {}).get(index)
        if signal is not None and signal.bits == 8 * len(payload):
            values[_key(signal)] = signal.value(payload)
            text = _number(signal, payload)
        else:
            value = _integer(index, subindex, payload)
            values["value"] = value if value is not None else payload.hex()
            text = payload.hex(" ") if value is None else f"{value} (0x{int.from_bytes(payload, 'little'):X})"
        return Decoded(layout.owner, layout.what, f"{kind} {name} = {text}", values)


_ABORT: Final = 4
_REQUESTS: Final = {0: "write segment", 1: "write", 2: "read", 3: "read segment"}
_ANSWERS: Final = {0: "value segment", 1: "written segment", 2: "value", 3: "written"}
_INERTIAL: Final = {
    "gyro": (sensors.decode_gyro, "angular_velocity_in_imu_rad_s", "rad/s", 3),
    "acceleration": (sensors.decode_acceleration, "acceleration_in_imu_m_s2", "m/s²", 3),
    "orientation": (sensors.decode_quaternion, "orientation_imu_to_world", "(w x y z)", 4),
}


def _inertial(layout: FrameLayout, data: bytes) -> Decoded:
    decode, key, unit, decimals = _INERTIAL[layout.what]
    try:
        value = decode(data)
    except ProfileError:
        return Decoded(layout.owner, layout.what, data.hex(" "))
    return Decoded(layout.owner, layout.what, f"{_triple(value, decimals)} {unit}", {key: value})


def _triple(values: tuple[float, ...], decimals: int) -> str:
    return f"({', '.join(f'{value:+.{decimals}f}' for value in values)})"


def _object_signals(radian: float, zero: float, newton_metre: float) -> dict[int, Signal]:
    """Signal of each object that some PDO of the profile maps, starting at bit 0: for its value in an SDO."""
    signals = {}
    for pdo in (*objects.TPDOS, *(pdo for kind in objects.RPDOS.values() for pdo in kind)):
        for mapped in pdo.entries:
            alone = objects.Pdo(0, 0, (mapped,))
            signals[mapped >> 16] = pdo_signals(alone, radian, zero, newton_metre)[0]
    word = signals[objects.STATUSWORD]
    signals[objects.STATUSWORD] = Signal(word.name, 0, 16, choices=_StateOf(word.choices))
    return signals


class _StateOf(dict[int, str]):
    """Names of whole statuswords by their lowest seven bits."""

    def get(self, word: int, default: object = None) -> str:
        return super().get(word & 0x7F, f"0x{word:04X}")


def _variable(index: int, subindex: int) -> ODVariable | None:
    # All PDO records of a kind have the objects of the first: CiA 301 sections 7.5.2.35 to 7.5.2.38.
    return dictionary().get_variable(index & ~0x1FF if index in _PDO_RECORDS else index, subindex)


def _object_name(index: int, subindex: int) -> str:
    where = f"0x{index:04X}:{subindex}"
    variable = _variable(index, subindex)
    if variable is None:
        return where
    if index not in _PDO_RECORDS:
        record = dictionary()[index]
        return f"{where} {record.name}" + ("" if record is variable else f": {variable.name}")
    number = (index & 0x1FF) + 1
    kind = "RPDO" if index < objects.TPDO_COMMUNICATION else "TPDO"
    part = "mapping" if index & 0x200 else "communication"
    return f"{where} {kind}{number} {part}: {variable.name}"


def _integer(index: int, subindex: int, payload: bytes) -> int | None:
    variable = _variable(index, subindex)
    if variable is None or len(variable) != 8 * len(payload):
        return None
    value = variable.decode_raw(payload)
    return value if isinstance(value, int) else None


def _is_idle(signal: Signal, data: bytes) -> bool:
    """Tell whether a signal says nothing: the maker's bytes of an emergency that are not used."""
    return signal.name == "maker" and not signal.raw(data)


def _flag_texts(flags: list[str]) -> list[str]:
    register = [flag.removeprefix(_REGISTER) for flag in flags if flag.startswith(_REGISTER)]
    others = [flag.replace("_", " ") for flag in flags if flag not in _ORDINARY and not flag.startswith(_REGISTER)]
    return others + ([f"register {' + '.join(register)}"] if register else [])


def _key(signal: Signal) -> str:
    return signal.name + SUFFIXES.get(signal.unit, "")


def _number(signal: Signal, data: bytes) -> str:
    value = signal.value(data)
    if signal.unit:
        return f"{value:+.{signal.decimals}f} {signal.unit}"
    if isinstance(value, str):
        return f"{value} (0x{signal.raw(data):04X})" if signal.name == "error" and signal.raw(data) else value
    return f"0x{value:0{signal.bits // 4}X}" if signal.name in _HEX else str(value)


def _text(signal: Signal, data: bytes) -> str:
    number = _number(signal, data)
    if isinstance(signal.value(data), str) and (signal.name in _SELF_EXPLAINING or not signal.raw(data)):
        return number
    label = _LABELS.get(signal.name, signal.name.replace("_", " "))
    return f"{label} {number}".strip()
