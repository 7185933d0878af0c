"""Messages between processes by Zenoh: who connects to whom, how messages queue, and who is alive.

Four services form a full mesh of direct links on the loopback interface. Service number r of `SERVICES` listens on
`tcp/host:(base_port + r)` and connects to all lower ones, retrying until they are there; any other program connects to
all four and listens nowhere. Scouting (multicast and gossip) is off. A file of Zenoh's own configuration replaces all
of this for another network.

Order: in lockstep a link has one queue, so what one service publishes arrives in the order of publishing, whatever the
topic, and its going (`Transport.lost`) comes after its last message. In realtime each priority has its queue: the order
holds within a topic, and the control loop's topics pass the others.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Final, Self

import zenoh
from pydantic import Field, PositiveInt
from zenoh.handlers import Callback, FifoChannel

from schemas.base import Clock, Model
from schemas.errors import CosimError
from schemas.keys import Keys
from schemas.load import Run
from schemas.service import Service, ServiceOptions
from schemas.subscription import STAMP, Backlog, Subscription
from schemas.topics import encode, stamp

SERVICES: Final = tuple(service.value for service in Service)
"""The services that listen, in the order of their ports."""

URGENT: Final = frozenset({"state", "command", "operator"})
"""Topics of the control loop, sent before everything else that waits."""

CONFIG_VARIABLE: Final = "COSIM_ZENOH_CONFIG"
"""Environment variable that names a Zenoh configuration for all services and observers of a run."""

LOGGED_ONLY: Final = frozenset({"trace", "truth", "bus"})
"""Topics that nobody waits for: they may travel together with what follows, which spares both ends a packet each."""

BACKLOG: Final = 100_000

WAIT_SLICE_S: Final = 0.1
LAST_WORDS_S: Final = 0.05
"""Realtime: time for the last messages to leave before the liveliness token, which Zenoh sends ahead of all others."""

_RUNTIME: Final = "(rx: (handover: app), tx: (handover: app), acc: (handover: app), app: (worker_threads: 1))"
"""One network thread a process instead of one a task: a fifth off the round trip on two cores."""


class TransportError(CosimError):
    """The session cannot be opened or is gone."""


class PeerTimeoutError(TransportError):
    """Services that should be there did not appear in time."""


class PeerLostError(TransportError):
    """A service has gone that was there."""


class JoinCancelledError(TransportError):
    """The wait for peers was given up on request."""


class TransportConfig(Model):
    """Where the services meet."""

    host: str = "127.0.0.1"
    base_port: Annotated[int, Field(ge=1024, le=65535 - len(SERVICES))] = 7460
    retry_ms: PositiveInt = 50
    """Period of connection attempts to services that are not there yet."""
    zenoh_file: str | None = None
    """A Zenoh configuration (JSON5) that replaces all of the above, e.g. `deploy/zenoh/lan.json5`."""


class Transport:
    """One service's Zenoh session for one robot."""

    def __init__(self, session: zenoh.Session, service: str, keys: Keys, clock: Clock) -> None:
        self.service = service
        self.keys = keys
        self._session = session
        self._congestion = zenoh.CongestionControl.BLOCK if clock is Clock.LOCKSTEP else zenoh.CongestionControl.DROP
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._subscriptions: list[Subscription] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._changed = threading.Condition()
        self._present: set[str] = set()
        self._lost: list[str] = []
        liveliness = session.liveliness()
        self._watchers = [
            liveliness.declare_subscriber(keys.alive("*"), Callback(self._on_token, indirect=False), history=True),
            liveliness.declare_subscriber(keys.ready("*"), Callback(self._on_token, indirect=False), history=True),
        ]

    @property
    def lost(self) -> tuple[str, ...]:
        """Services that were alive and are gone, in the order of their going; killed ones and those that ended."""
        return tuple(self._lost)

    @property
    def alive(self) -> frozenset[str]:
        """Services that are alive now, this one included once announced."""
        prefix = self.keys.alive("")
        with self._changed:
            return frozenset(key.removeprefix(prefix) for key in self._present if key.startswith(prefix))

    def publish(self, key: str, message: Model) -> None:
        """Send a message. In lockstep it waits for room and loses nothing; in realtime it drops rather than wait.

        Raises:
            TransportError: the session is closed.

        """
        self.publish_bytes(key, encode(message), *stamp(message))

    def publish_bytes(self, key: str, data: bytes, sequence: int, time_ns: int) -> None:
        """As `publish`, for a message that is already encoded."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self.declare_publisher(key)
        try:
            publisher.put(data, attachment=STAMP.pack(sequence, time_ns))
        except zenoh.ZError as error:
            raise TransportError(f"{self.service} cannot publish on {key}: {error}") from error

    def declare_publisher(self, key: str) -> zenoh.Publisher:
        """Declare a publisher ahead of the first message, so that the first cycle does not pay for it."""
        topic = key.removeprefix(self.keys.root + "/").partition("/")[0]
        publisher = self._session.declare_publisher(
            key,
            encoding="application/json",
            express=topic not in LOGGED_ONLY,
            priority=zenoh.Priority.REAL_TIME if topic in URGENT else zenoh.Priority.DATA,
            congestion_control=self._congestion,
        )
        self._publishers[key] = publisher
        return publisher

    def subscribe(self, key: str, *, newest: bool = False) -> Subscription:
        """Receive what others publish on a key expression: all of it in order, or only the newest."""
        subscription = Subscription(newest=newest)
        subscription.root_length = len(self.keys.root) + 1
        self._session.declare_subscriber(
            key, Callback(subscription.deliver, indirect=False), allowed_origin=zenoh.Locality.REMOTE
        )
        self._subscriptions.append(subscription)
        return subscription

    def subscribe_backlog(self, key: str) -> Backlog:
        """Receive all that others publish on a key expression, taken in batches: less work a message than `subscribe`.

        When `BACKLOG` messages wait, the network thread waits for the reader, and in lockstep the publishers in turn.
        """
        subscriber = self._session.declare_subscriber(key, FifoChannel(BACKLOG), allowed_origin=zenoh.Locality.REMOTE)
        return Backlog(subscriber, len(self.keys.root) + 1)

    def announce(self) -> None:
        """Declare this service alive; call it once the subscriptions are declared."""
        self._tokens.append(self._session.liveliness().declare_token(self.keys.alive(self.service)))

    def announce_ready(self) -> None:
        """Declare that this service sees the peers it expects."""
        self._tokens.append(self._session.liveliness().declare_token(self.keys.ready(self.service)))

    def wait_for_peers(
        self,
        names: Iterable[str],
        timeout_s: float,
        *,
        ready: bool = False,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        """Wait until services are alive (or ready); `cancelled` is asked ten times a second.

        Raises:
            PeerTimeoutError: naming those that are missing.
            PeerLostError: one of them is gone meanwhile.
            JoinCancelledError: `cancelled` returned True.

        """
        key_of = self.keys.ready if ready else self.keys.alive
        wanted = {key_of(name): name for name in names if name != self.service}
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not wanted.keys() <= self._present:
                missing = ", ".join(name for key, name in wanted.items() if key not in self._present)
                gone = [name for name in self._lost if name in wanted.values()]
                if gone:
                    raise PeerLostError(f"{self.service}: {', '.join(gone)} ended while the run was starting")
                if cancelled():
                    raise JoinCancelledError(f"{self.service}: stopped while waiting for {missing}")
                remaining = deadline - time.monotonic()
                if remaining <= 0.0:
                    raise PeerTimeoutError(
                        f"{self.service}: {missing} not {'ready' if ready else 'alive'} after {timeout_s:g} s;"
                        " is the service running on the same ports and namespace?"
                    )
                self._changed.wait(min(remaining, WAIT_SLICE_S))

    def join(self, peers: Iterable[str], timeout_s: float, *, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Announce this service and return once all peers see all the peers they expect.

        Raises:
            TransportError: as `wait_for_peers`.

        """
        names = tuple(peers)
        deadline = time.monotonic() + timeout_s
        self.announce()
        self.wait_for_peers(names, timeout_s, cancelled=cancelled)
        self.announce_ready()
        self.wait_for_peers(names, max(deadline - time.monotonic(), 0.1), ready=True, cancelled=cancelled)

    def close(self) -> None:
        """Undeclare everything and close the session; what was published before has been sent."""
        if self._tokens and self._congestion == zenoh.CongestionControl.DROP:
            time.sleep(LAST_WORDS_S)
        for token in self._tokens:
            token.undeclare()  # type: ignore[no-untyped-call]  # stub without return type
        self._tokens.clear()
        self._session.close()  # type: ignore[no-untyped-call]  # stub without return type

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        prefix = self.keys.alive("")
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._present.add(key)
            elif key in self._present:
                self._present.discard(key)
                name = key.removeprefix(prefix)
                if key.startswith(prefix) and name != self.service and name not in self._lost:
                    self._lost.append(name)
            self._changed.notify_all()
        if self._lost:
            for subscription in self._subscriptions:
                subscription.deliver(None)


