"""`cosim bus`: name the frames of a bus by joint and object."""

from __future__ import annotations

import json
import os
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass

from deploy.errors import UsageError
from hal.profile import identifiers as cob
from hal.profile import sensors
from hal.profile.cia402 import UndefinedStatuswordError, decode_state
from schemas.robot import RobotDescription

NMT_COMMANDS = {
    cob.NMT_START: "start",
    cob.NMT_STOP: "stop",
    cob.NMT_PRE_OPERATIONAL: "pre-operational",
    cob.NMT_RESET_NODE: "reset node",
    cob.NMT_RESET_COMMUNICATION: "reset communication",
}
NMT_STATES = {
    cob.HEARTBEAT_BOOT_UP: "boot-up",
    cob.HEARTBEAT_STOPPED: "stopped",
    cob.HEARTBEAT_OPERATIONAL: "operational",
    cob.HEARTBEAT_PRE_OPERATIONAL: "pre-operational",
}


@dataclass(frozen=True, slots=True)
class Decoded:
    """What a frame means: `who` sends it or is meant by it, `what` it is, its content in words."""

    who: str
    what: str
    content: str


class FrameNames:
    """Decoder of one bus of a robot; drives' raw units (counts, ‰ of rated torque)."""

    def __init__(self, robot: RobotDescription, bus: str) -> None:
        self._drives = {j.drive.node_id: j.name for j in robot.joints if j.drive.bus == bus}
        self._servos = {j.drive.node_id for j in robot.joints if j.drive.bus == bus and j.drive.kind == "servo"}
        self._sensors: dict[int, tuple[str, str]] = {}
        for sensor in robot.force_torque_sensors:
            if sensor.bus == bus:
                self._sensors[sensor.can_id] = (sensor.name, "F/T 1")
                self._sensors[sensor.can_id + 1] = (sensor.name, "F/T 2")
                self._sensors[sensor.command_id] = (sensor.name, "F/T command")
        for imu in robot.imus:
            if imu.bus == bus:
                self._sensors[imu.base_id + sensors.GYRO_ID] = (imu.name, "gyro")
                self._sensors[imu.base_id + sensors.ACCELERATION_ID] = (imu.name, "acceleration")
                self._sensors[imu.base_id + sensors.QUATERNION_ID] = (imu.name, "orientation")

    def decode(self, can_id: int, data: bytes) -> Decoded:
        """Name one frame; a frame that is nobody's, or of a wrong length, is shown raw."""
        if can_id in self._sensors:
            return Decoded(*self._sensors[can_id], data.hex(" "))
        if can_id == cob.SYNC:
            return Decoded("all", "SYNC", "")
        if can_id == cob.NMT and len(data) == 2:
            return Decoded(self._name(data[1]), "NMT", NMT_COMMANDS.get(data[0], f"0x{data[0]:02X}"))
        node = can_id & 0x7F
        base = can_id - node
        try:
            return self._decode_node(base, node, data)
        except (struct.error, IndexError, UndefinedStatuswordError):
            return Decoded(self._name(node), f"0x{base:03X}", data.hex(" "))

    def _decode_node(self, base: int, node: int, data: bytes) -> Decoded:
        who = self._name(node)
        if base == cob.TPDO1:
            status, counts, torque = struct.unpack("<Hih", data)
            state = decode_state(status).name.lower()
            return Decoded(who, "TPDO1", f"{state}, position {counts}, torque {torque} ‰")
        if base == cob.TPDO2:
            mode, error = struct.unpack("<bH", data)
            return Decoded(who, "TPDO2", f"mode {mode}, error 0x{error:04X}")
        if base == cob.RPDO1 and node in self._servos:
            control, target, limit = struct.unpack("<HiH", data)
            return Decoded(who, "RPDO1", f"control 0x{control:02X}, target {target}, limit {limit} ‰")
        if base == cob.RPDO1:
            control, mode, target = struct.unpack("<Hbi", data)
            return Decoded(who, "RPDO1", f"control 0x{control:02X}, mode {mode}, target {target}")
        if base == cob.RPDO2:
            control, mode, torque = struct.unpack("<Hbh", data)
            return Decoded(who, "RPDO2", f"control 0x{control:02X}, mode {mode}, torque {torque} ‰")
        if base == cob.EMCY:
            code, register, _ = struct.unpack("<HB5s", data)
            return Decoded(who, "EMCY", f"0x{code:04X}, register 0x{register:02X}")
        if base == cob.HEARTBEAT:
            return Decoded(who, "heartbeat", NMT_STATES.get(data[0], f"0x{data[0]:02X}"))
        if base in (cob.SDO_RX, cob.SDO_TX):
            command, index, sub = struct.unpack_from("<BHB", data)
            side = "request" if base == cob.SDO_RX else "answer"
            return Decoded(who, f"SDO {side}", f"0x{index:04X}:{sub:02X} command 0x{command:02X} {data[4:].hex(' ')}")
        return Decoded(who, f"0x{base:03X}", data.hex(" "))

    def _name(self, node: int) -> str:
        if node == 0:
            return "all"
        return "hal" if node == cob.HAL_NODE_ID else self._drives.get(node, f"node {node}")


def watch(
    robot: RobotDescription,
    bus: str | None,
    channel: tuple[str, str] | None,
    count: int | None,
    base_port: int | None,
    show: Callable[[str], None],
    *,
    as_json: bool,
) -> None:
    """Print the frames of a bus until interrupted or `count` are shown.

    Raises:
        UsageError: the robot has no such bus, or no run is there to look at.

    """
    import can

    from deploy.session import choose_session

    known = {b.name: b for b in robot.buses}
    name = bus or robot.buses[0].name
    if name not in known:
        raise UsageError(f"--bus {name}: robot {robot.name} has {', '.join(known)}")
    interface, where = channel or (known[name].interface, known[name].channel)
    if interface == "cosim" and os.sep not in where:
        where = str(os.path.join(choose_session(base_port).directory, where))
    names = FrameNames(robot, name)
    try:
        port = can.Bus(interface=interface, channel=where, bitrate=known[name].bitrate)
    except (can.CanError, OSError) as error:
        raise UsageError(f"{interface}:{where}: {error}") from error
    with port:
        shown = 0
        while count is None or shown < count:
            message = port.recv(1.0)
            if message is None:
                continue
            decoded = names.decode(message.arbitration_id, bytes(message.data))
            if as_json:
                line = {"time_s": message.timestamp, "id": message.arbitration_id, "data": message.data.hex()}
                show(json.dumps(line | {"who": decoded.who, "what": decoded.what, "content": decoded.content}))
            else:
                show(f"{message.arbitration_id:03X}  {decoded.who:<16} {decoded.what:<12} {decoded.content}")
            sys.stdout.flush()
            shown += 1
