"""The recorder: writes every message of a robot to an MCAP file until the last service has stopped."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Final, Protocol

from deploy.errors import UsageError
from schemas.fingerprint import fingerprint
from schemas.lifecycle import STOPPED, Lifecycle
from schemas.load import Run
from schemas.log import LogWriter, UnknownTopicError
from schemas.messages import Event
from schemas.service import Service, ServiceOptions
from schemas.subscription import Sample
from schemas.topics import MalformedMessageError, decode
from schemas.transport import open_service

DRAIN_S: Final = 0.2
"""Silence after which nothing more is expected, once all services have stopped or the recorder is told to."""
BATCH_S: Final = 0.02
"""How long messages gather before they are written: one wake-up for all of them leaves the processor to the loop."""


def record(run: Run, options: ServiceOptions) -> int:
    """Body of the recorder's process; returns the exit code.

    Ends when every peer has published its last event or is gone, or after SIGTERM or SIGINT and what was under way.

    Raises:
        UsageError: no output file.
        TransportError: the ports are taken, or the peers do not appear.
        LogError: the file cannot be written.

    """
    if options.output is None:
        raise UsageError("recorder: --output: expected the log file's path")
    peers = tuple(peer for peer in options.peers if peer != Service.RECORDER)
    transport = open_service(Service.RECORDER.value, run, options)
    with Lifecycle(transport, needed=()) as life, LogWriter(options.output, run, fingerprint(run)) as log:
        samples = transport.subscribe_backlog(transport.keys.everything)
        life.join(peers)
        refused = write_until_over(log, samples.take, _Ending(life, peers))
    return 1 if refused else 0


class Ending(Protocol):
    """Says when the run is over."""

    def heard(self, event: Event) -> None:
        """Take note of an event."""

    @property
    def over(self) -> bool:
        """True when no more than what is under way will come."""


class _Ending:
    """The run is over when all peers have stopped or are lost, or a signal came."""

    def __init__(self, life: Lifecycle, peers: tuple[str, ...]) -> None:
        self._life = life
        self._waiting = set(peers)

    def heard(self, event: Event) -> None:
        """Note a service's last event."""
        if event.kind == STOPPED:
            self._waiting.discard(event.service)

    @property
    def over(self) -> bool:
        """True when no more than what is under way will come."""
        return self._life.signalled is not None or self._waiting <= set(self._life.transport.lost)


def write_until_over(
    log: LogWriter, take: Callable[[], list[Sample]], ending: Ending, *, drain_s: float = DRAIN_S
) -> int:
    """Write samples as they arrive, in batches; when the run is over, until nothing has arrived for `drain_s`.

    What is no message of the robot (an unknown topic, an event that cannot be read) is reported on stderr and left
    out; returns how many.
    """
    refused = 0
    last_s = time.monotonic()
    while True:
        over = ending.over
        samples = take()
        for sample in samples:
            try:
                if sample.topic == "event":
                    ending.heard(decode(Event, sample.data))
                log.write_bytes(sample.topic, sample.data, sample.sequence, sample.time_ns)
            except (MalformedMessageError, UnknownTopicError) as error:
                refused += 1
                print(f"recorder: left out: {error}", file=sys.stderr, flush=True)
        log.flush_if_due()
        now = time.monotonic()
        if samples or not over:
            last_s = now
        elif now - last_s >= drain_s:
            return refused
        time.sleep(BATCH_S)
