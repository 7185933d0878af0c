"""SocketCAN: the raw socket of a python-can bus, 16 bytes a frame in and out.

python-can opens and configures the socket (error frames on, own messages off, filters); between that and its end no
`can.Message` is made. An interface that goes down, or is taken out, is a state of the port and not its end.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Final, Protocol, cast

import can

from hal.bus.counters import DropCounters
from hal.bus.errors import BusDownError, BusError, BusLostError, BusOverflowError, BusUnavailableError
from hal.bus.pacing import WirePacer
from hal.profile.frames import FRAME_BYTES
from schemas.robot import Bus

ROOM_S: Final = 0.05
"""Wait for room in a full transmit queue where the cycle waits for all; its ten frames take 9 ms at 125 kbit/s."""
ROOM_SHARE: Final = 0.5
"""The same in realtime, as a share of the period: the other buses must have their SYNCs in time."""
ROOM_STEP_S: Final = 0.0002
MOST_FRAMES: Final = 1024
"""Taken in one call of `receive`, so that a flood cannot keep it."""
RECEIVE_BUFFER: Final = 1 << 20
"""[bytes] asked of the kernel, which counts some 1 kB a frame; it may grant less."""
DOWN: Final = frozenset({errno.ENETDOWN, errno.ENETUNREACH, errno.ENODEV, errno.ENXIO})
"""Of an interface that is down or absent, and may come back."""
FULL: Final = frozenset({errno.ENOBUFS, errno.EAGAIN})
SIOCGIFFLAGS: Final = 0x8913
IFF_UP: Final = 0x1
_IFREQ: Final = struct.Struct("16sH22x")
_NOW: Final = socket.MSG_DONTWAIT
_LENGTH: Final = 4


class RawBus(Protocol):
    """What the port uses of python-can's `SocketcanBus`."""

    socket: socket.socket

    def shutdown(self) -> None:
        """Close the socket."""


class Reopen(Protocol):
    """Opens the interface anew, as it was."""

    def __call__(self) -> RawBus:
        """Open it; raises OSError or can.CanError."""


class SocketCanPort:
    """A `FramePort` on a kernel CAN interface."""

    def __init__(
        self,
        name: str,
        channel: str,
        bus: RawBus,
        reopen: Reopen | None = None,
        pacer: WirePacer | None = None,
        room_s: float = ROOM_S,
    ) -> None:
        """Take over an open bus.

        Args:
            name: of the bus in the robot description.
            channel: the interface.
            bus: opened by python-can.
            reopen: opens it again when the interface has been taken out and put in again.
            pacer: of bursts; None where the interface keeps all that it is given.
            room_s: longest wait [s] for room in a full transmit queue.
        """
        self.name = name
        self.channel = channel
        self._bus = bus
        self._reopen = reopen
        self._pacer = pacer
        self._room_s = room_s
        self._socket = bus.socket
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._index = _index_of(channel)
        self._down: str | None = None
        self._told = True
        """The present outage has been reported; an interface may be back before anybody asks."""
        self._full = False
        self._drops = DropCounters(channel, self._socket)

    @property
    def paced(self) -> bool:
        """Bursts wait for the wire."""
        return self._pacer is not None

    @property
    def down(self) -> str | None:
        """Why the interface takes and gives nothing now, each outage at least once; None while it is up."""
        if self._down is not None:
            if self._told:
                self._look_again()
            self._told = True
        return self._down

    def send(self, frames: bytes) -> None:
        """Send n × 16 bytes.

        Raises:
            BusDownError: the interface is down; what is left of the packet is lost.
            BusOverflowError: the transmit queue stays full; likewise.
            BusLostError: the socket is of no more use.
        """
        if len(frames) % FRAME_BYTES:
            raise BusError(f"bus {self.name}: {len(frames)} bytes are not whole frames of {FRAME_BYTES} bytes")
        if (down := self.down) is not None:
            raise BusDownError(down)
        pacer = self._pacer
        for start in range(0, len(frames), FRAME_BYTES):
            frame = frames[start : start + FRAME_BYTES]
            if pacer is not None and (wait := pacer.wait_s(min(frame[_LENGTH], 8), time.monotonic())) > 0.0:
                time.sleep(wait)
            self._send_one(frame, start)

    def receive(self, timeout_s: float) -> bytes:
        """All that waits, b"" after `timeout_s` [s] or when the interface goes down (see `down`)."""
        frames = self._read()
        if frames or timeout_s <= 0.0 or not select.select((self._socket,), (), (), timeout_s)[0]:
            return frames
        return self._read()

    def fileno(self) -> int:
        """Descriptor that is readable when frames wait, or when the interface has gone down; the same for good."""
        return self._socket.fileno()

    def drops(self) -> dict[str, int]:
        """Rises of the interface's and the socket's drop counters since the last call."""
        return self._drops.rises()

    def close(self) -> None:
        """Leave the bus."""
        self._drops.close()
        self._bus.shutdown()

    def _send_one(self, frame: bytes, before: int) -> None:
        deadline: float | None = None
        while True:
            try:
                sent = self._socket.send(frame, _NOW)
            except OSError as error:
                if error.errno not in FULL:
                    raise self._failure(error, before) from error
            else:
                if sent != FRAME_BYTES:
                    raise BusLostError(f"bus {self.name}: {self.channel} took {sent} of {FRAME_BYTES} bytes of a frame")
                self._full = False
                return
            now = time.monotonic()
            # A queue that stayed full once is not waited for again: the other buses must go on.
            deadline = (now if self._full else now + self._room_s) if deadline is None else deadline
            if now >= deadline:
                self._full = True
                raise BusOverflowError(
                    f"bus {self.name}: {self.channel} takes no more frames; does a node acknowledge them?", before
                )
            time.sleep(ROOM_STEP_S)

    def _read(self) -> bytes:
        received: list[bytes] = []
        receive = self._socket.recv
        try:
            for _ in range(MOST_FRAMES):
                received.append(receive(FRAME_BYTES, _NOW))  # noqa: PERF401 - ends by an exception
        except BlockingIOError:
            pass
        except OSError as error:
            failure = self._failure(error, 0)
            if not isinstance(failure, BusDownError):
                raise failure from error
            received.append(self._queued())
        return b"".join(received)

    def _queued(self) -> bytes:
        """Take what came before the interface went down: the kernel reports the outage first, and once."""
        received: list[bytes] = []
        try:
            while len(received) < MOST_FRAMES:
                received.append(self._socket.recv(FRAME_BYTES, _NOW))
        except BlockingIOError:
            pass
        except OSError as error:
            failure = self._failure(error, 0)
            if not isinstance(failure, BusDownError):
                raise failure from error
        return b"".join(received)

    def _failure(self, error: OSError, sent: int) -> BusError:
        if error.errno not in DOWN:
            return BusLostError(f"bus {self.name} has gone: {self.channel}: {error.strerror}")
        absent = error.errno != errno.ENETDOWN and _index_of(self.channel) != self._index
        what = "is gone; is the adapter plugged in?" if absent else f"is down; `ip link set {self.channel} up`"
        if self._down is None:
            self._told = False
        self._down = f"bus {self.name}: interface {self.channel} {what}"
        return BusDownError(self._down, sent)

    def _look_again(self) -> None:
        """Use the interface again when it is back; one that was taken out has another index and needs a new socket."""
        if not _is_up(self._socket, self.channel):
            return
        index = _index_of(self.channel)
        if index != self._index and not self._renew():
            return
        self._index, self._down, self._full = index, None, False

    def _renew(self) -> bool:
        if self._reopen is None:
            return False
        try:
            fresh = self._reopen()
        except (OSError, can.CanError):
            return False  # it went away again; the port stays down, which `down` says
        fresh.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        # Whoever waits on the descriptor goes on to wait on the same number.
        os.dup2(fresh.socket.fileno(), self._socket.fileno(), inheritable=False)
        fresh.shutdown()
        return True


