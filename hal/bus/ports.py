"""Ports: one face for every bus, packets of `struct can_frame` in and out."""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import can

from hal.bus.address import MAX_PACKET, connect
from hal.bus.can_frame import decode, encode, split
from hal.bus.errors import (
    BusDownError,
    BusError,
    BusLostError,
    BusOverflowError,
    BusStuckError,
    BusUnavailableError,
)
from hal.bus.socketcan import ROOM_S, open_socketcan
from hal.profile.frames import FRAME_BYTES
from schemas.robot import Bus

NO_DESCRIPTOR = -1
_NOW = socket.MSG_DONTWAIT


class FramePort(Protocol):
    """A bus as its user sees it; one thread uses a port."""

    name: str

    @property
    def down(self) -> str | None:
        """Why the bus takes and gives no frames now although it may come back, each outage at least once; else None."""

    def send(self, frames: bytes) -> None:
        """Send n × 16 bytes.

        Raises:
            BusLostError: the bus is gone for good.
            BusStuckError: it takes no frames now; `BusDownError` or `BusOverflowError`.

        """

    def receive(self, timeout_s: float) -> bytes:
        """All that waits (n × 16 bytes), b"" after `timeout_s` [s] or while `down`; BusLostError when it is gone."""

    def fileno(self) -> int:
        """Descriptor that is readable when frames wait, or `NO_DESCRIPTOR` when the port must be asked."""

    def close(self) -> None:
        """Leave the bus."""


@runtime_checkable
class DropCounting(Protocol):
    """A port that knows of frames lost on their way."""

    def drops(self) -> dict[str, int]:
        """Counters that have risen since the last call, and by how much."""


