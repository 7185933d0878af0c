"""Waiting on several ports at once."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Sequence

from hal.bus.ports import NO_DESCRIPTOR, FramePort

ASK_S = 0.0002
"""Pause between two questions to ports that have no descriptor to wait on."""


class PortGroup:
    """The ports of one robot, in the order of its buses."""

    def __init__(self, ports: Sequence[FramePort]) -> None:
        self.ports = tuple(ports)
        self._by_descriptor: dict[int, int] = {}
        self._asked: list[int] = []
        for index, port in enumerate(self.ports):
            descriptor = port.fileno()
            if descriptor == NO_DESCRIPTOR:
                self._asked.append(index)
            else:
                self._by_descriptor[descriptor] = index
        self._descriptors = list(self._by_descriptor)

    def receive(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Wait for frames on any port: (index, n × 16 bytes) of each that has some; empty after `timeout_s` [s].

        A bus that goes down meanwhile shows once, by (index, b""); its port's `down` says why.

        Raises:
            BusLostError: one of the buses is gone.

        """
        deadline = time.monotonic() + timeout_s
        while True:
            arrived = [(index, frames) for index in self._asked if (frames := self.ports[index].receive(0.0))]
            remaining = max(0.0, deadline - time.monotonic())
            if self._descriptors:
                wait = 0.0 if arrived else min(remaining, ASK_S) if self._asked else remaining
                for descriptor in select.select(self._descriptors, (), (), wait)[0]:
                    index = self._by_descriptor[descriptor]
                    port = self.ports[index]
                    if (frames := port.receive(0.0)) or port.down is not None:
                        arrived.append((index, frames))
            elif not arrived:
                time.sleep(min(remaining, ASK_S))
            if arrived or remaining == 0.0:
                return arrived

    def gather(self, complete: Callable[[int, bytes], bool], timeout_s: float) -> bool:
        """Hand arriving frames to `complete(index, frames)` until it says that all expected ones have come.

        Returns whether it did before `timeout_s` [s]; what waits at that moment has been handed over as well.

        Raises:
            BusLostError: one of the buses is gone.

        """
        deadline = time.monotonic() + timeout_s
        while True:
            remaining = max(0.0, deadline - time.monotonic())
            done = False
            for index, frames in self.receive(remaining):
                done = complete(index, frames) or done
            if done:
                return True
            if remaining == 0.0:
                return False

    def close(self) -> None:
        """Close all ports."""
        for port in self.ports:
            port.close()
