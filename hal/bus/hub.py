"""The virtual CAN bus: one process hosts it, any number of clients send and receive `struct can_frame` packets.

Every packet on the AF_UNIX SOCK_SEQPACKET socket holds one or more 16-byte frames. The host forwards each packet to all
other clients in the order in which it reads them, so that all nodes see one order of frames, as on a wire.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Thread

from hal.bus.address import ECHO_OPTION, MAX_PACKET, enlarge_buffers, listen, socket_path
from hal.bus.errors import BusError, BusLostError
from hal.profile.frames import FRAME_BYTES

PACKETS_A_TURN = 64
"""Packets read from one client before the others have their turn."""
_NOW = socket.MSG_DONTWAIT


class _Client:
    __slots__ = ("dropped_frames", "echo", "socket")

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.echo = False
        self.dropped_frames = 0


class BusHub:
    """Host of one virtual bus, and a `FramePort` of it: no thread, it forwards while its owner receives.

    `dropped_frames` counts frames that a slow client did not get, `malformed_packets` packets that
    were not whole frames.

    Raises:
        BusInUseError: another process serves this channel.
        BusUnavailableError: the socket cannot be bound there.

    """

    down: str | None = None

    def __init__(self, channel: str | os.PathLike[str], name: str | None = None) -> None:
        self.path = socket_path(channel)
        self.name = name or os.fspath(channel)
        self.dropped_frames = 0
        self.malformed_packets = 0
        self._listener = listen(self.path)
        self._inode = os.stat(self.path).st_ino
        self._epoll = select.epoll()
        self._epoll.register(self._listener, select.EPOLLIN)
        self._listener_fd = self._listener.fileno()
        self._clients: dict[int, _Client] = {}
        self._closed = False

    @property
    def clients(self) -> int:
        """Number of clients connected."""
        return len(self._clients)

    def fileno(self) -> int:
        """Descriptor that is readable when `receive` has something to do."""
        return self._epoll.fileno()

    def send(self, frames: bytes) -> None:
        """Put frames (n × 16 bytes) on the bus: to every client, never waiting for one.

        Raises:
            BusError: not whole frames, or the hub is closed.

        """
        if len(frames) % FRAME_BYTES:
            raise BusError(f"bus {self.name}: {len(frames)} bytes are not whole frames of {FRAME_BYTES} bytes")
        if self._closed:
            raise BusLostError(f"bus {self.name}: the hub is closed")
        for start in range(0, len(frames), MAX_PACKET):
            self._deliver(frames[start : start + MAX_PACKET], None)

    def receive(self, timeout_s: float) -> bytes:
        """All frames that clients have sent (n × 16 bytes), after forwarding them; b"" after `timeout_s` [s].

        Raises:
            BusLostError: the hub is closed.

        """
        deadline = time.monotonic() + timeout_s
        while True:
            frames = self.poll()
            if frames:
                return frames
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                return b""
            select.select([self._epoll], [], [], remaining)

    def poll(self) -> bytes:
        """As `receive`, without waiting."""
        if self._closed:
            raise BusLostError(f"bus {self.name}: the hub is closed")
        received = []
        for descriptor, _ in self._epoll.poll(0):
            if descriptor == self._listener_fd:
                self._accept()
            elif descriptor in self._clients:
                received.append(self._read(descriptor))
        return b"".join(received)

    def close(self) -> None:
        """Disconnect all clients and remove the socket file; may be called twice."""
        if self._closed:
            return
        self._closed = True
        with suppress(FileNotFoundError):
            if os.stat(self.path).st_ino == self._inode:
                os.unlink(self.path)
        for descriptor in tuple(self._clients):
            self._drop(descriptor)
        self._epoll.close()
        self._listener.close()

    def __enter__(self) -> BusHub:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            connection.setblocking(False)
            enlarge_buffers(connection)
            self._clients[connection.fileno()] = _Client(connection)
            self._epoll.register(connection, select.EPOLLIN)

    def _read(self, descriptor: int) -> bytes:
        client = self._clients[descriptor]
        received = []
        for _ in range(PACKETS_A_TURN):
            try:
                packet = client.socket.recv(MAX_PACKET + FRAME_BYTES, _NOW)
            except BlockingIOError:
                break
            except ConnectionResetError:
                # The client left without reading all; what it had sent before still waits behind this error.
                continue
            if not packet:
                self._drop(descriptor)
                break
            if packet == ECHO_OPTION:
                client.echo = True
            elif len(packet) % FRAME_BYTES or len(packet) > MAX_PACKET:
                self.malformed_packets += 1
            else:
                received.append(packet)
        # Whoever had connected before these were sent may still wait to be accepted, and is owed them.
        self._accept()
        for packet in received:
            self._deliver(packet, client)
        return received[0] if len(received) == 1 else b"".join(received)

    def _deliver(self, packet: bytes, sender: _Client | None) -> None:
        gone = []
        for descriptor, client in self._clients.items():
            if client is sender and not client.echo:
                continue
            try:
                client.socket.send(packet, _NOW)
            except (BlockingIOError, InterruptedError):
                client.dropped_frames += len(packet) // FRAME_BYTES
                self.dropped_frames += len(packet) // FRAME_BYTES
            except OSError:
                # What it sent before it left is still to be read, so a client with unread packets stays until then.
                if not _readable(client.socket):
                    gone.append(descriptor)
        for descriptor in gone:
            self._drop(descriptor)

    def _drop(self, descriptor: int) -> None:
        client = self._clients.pop(descriptor)
        self._epoll.unregister(descriptor)
        client.socket.close()


class HubGroup:
    """Several buses of one host, waited for together."""

    def __init__(self, hubs: Sequence[BusHub]) -> None:
        self.hubs = tuple(hubs)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._indices = {hub.fileno(): index for index, hub in enumerate(self.hubs)}
        self._descriptors = [*self._indices, self._wake]

    def wait(self, timeout_s: float | None) -> list[tuple[int, bytes]]:
        """Wait for frames on any bus: (index, n × 16 bytes) of each that has some.

        Returns an empty list after `timeout_s` [s] (None waits without end) or as soon as `interrupt` was called.

        Raises:
            BusLostError: a hub is closed.

        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            remaining = None if deadline is None else max(0.0, deadline - time.monotonic())
            ready, _, _ = select.select(self._descriptors, (), (), remaining)
            arrived = []
            for descriptor in ready:
                if descriptor == self._wake:
                    continue
                index = self._indices[descriptor]
                frames = self.hubs[index].poll()
                if frames:
                    arrived.append((index, frames))
            if arrived:
                return arrived
            if self._wake in ready:
                os.eventfd_read(self._wake)
                return []
            if remaining == 0.0:
                return []

    def interrupt(self) -> None:
        """End the current or the next wait; may be called from another thread or a signal handler."""
        os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Close all hubs."""
        for hub in self.hubs:
            hub.close()
        if self._wake >= 0:
            os.close(self._wake)
            self._wake = -1

    def __enter__(self) -> HubGroup:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def serve_in_thread(*channels: str | os.PathLike[str]) -> Iterator[tuple[BusHub, ...]]:
    """Host bare buses in a thread until the block is left; the hubs are given for their counts, not to receive from."""
    hubs = open_hubs(channels)
    group = HubGroup(hubs)
    running = True

    def serve() -> None:
        while running:
            group.wait(None)

    thread = Thread(target=serve, name="cosim-bus", daemon=True)
    thread.start()
    try:
        yield hubs
    finally:
        running = False
        group.interrupt()
        thread.join()
        group.close()


def open_hubs(channels: Sequence[str | os.PathLike[str]]) -> tuple[BusHub, ...]:
    """Host several buses, or none of them.

    Raises:
        BusInUseError, BusUnavailableError: one of them cannot be hosted; those already opened are closed.

    """
    hubs: list[BusHub] = []
    try:
        for channel in channels:
            hubs.append(BusHub(channel))  # noqa: PERF401 - what was opened before a failure must be closed
    except BaseException:
        for hub in hubs:
            hub.close()
        raise
    return tuple(hubs)


def _readable(connection: socket.socket) -> bool:
    try:
        return bool(connection.recv(1, socket.MSG_PEEK | _NOW))
    except ConnectionResetError:
        return _readable(connection)
    except OSError:
        return False