def open_socketcan(
    bus: Bus, filters: Sequence[can.typechecking.CanFilter] | None = None, room_s: float = ROOM_S
) -> SocketCanPort:
    """Open a kernel CAN interface by python-can.

    Args:
        bus: of the robot description; its bit rate paces bursts on hardware, where it must be the interface's own.
        filters: python-can's, applied by the kernel; None lets all frames pass.
        room_s: longest wait [s] for room in a full transmit queue.

    Raises:
        BusUnavailableError: the kernel has no CAN, or the interface is absent or down.
    """
    where = f"bus {bus.name}: socketcan {bus.channel}"

    def open_bus() -> RawBus:
        return cast(RawBus, can.Bus(interface="socketcan", channel=bus.channel, can_filters=filters))

    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW):
            pass
    except OSError as error:
        raise BusUnavailableError(
            f"{where} cannot be opened: {error.strerror}; load the kernel's modules (`modprobe can-raw`), or run in"
            " `cosim can-vm`"
        ) from error
    if not _index_of(bus.channel):
        raise BusUnavailableError(f"{where} cannot be opened: no such interface; `ip link` lists those there are")
    try:
        opened = open_bus()
    except (OSError, can.CanError) as error:
        raise BusUnavailableError(f"{where} cannot be opened: {error}") from error
    if not _is_up(opened.socket, bus.channel):
        opened.shutdown()
        raise BusUnavailableError(
            f"{where} is down; `ip link set {bus.channel} up type can bitrate {bus.bitrate}` (vcan: without type)"
        )
    pacer = WirePacer(bus.bitrate) if is_hardware(bus.channel) else None
    return SocketCanPort(bus.name, bus.channel, opened, open_bus, pacer, room_s)


def is_hardware(interface: str, directory: str = "/sys/class/net") -> bool:
    """Whether a controller with finite buffers stands behind an interface; vcan and vxcan are the kernel's alone."""
    return "/virtual/" not in os.path.realpath(os.path.join(directory, interface))


def _is_up(any_socket: socket.socket, interface: str) -> bool:
    try:
        answer = fcntl.ioctl(any_socket, SIOCGIFFLAGS, _IFREQ.pack(os.fsencode(interface), 0))
    except OSError:
        return False  # absent
    return bool(_IFREQ.unpack(answer)[1] & IFF_UP)


def _index_of(interface: str) -> int:
    """Index of an interface; 0: absent."""
    try:
        return socket.if_nametoindex(interface)
    except OSError:
        return 0
