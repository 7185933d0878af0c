"""From a capture of a robot's buses back to a log: cycles by their SYNCs, and the states that the frames tell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from deploy.bus_cycles import Cycle, CycleGrouper, by_time
from deploy.bus_frames import BOOT, BusFrame
from deploy.errors import DeployError
from hal.decode import Decoder, Measured, Notice
from hal.drivers import DriverGroup
from hal.profile import identifiers as cob
from hal.profile import objects
from hal.profile.cia402 import OperationMode
from hal.profile.firmware import FirmwareGains, dead_zone
from hal.profile.frames import pack, unpack
from hal.profile.units import DriveUnits
from hal.setpoint import HAL_DECIDED, vector
from schemas.base import ControlMode, Model
from schemas.load import Run
from schemas.messages import AppliedCommand, BusFrames, DriveState, Event, HalStatus, RobotState
from schemas.robot import RobotDescription

SERVICE: Final = "capture"
"""`Event.service` of what the frames tell."""
_SDO_VALUE: Final = 0x43
"""Expedited answer of four bytes to a read."""


class CaptureError(DeployError):
    """A capture holds too little to make a log of it."""


def messages_of(frames: Iterable[BusFrame], run: Run) -> Iterator[tuple[str, Model]]:
    """Yield the messages of a log with their topics: `BusFrames` of all cycles, `RobotState`, events of the decoder.

    Measured positions, torques, states, modes, errors and sensors are those that the HAL decoded. What frames do not
    tell: `status` is always active, `applied` is made of the RPDOs (its `sequence` is −1; in torque mode within one ‰
    of rated torque and the smoothing of the dead zone's inverse; servo mode shows where a limit is below the joint's
    own, else it is position mode). What comes before the first SYNC has sequence −1.

    Args:
        frames: of all buses, those of each in its order.
        run: robot and scenario that the log is to state.

    Raises:
        CaptureError: a bus has no frame, there is no SYNC, or a joint's position is never told.

    """
    robot = run.robot.description
    grouper, states = CycleGrouper(robot, run.scenario.clock), _States(robot)
    for frame in by_time(frames):
        for cycle in grouper.add(frame):
            yield from _log(states, cycle, robot)
    missing = [bus.name for bus in robot.buses if bus.name not in grouper.seen]
    if missing:
        raise CaptureError(
            f"no frames of bus {', '.join(missing)}; a log needs all buses of robot {robot.name}"
            " (`cosim bus FILE --bus NAME` shows one alone)"
        )
    for cycle in grouper.finish():
        yield from _log(states, cycle, robot)
    states.check()


def _log(states: _States, cycle: Cycle, robot: RobotDescription) -> Iterator[tuple[str, Model]]:
    for message in states.add(cycle):
        yield ("event" if isinstance(message, Event) else "state"), message
    time_ns = max(cycle.sequence, 0) * robot.period_ns
    for bus in robot.buses:
        frames = BusFrames(
            sequence=cycle.sequence,
            time_ns=time_ns,
            bus=bus.name,
            sent=bytes(cycle.sent[bus.name]),
            received=bytes(cycle.received[bus.name]),
        )
        yield f"bus/{bus.name}", frames


class _States:
    """Decodes the cycles of a capture, once it is known where every joint stands."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._units = DriveUnits.of(robot)
        self._reports_torque = bool(DriverGroup(robot).reports_torque.all())
        self._joints = {(joint.drive.bus, joint.drive.node_id): index for index, joint in enumerate(robot.joints)}
        self._counts: dict[int, int] = {}
        self._modes = dict.fromkeys(range(len(robot.joints)), OperationMode.CSP)
        self._mode_known: set[int] = set()
        self._waiting: list[Cycle] = []
        self._decoder: Decoder | None = None
        self._applied = _Applied(robot)
        self._servo = [joint.drive.kind == "servo" for joint in robot.joints]
        self._shown: tuple[ControlMode, ...] = (ControlMode.POSITION,) * len(robot.joints)
        self._cycles = 0

    def check(self) -> None:
        """Refuse a capture that gave no states.

        Raises:
            CaptureError: no SYNC, or joints whose position is not known.
        """
        if self._decoder is None and self._waiting:
            names = [joint.name for index, joint in enumerate(self._robot.joints) if index not in self._counts]
            raise CaptureError(f"no TPDO1 and no SDO answer tells the position of joint {', '.join(names)}")
        if not self._cycles:
            raise CaptureError("no SYNC on any bus: there are no cycles to decode")

    def add(self, cycle: Cycle) -> Iterator[Model]:
        """Yield the state of a cycle and what else the decoder has to tell; cycles wait for the first positions."""
        if cycle.sequence != BOOT:
            self._waiting.append(cycle)
        if self._decoder is None:
            self._look(cycle)
            if len(self._counts) < len(self._robot.joints) or not self._waiting:
                return
            self._begin()
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            yield from self._decode(each)

    def _look(self, cycle: Cycle) -> None:
        """Note the first position and mode of each joint: by SDO or TPDO, the mode by the first command as well."""
        for bus, packet in cycle.received.items():
            for can_id, data in unpack(bytes(packet)):
                joint = self._joints.get((bus, can_id & 0x7F))
                base = can_id & ~0x7F
                if joint is None:
                    continue
                if base == cob.SDO_TX and data[:4] == _position_answer():
                    self._counts.setdefault(joint, int.from_bytes(data[4:8], "little", signed=True))
                elif base == cob.TPDO1 and len(data) == objects.STATE_STRUCT.size:
                    self._counts.setdefault(joint, objects.STATE_STRUCT.unpack(data)[1])
        for bus, packet in cycle.sent.items():
            for can_id, _ in unpack(bytes(packet)):
                joint = self._joints.get((bus, can_id & 0x7F))
                if joint is not None and can_id & ~0x7F == cob.RPDO2 and joint not in self._mode_known:
                    self._modes[joint] = OperationMode.CST
                if joint is not None and can_id & ~0x7F in (cob.RPDO1, cob.RPDO2):
                    self._mode_known.add(joint)

    def _begin(self) -> None:
        counts = np.array([self._counts[index] for index in range(len(self._robot.joints))], dtype=np.int32)
        positions = self._units.position_from_counts(counts)
        self._applied.begin(vector(positions))
        self._decoder = Decoder(self._robot, positions)
        # A capture may begin long after the drives reported their modes: they are taken for those commanded.
        reports = {bus.name: b"" for bus in self._robot.buses}
        for joint, drive in enumerate(each.drive for each in self._robot.joints):
            data = objects.MODE_STRUCT.pack(self._modes[joint], 0)
            reports[drive.bus] += pack(objects.TPDO_MODE.cob_id(drive.node_id), data)
        self._decoder.decode(list(reports.values()))

    def _decode(self, cycle: Cycle) -> Iterator[Model]:
        assert self._decoder is not None
        self._cycles += 1
        measured = self._decoder.decode([bytes(cycle.received[bus.name]) for bus in self._robot.buses])
        applied = self._applied.latched()
        yield self._state(cycle.sequence, measured, applied)
        for notice in measured.notices:
            yield self._event(cycle.sequence, notice)
        self._applied.take(cycle)

    def _state(self, sequence: int, measured: Measured, applied: AppliedCommand) -> RobotState:
        in_servo = applied.mode is ControlMode.SERVO
        self._shown = tuple(
            ControlMode.TORQUE if mode == OperationMode.CST
            else (ControlMode.SERVO if in_servo and servo else ControlMode.POSITION) if mode == OperationMode.CSP
            else before
            for mode, servo, before in zip(measured.mode.tolist(), self._servo, self._shown, strict=True)
        )  # fmt: skip
        return RobotState(
            sequence=sequence,
            time_ns=sequence * self._robot.period_ns,
            status=HalStatus.ACTIVE,
            position_measured=vector(measured.position),
            motor_torque_measured=vector(measured.motor_torque) if self._reports_torque else None,
            drive_state=tuple(DriveState(state) for state in measured.drive_state.tolist()),
            mode=self._shown,
            error_code=tuple(measured.error_code.tolist()),
            applied=applied,
            wrenches=measured.wrenches,
            imus=measured.imus,
        )

    def _event(self, sequence: int, notice: Notice) -> Event:
        return Event(
            sequence=sequence,
            time_ns=sequence * self._robot.period_ns,
            service=SERVICE,
            kind=notice.kind,
            severity=notice.severity,
            text=notice.text,
            joint=None if notice.joint is None else self._robot.joints[notice.joint].name,
        )


