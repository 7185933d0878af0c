"""The virtual bus as python-can interface `cosim`, for any python-can program."""

from __future__ import annotations

import os
import select
import socket
import time
from collections import deque

import can

from hal.bus.address import ECHO_OPTION, MAX_PACKET, connect, socket_path
from hal.bus.can_frame import decode, encode, split
from hal.bus.errors import BusError

_NOW = socket.MSG_DONTWAIT


class CosimBus(can.BusABC):
    """`can.Bus(interface="cosim", channel=PATH)`: a client of a virtual bus that another process hosts.

    Args:
        channel: socket path; a bare name lies in the run directory.
        can_filters: as python-can's; filtered in this process.
        receive_own_messages: get one's own frames back, in their place in the bus order.
        connect_timeout: time [s] to wait for somebody to host the bus.
        kwargs: taken and not used (`bitrate` and others: the virtual bus has no controller to set).

    Raises:
        can.CanInitializationError: nobody hosts the bus.

    """

    def __init__(
        self,
        channel: can.typechecking.Channel | os.PathLike[str],
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        connect_timeout: float = 2.0,
        **kwargs: object,
    ) -> None:
        # python-can's command line turns a channel of digits into a number.
        self.channel = os.fspath(channel) if isinstance(channel, os.PathLike) else str(channel)
        try:
            self._socket = connect(self.channel, connect_timeout)
            path = socket_path(self.channel)
        except BusError as error:
            raise can.CanInitializationError(str(error)) from error
        self.channel_info = f"cosim channel '{path}'"
        self._can_protocol = can.CanProtocol.CAN_20
        self._waiting: deque[bytes] = deque()
        self._last_timestamp = 0.0
        # A packet may hold several frames: while some wait here, this descriptor keeps `fileno` readable.
        self._more = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll = select.epoll()
        self._epoll.register(self._socket, select.EPOLLIN)
        self._epoll.register(self._more, select.EPOLLIN)
        if receive_own_messages:
            self._socket.send(ECHO_OPTION)
        super().__init__(channel=self.channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message, waiting up to `timeout` [s] (None: as long as it takes) for room on the bus.

        Raises:
            can.CanOperationError: the bus has gone, or had no room in that time.
            ValueError: not a classic CAN message.

        """
        frame = encode(msg)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(frame, _NOW)
            except BlockingIOError:
                remaining = None if deadline is None else deadline - time.monotonic()
                if remaining is not None and remaining <= 0.0:
                    raise can.CanOperationError(f"{self.channel_info}: no room for a frame") from None
                select.select([], [self._socket], [], remaining)
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info} has gone: {error.strerror}") from error
            else:
                return

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            try:
                ready, _, _ = select.select([self._socket], [], [], timeout)
                if not ready:
                    return None, False
                packet = self._socket.recv(MAX_PACKET, _NOW)
            except BlockingIOError:
                # Another thread of this program took it.
                return None, False
            except (OSError, ValueError) as error:
                raise can.CanOperationError(f"{self.channel_info} has gone: {error}") from error
            if not packet:
                raise can.CanOperationError(f"{self.channel_info} has gone: its host has closed it")
            # The wall clock may step back; a trace's time stamps must not.
            self._last_timestamp = max(self._last_timestamp, time.time())
            self._waiting.extend(split(packet))
            if len(self._waiting) > 1:
                os.eventfd_write(self._more, 1)
        elif len(self._waiting) == 1:
            os.eventfd_read(self._more)
        return decode(self._waiting.popleft(), self._last_timestamp, self.channel), False

    def fileno(self) -> int:
        """Descriptor that is readable as long as a message waits."""
        return self._epoll.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._is_shutdown:
            super().shutdown()
            self._epoll.close()
            self._socket.close()
            os.close(self._more)