def open_service(service: str, run: Run, options: ServiceOptions) -> Transport:
    """Open the session of a run's service or observer; `COSIM_ZENOH_CONFIG` may name a Zenoh configuration file.

    Raises:
        TransportError: as `open_session`.

    """
    keys = Keys(run.scenario.namespace, run.robot.description.name)
    config = TransportConfig(base_port=options.base_port, zenoh_file=os.environ.get(CONFIG_VARIABLE))
    return open_session(service, keys, config, run.scenario.clock)


def open_session(service: str, keys: Keys, config: TransportConfig, clock: Clock) -> Transport:
    """Open the Zenoh session of a service of `SERVICES`, or of any other program.

    Raises:
        TransportError: the port is taken, or the configuration file cannot be used.

    """
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    try:
        session = zenoh.open(_zenoh_config(service, config, clock))
    except zenoh.ZError as error:
        if config.zenoh_file is None and service in SERVICES:
            port = config.base_port + SERVICES.index(service)
            hint = f"is {config.host}:{port} taken by another run? Choose another base port"
        else:
            hint = f"check {config.zenoh_file}" if config.zenoh_file else "check the host"
        raise TransportError(
            f"{service}: cannot open a Zenoh session: {hint}. ({str(error).splitlines()[0]})"
        ) from error
    return Transport(session, service, keys, clock)


def _zenoh_config(service: str, config: TransportConfig, clock: Clock) -> zenoh.Config:
    if config.zenoh_file is not None:
        if not Path(config.zenoh_file).is_file():
            raise TransportError(f"no Zenoh configuration at {config.zenoh_file}")
        return zenoh.Config.from_file(config.zenoh_file)
    endpoints = [f"tcp/{config.host}:{config.base_port + rank}" for rank in range(len(SERVICES))]
    rank = SERVICES.index(service) if service in SERVICES else len(SERVICES)
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": endpoints[rank : rank + 1],
        "listen/exit_on_failure": True,
        "connect/endpoints": endpoints[:rank],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {
            "period_init_ms": config.retry_ms,
            "period_max_ms": config.retry_ms,
            "period_increase_factor": 1.0,
        },
        "open/return_conditions/connect_scouted": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/qos/enabled": clock is Clock.REALTIME,
    }
    result = zenoh.Config()
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result