def _position_answer() -> bytes:
    return bytes((_SDO_VALUE, objects.POSITION_ACTUAL & 0xFF, objects.POSITION_ACTUAL >> 8, 0))


class _Applied:
    """What the drives latch, from the RPDOs of the cycle before."""

    def __init__(self, robot: RobotDescription) -> None:
        self._units = DriveUnits.of(robot)
        self._gains = FirmwareGains.of(robot)
        self._full_limit = self._units.per_mille_from_limit(self._gains.torque_limit)
        self._rpdos = {
            (joint.drive.bus, pdo.cob_id(joint.drive.node_id)): (index, pdo)
            for index, joint in enumerate(robot.joints)
            for pdo in objects.RPDOS[joint.drive.kind]
        }
        count = len(robot.joints)
        self._position = np.zeros(count, dtype=np.int32)
        self._torque = np.zeros(count, dtype=np.int16)
        self._limit = self._full_limit.copy()
        self._in_torque = np.zeros(count, dtype=bool)
        self._commanded = np.zeros(count, dtype=bool)
        self._last: AppliedCommand | None = None

    def begin(self, positions: tuple[float, ...]) -> None:
        """Start as the boot leaves the drives: holding in position mode."""
        self._last = AppliedCommand(sequence=HAL_DECIDED, mode=ControlMode.POSITION, position=positions)

    def latched(self) -> AppliedCommand:
        """Return what acts since this SYNC."""
        assert self._last is not None
        return self._last

    def take(self, cycle: Cycle) -> None:
        """Read the commands sent after this cycle's SYNC; they count once every joint has one."""
        for bus, packet in cycle.sent.items():
            for can_id, data in unpack(bytes(packet)):
                joint, pdo = self._rpdos.get((bus, can_id), (0, None))
                if pdo is None or len(data) != pdo.size:
                    continue
                self._commanded[joint] = True
                self._in_torque[joint] = pdo is objects.RPDO_TORQUE
                if pdo is objects.RPDO_TORQUE:
                    self._torque[joint] = objects.TORQUE_STRUCT.unpack(data)[2]
                elif pdo is objects.RPDO_SERVO:
                    _, self._position[joint], self._limit[joint] = objects.SERVO_STRUCT.unpack(data)
                else:
                    self._position[joint] = objects.POSITION_STRUCT.unpack(data)[2]
        if self._commanded.all():
            self._last = self._command()

    def _command(self) -> AppliedCommand:
        if self._in_torque.any():
            effort = self._units.torque_from_per_mille(self._torque)
            torque = dead_zone(effort, self._gains.dead_zone)
            return AppliedCommand(sequence=HAL_DECIDED, mode=ControlMode.TORQUE, torque=vector(torque))
        position = vector(self._units.position_from_counts(self._position))
        if (self._limit < self._full_limit).any():
            limit = vector(self._units.limit_from_per_mille(self._limit))
            return AppliedCommand(sequence=HAL_DECIDED, mode=ControlMode.SERVO, position=position, torque_limit=limit)
        return AppliedCommand(sequence=HAL_DECIDED, mode=ControlMode.POSITION, position=position)
