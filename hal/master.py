"""The HAL's core on the robot's buses: one verb a stage of the cycle, and every frame kept for the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from hal.boot import boot_network
from hal.bus.gather import PortGroup
from hal.bus.ports import FramePort, RecordingPort
from hal.cycle import HalCore
from hal.profile.frames import can_ids, pack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from schemas.messages import BusFrames, JointCommand, RobotState
from schemas.robot import RobotDescription

BOOT_SEQUENCE: Final = -1
OPERATIONAL: Final = 5
"""NMT state in a heartbeat."""


class Master:
    """Runs a robot's cycle: `boot` once, then `sync`, `gather`, `apply`, `frames` for each sequence number.

    Raises (any method):
        BusLostError: a bus is gone; no frame can reach the robot any more and its drives hold by themselves.

    """

    def __init__(self, robot: RobotDescription, ports: Sequence[FramePort], session: str | None = None) -> None:
        self.core = HalCore(robot, session)
        self._robot = robot
        self._ports = [RecordingPort(port) for port in ports]
        self._group = PortGroup(self._ports)
        self._sync = pack(SYNC, b"")
        self._heartbeat = pack(HEARTBEAT + HAL_NODE_ID, bytes([OPERATIONAL]))
        self._heartbeat_cycles = max(1, round(robot.safety.heartbeat_s * robot.rate_hz))
        self._heartbeat_due = 0
        """Sequence from which on the next heartbeat is sent: SYNCs may be left out."""
        self._received: list[list[bytes]] = [[] for _ in ports]
        self._missing: list[set[int]] = [set() for _ in ports]

    def boot(self, timeout_s: float) -> None:
        """Configure and enable every drive, holding where it stands.

        Raises:
            BootError: nodes missing, wrong or unwilling; the message lists them.

        """
        report = boot_network(self._robot, self._ports, timeout_s)
        self.core.start(np.array(report.position_measured))

    def sync(self, sequence: int) -> None:
        """Send SYNC on every bus, the HAL's heartbeat before it when one is due.

        What waits from before is taken first: it is decoded with this cycle's reports, but answers no SYNC to come.
        """
        for received in self._received:
            received.clear()
        for index, frames in self._group.receive(0.0):
            self._received[index].append(frames)
        packet = self._sync
        if sequence >= self._heartbeat_due:
            self._heartbeat_due = sequence + self._heartbeat_cycles
            packet = self._heartbeat + self._sync
        for port in self._ports:
            port.send(packet)

    def gather(self, sequence: int, timeout_s: float) -> RobotState:
        """Await all reports of this SYNC, up to a time, and decode them; what is missing becomes an event."""
        self._missing = [set(expected) for expected in self.core.expected_reports]
        self._group.gather(self._take, timeout_s)
        return self.core.decode(sequence, [b"".join(received) for received in self._received])

    def apply(self, command: JointCommand | None) -> None:
        """Send the RPDOs that the core makes of a command, or of its absence."""
        for port, packet in zip(self._ports, self.core.apply(command), strict=True):
            if packet:
                port.send(packet)

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

    def _take(self, index: int, packet: bytes) -> bool:
        self._received[index].append(packet)
        self._missing[index].difference_update(can_ids(packet))
        return not any(self._missing)