class CosimPort:
    """A client of a virtual bus, whole packets at a time.

    Raises:
        BusUnavailableError: nobody hosts the bus within `connect_timeout_s` [s].

    """

    down: str | None = None

    def __init__(self, name: str, channel: str | os.PathLike[str], connect_timeout_s: float = 2.0) -> None:
        self.name = name
        self._socket = connect(channel, connect_timeout_s)

    def send(self, frames: bytes) -> None:
        """Send n × 16 bytes as one packet (several beyond 512 frames)."""
        if len(frames) % FRAME_BYTES:
            raise BusError(f"bus {self.name}: {len(frames)} bytes are not whole frames of {FRAME_BYTES} bytes")
        start = 0
        try:
            for start in range(0, len(frames), MAX_PACKET):
                self._socket.send(frames[start : start + MAX_PACKET], _NOW)
        except BlockingIOError as error:
            raise BusOverflowError(f"bus {self.name}: its host has stopped to read; frames are lost", start) from error
        except OSError as error:
            raise BusLostError(f"bus {self.name} has gone: {error.strerror}") from error

    def receive(self, timeout_s: float) -> bytes:
        """All that waits, b"" after `timeout_s` [s]."""
        packet = self._packet()
        if packet is None:
            if timeout_s <= 0.0 or not select.select((self._socket,), (), (), timeout_s)[0]:
                return b""
            packet = self._packet()
            if packet is None:
                return b""
        packets = []
        try:
            while packet is not None:
                packets.append(packet)
                packet = self._packet()
        except BusLostError:
            # What was read before the end is still good; the next call finds the bus gone again and says so.
            pass
        return b"".join(packets)

    def fileno(self) -> int:
        """Descriptor that is readable when frames wait."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()

    def _packet(self) -> bytes | None:
        try:
            packet = self._socket.recv(MAX_PACKET, _NOW)
        except BlockingIOError:
            return None
        except OSError as error:
            raise BusLostError(f"bus {self.name} has gone: {error.strerror}") from error
        if not packet:
            raise BusLostError(f"bus {self.name} has gone: its host has closed it")
        return packet


class PythonCanPort:
    """Any python-can bus as a port; error and remote frames keep their flags.

    python-can does not tell a full queue from an adapter that was pulled out: an error is a state of the port and not
    its end, so that whoever has other buses goes on with them.
    """

    def __init__(self, name: str, bus: can.BusABC) -> None:
        self.name = name
        self.down: str | None = None
        """Why the last transmission, or reception, failed."""
        self._bus = bus
        try:
            self._descriptor = bus.fileno()
        except NotImplementedError:
            self._descriptor = NO_DESCRIPTOR

    def send(self, frames: bytes) -> None:
        """Send n × 16 bytes, a message each.

        Raises:
            BusDownError: python-can cannot send now; what is left of the packet is lost.
        """
        if len(frames) % FRAME_BYTES:
            raise BusError(f"bus {self.name}: {len(frames)} bytes are not whole frames of {FRAME_BYTES} bytes")
        for number, frame in enumerate(split(frames)):
            try:
                self._bus.send(decode(frame))
            except (can.CanError, OSError) as error:
                self.down = f"bus {self.name}: python-can cannot send: {error}"
                raise BusDownError(self.down, number * FRAME_BYTES) from error
        if frames:
            self.down = None

    def receive(self, timeout_s: float) -> bytes:
        """All that waits, b"" after `timeout_s` [s] or while `down`."""
        received = []
        try:
            message = self._bus.recv(max(0.0, timeout_s))
            while message is not None:
                received.append(encode(message))
                message = self._bus.recv(0.0)
        except (can.CanError, OSError) as error:
            self.down = f"bus {self.name}: python-can cannot receive: {error}"
        return b"".join(received)

    def fileno(self) -> int:
        """Descriptor of the bus, or `NO_DESCRIPTOR` for interfaces that have none."""
        return self._descriptor

    def close(self) -> None:
        """Shut the bus down."""
        self._bus.shutdown()


class DirectPort:
    """Wiring in one process: what is sent is delivered at once, and the answer waits to be received."""

    down: str | None = None

    def __init__(self, name: str, deliver: Callable[[bytes], bytes]) -> None:
        self.name = name
        self._deliver = deliver
        self._waiting = bytearray()

    def send(self, frames: bytes) -> None:
        """Hand n × 16 bytes over and keep the answer."""
        self._waiting += self._deliver(frames)

    def receive(self, timeout_s: float) -> bytes:
        """All answers so far; nothing more can come by waiting."""
        frames = bytes(self._waiting)
        self._waiting.clear()
        return frames

    def fileno(self) -> int:
        """Return `NO_DESCRIPTOR`."""
        return NO_DESCRIPTOR

    def close(self) -> None:
        """Forget what waits."""
        self._waiting.clear()


class RecordingPort:
    """A port that keeps a copy of what passes it, for the log."""

    def __init__(self, port: FramePort) -> None:
        self.name = port.name
        self._port = port
        self._sent: list[bytes] = []
        self._received: list[bytes] = []

    @property
    def down(self) -> str | None:
        """As the port's."""
        return self._port.down

    def send(self, frames: bytes) -> None:
        """Send n × 16 bytes and keep what went out."""
        try:
            self._port.send(frames)
        except BusStuckError as error:
            self._sent.append(frames[: error.sent])
            raise
        self._sent.append(frames)

    def receive(self, timeout_s: float) -> bytes:
        """Receive and keep all that waits."""
        frames = self._port.receive(timeout_s)
        if frames:
            self._received.append(frames)
        return frames

    def take(self) -> tuple[bytes, bytes]:
        """(sent, received) since the last call, each n × 16 bytes in order."""
        taken = b"".join(self._sent), b"".join(self._received)
        self._sent.clear()
        self._received.clear()
        return taken

    def fileno(self) -> int:
        """Return the port's descriptor."""
        return self._port.fileno()

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def open_port(
    bus: Bus,
    connect_timeout_s: float = 2.0,
    filters: Sequence[can.typechecking.CanFilter] | None = None,
    room_s: float = ROOM_S,
) -> FramePort:
    """Open a bus of a robot description: `cosim` and `socketcan` directly, every other interface by python-can.

    Args:
        bus: of the description.
        connect_timeout_s: time [s] for a virtual bus to appear.
        filters: of frames to receive, applied by the kernel (`socketcan`); on other interfaces all frames pass.
        room_s: longest wait [s] for room in a full transmit queue (`socketcan`): the other buses wait as well.

    Raises:
        BusUnavailableError: nobody hosts the virtual bus, the kernel's interface is absent or down, or python-can
            cannot open the interface.

    """
    if bus.interface == "cosim":
        return CosimPort(bus.name, bus.channel, connect_timeout_s)
    if bus.interface == "socketcan":
        return open_socketcan(bus, filters, room_s)
    try:
        return PythonCanPort(bus.name, can.Bus(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate))
    except (can.CanError, OSError, ValueError, ImportError) as error:
        raise BusUnavailableError(f"bus {bus.name}: {bus.interface} {bus.channel} cannot be opened: {error}") from error
