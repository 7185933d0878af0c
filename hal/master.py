"""The HAL's core on the robot's buses: one verb a stage of the cycle, and every frame kept for the log."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from hal.boot import boot_network
from hal.bus.address import MAX_PACKET
from hal.bus.error_frames import BUS_OFF
from hal.bus.errors import BusDownError, BusStuckError
from hal.bus.gather import PortGroup
from hal.bus.pacing import FRAMES_AHEAD
from hal.bus.ports import DropCounting, FramePort, RecordingPort
from hal.bus.socketcan import SocketCanPort
from hal.cycle import HalCore
from hal.errors import BootError, HalError
from hal.find import FoundNodes, find_nodes
from hal.profile.frames import CAN_ERR_FLAG, FRAME_BYTES, can_ids, pack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from schemas.messages import BusFrames, JointCommand, RobotState
from schemas.robot import RobotDescription

BOOT_SEQUENCE: Final = -1
OPERATIONAL: Final = 5
"""NMT state in a heartbeat."""
HEARTBEAT_SHARE: Final = 0.5
"""Of the heartbeat's period: the wall-clock time after which other makers' drives get the next one at the latest."""


class Master:
    """Runs a robot's cycle: `boot` once, then `sync`, `gather`, `apply`, `frames` for each sequence number.

    Raises (any method):
        BusLostError: a bus is gone; no frame can reach the robot any more and its drives hold by themselves.

    """

    def __init__(self, robot: RobotDescription, ports: Sequence[FramePort], session: str | None = None) -> None:
        self.core = HalCore(robot, session)
        self._robot = robot
        self._ports = [RecordingPort(port) for port in ports]
        self._counting = [
            (bus.name, port)
            for bus, port in zip(robot.buses, ports, strict=False)  # the boot refuses a wrong number
            if isinstance(port, DropCounting)
        ]
        self._found: FoundNodes | None = None
        self._down = [False] * len(ports)
        paced = any(isinstance(port, SocketCanPort) and port.paced for port in ports)
        self._turn_bytes = FRAMES_AHEAD * FRAME_BYTES if paced else MAX_PACKET
        """Sent on one bus before the next has its turn: while one paces its burst, the wires of the others carry on."""
        self._group = PortGroup(self._ports)
        self._sync = pack(SYNC, b"")
        self._heartbeat = pack(HEARTBEAT + HAL_NODE_ID, bytes([OPERATIONAL]))
        self._heartbeat_cycles = max(1, round(robot.safety.heartbeat_s * robot.rate_hz))
        self._heartbeat_due = 0
        """Sequence from which on the next heartbeat is sent: SYNCs may be left out."""
        self._foreign = False
        """Some drive lives in wall-clock time, however slow a lockstep cycle is, and wants its heartbeats there."""
        self._heartbeat_due_s = 0.0
        self._received: list[list[bytes]] = [[] for _ in ports]
        self._missing: list[set[int]] = [set() for _ in ports]

    def find(self, timeout_s: float) -> None:
        """Look for all nodes and see that they are those described; nothing is enabled.

        Raises:
            BootError: nodes missing or wrong; the message lists them.
            BusDownError: an interface went down.

        """
        try:
            self._found = find_nodes(self._robot, self._ports, timeout_s)
        except BootError as error:
            raise self._reason(error) from error

    def boot(self, timeout_s: float) -> tuple[str, ...]:
        """Configure and enable every drive, holding where it stands; returns what is worth knowing of them.

        Raises:
            BootError: nodes missing, wrong or unwilling; the message lists them.
            BusDownError: an interface went down.

        """
        try:
            report = boot_network(self._robot, self._ports, timeout_s, self._found)
        except BootError as error:
            raise self._reason(error) from error
        foreign = frozenset(index for index, drive in enumerate(report.drives) if drive.foreign)
        self._foreign = bool(foreign)
        self.core.start(np.array(report.position_measured), foreign)
        return report.notes

    def sync(self, sequence: int) -> None:
        """Send SYNC on every bus, the HAL's heartbeat before it when one is due.

        What waits from before is taken first: it is decoded with this cycle's reports, but answers no SYNC to come.
        """
        for received in self._received:
            received.clear()
        self._take_waiting()
        packet = self._sync
        if sequence >= self._heartbeat_due or (self._foreign and time.monotonic() >= self._heartbeat_due_s):
            self._heartbeat_due = sequence + self._heartbeat_cycles
            self._heartbeat_due_s = time.monotonic() + HEARTBEAT_SHARE * self._robot.safety.heartbeat_s
            packet = self._heartbeat + self._sync
        for index in range(len(self._ports)):
            self._send(index, packet)

    def gather(self, sequence: int, timeout_s: float) -> RobotState:
        """Await all reports of this SYNC, up to a time, and decode them; what is missing becomes an event."""
        self._missing = [set(expected) for expected in self.core.expected_reports]
        if any(self._missing):
            self._await_reports(timeout_s)
        else:
            self._take_waiting()
        return self.core.decode(sequence, [b"".join(received) for received in self._received])

    def apply(self, command: JointCommand | None) -> None:
        """Send the RPDOs that the core makes of a command, or of its absence."""
        packets = self.core.apply(command)
        for start in range(0, max(map(len, packets)), self._turn_bytes):
            for index, packet in enumerate(packets):
                if part := packet[start : start + self._turn_bytes]:
                    self._send(index, part)

    def keep_alive(self) -> None:
        """Send a heartbeat when other makers' drives want one by the wall clock; for whoever waits long."""
        now = time.monotonic()
        if self._foreign and now >= self._heartbeat_due_s:
            self._heartbeat_due_s = now + HEARTBEAT_SHARE * self._robot.safety.heartbeat_s
            for index in range(len(self._ports)):
                self._send(index, self._heartbeat)

    def drops(self) -> list[tuple[str, dict[str, int]]]:
        """Name the buses whose interfaces or sockets have dropped frames since the last call, with the counts."""
        return [(name, rises) for name, port in self._counting if (rises := port.drops())]

    def frames(self, sequence: int) -> list[BusFrames]:
        """All frames since the last call, bus by bus."""
        time_ns = max(sequence, 0) * self._robot.period_ns
        messages = []
        for bus, port in zip(self._robot.buses, self._ports, strict=True):
            sent, received = port.take()
            messages.append(BusFrames(sequence=sequence, time_ns=time_ns, bus=bus.name, sent=sent, received=received))
        return messages

    def close(self) -> None:
        """Leave the buses."""
        self._group.close()

    def _await_reports(self, timeout_s: float) -> None:
        if not self._foreign:
            self._group.gather(self._take, timeout_s)
            return
        deadline = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            remaining = max(0.0, deadline - now)
            if self._group.gather(self._take, min(remaining, max(0.0, self._heartbeat_due_s - now))) or not remaining:
                return
            self.keep_alive()

    def _take_waiting(self) -> None:
        for index, frames in self._group.receive(0.0):
            self._take(index, frames)

    def _take(self, index: int, packet: bytes) -> bool:
        """Keep what came on a bus; whether nothing is awaited any more on any."""
        missing = self._missing[index]
        down = self._ports[index].down
        if packet:
            self._received[index].append(packet)
            identifiers = can_ids(packet)
            missing.difference_update(identifiers)
            if max(identifiers) >= CAN_ERR_FLAG and any(map(_is_bus_off, identifiers)):
                missing.clear()
        if down is not None or not packet:  # the interface has just gone down; what came before may be with it
            self._lose(index, down or f"bus {self._ports[index].name}: the interface went down")
            missing.clear()
        return not any(self._missing)

    def _send(self, index: int, packet: bytes) -> None:
        """Send on a bus; one that takes nothing now is told to the core, and tried again the next time."""
        try:
            self._ports[index].send(packet)
        except BusStuckError as error:
            self._lose(index, str(error))
        else:
            if self._down[index]:
                self._down[index] = False
                self.core.set_bus_down(index, None)

    def _lose(self, index: int, reason: str) -> None:
        self._down[index] = True
        self.core.set_bus_down(index, reason)

    def _reason(self, error: BootError) -> HalError:
        """Tell of an interface that is down rather than of the nodes behind it."""
        reasons = [reason for port in self._ports if (reason := port.down) is not None]
        return BusDownError("; ".join(reasons)) if reasons else error


def _is_bus_off(identifier: int) -> bool:
    return bool(identifier & CAN_ERR_FLAG and identifier & BUS_OFF)
