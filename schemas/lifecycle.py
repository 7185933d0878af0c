"""A service's life beside its work: signals, peers that come, leave or vanish, and the last word."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Final, Literal, Self

from schemas.base import Model
from schemas.messages import Event
from schemas.topics import decode
from schemas.transport import PeerLostError, Transport

JOIN_TIMEOUT_S: Final = 60.0
"""Patience with peers that are still starting."""
JOIN_PER_START: Final = 20.0
"""The same as a multiple of the processor time that this service took to start: on an emulated processor imports alone
take a minute."""
FAREWELL_S: Final = 0.1
"""A peer's last word may arrive this long after its token has gone."""
STOPPED: Final = "service_stopped"


class Lifecycle:
    """Joins a run, notices signals and lost peers, says goodbye. A context manager.

    SIGTERM and SIGINT are noted in `signalled`, never acted on here: the service's loop decides when to stop.
    """

    def __init__(self, transport: Transport, needed: tuple[str, ...]) -> None:
        """`needed` are the peers whose loss ends this service."""
        self.transport = transport
        self.signalled: int | None = None
        self._needed = tuple(name for name in needed if name != transport.service)
        self._events = transport.subscribe(transport.keys.event)
        self._said_goodbye: set[str] = set()
        self._lost_count = 0
        self._previous = {number: signal.signal(number, self._note) for number in (signal.SIGTERM, signal.SIGINT)}
        self._last: tuple[int, int] = (0, 0)

    def join(self, peers: tuple[str, ...]) -> None:
        """Wait for all peers of the run, after all subscriptions are declared.

        Raises:
            PeerTimeoutError: naming those that are missing.
            PeerLostError: one has ended while the run was starting.
            JoinCancelledError: a signal came first.

        """
        timeout_s = max(JOIN_TIMEOUT_S, JOIN_PER_START * time.process_time())
        self.transport.join(peers, timeout_s, cancelled=lambda: self.signalled is not None)

    def stamp(self, sequence: int, time_ns: int) -> None:
        """Set the sequence and time that events carry from now on."""
        self._last = (sequence, time_ns)

    def publish(self, key: str, message: Model) -> None:
        """Send a message."""
        self.transport.publish(key, message)

    def event(self, kind: str, text: str, severity: Literal["info", "warning", "error"] = "info") -> None:
        """Publish an event of this service."""
        sequence, time_ns = self._last
        message = Event(
            sequence=sequence,
            time_ns=time_ns,
            service=self.transport.service,
            kind=kind,
            severity=severity,
            text=text,
        )
        self.transport.publish(self.transport.keys.event, message)

    def finished(self, service: str) -> bool:
        """Whether a service has said goodbye."""
        self._listen(0.0)
        return service in self._said_goodbye

    def lost(self) -> tuple[str, ...]:
        """Peers that vanished without goodbye since the last call, needed or not; cheap when nobody left."""
        gone = self.transport.lost
        if len(gone) == self._lost_count:
            return ()
        fresh, self._lost_count = gone[self._lost_count :], len(gone)
        deadline = time.monotonic() + FAREWELL_S
        while not self._said_goodbye.issuperset(fresh) and time.monotonic() < deadline:
            self._listen(FAREWELL_S / 5)
        return tuple(name for name in fresh if name not in self._said_goodbye)

    def check_peers(self) -> None:
        """Notice peers that vanished: an event for one the run can do without.

        Raises:
            PeerLostError: naming a needed one.

        """
        for name in self.lost():
            if name in self._needed:
                raise PeerLostError(f"{name} has gone; see what it printed last")
            self.event("peer_lost", f"{name} has gone; the run goes on without it", "warning")

    def _listen(self, timeout_s: float) -> None:
        data = self._events.receive(timeout_s)
        while data is not None:
            event = decode(Event, data)
            if event.kind == STOPPED:
                self._said_goodbye.add(event.service)
            data = self._events.receive(0.0)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.signalled = number

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Say goodbye and leave; an error is told to the others first."""
        if error is not None:
            self.event("failed", str(error) or type(error).__name__, "error")
        self.event(STOPPED, f"{self.transport.service} has stopped")
        self.transport.close()
        for number, handler in self._previous.items():
            signal.signal(number, handler)
