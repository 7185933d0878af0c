"""Two real processes on the loopback interface."""

from __future__ import annotations

import importlib.util
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from schemas.base import Clock
from schemas.messages import Event
from schemas.topics import decode
from schemas.transport import (
    SERVICES,
    JoinCancelledError,
    PeerLostError,
    PeerTimeoutError,
    Transport,
    TransportConfig,
    TransportError,
    open_session,
)

PEER = Path(__file__).with_name("transport_peer.py")
_spec = importlib.util.spec_from_file_location("transport_peer", PEER)
assert _spec is not None
assert _spec.loader is not None
transport_peer = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(transport_peer)
KEYS = transport_peer.KEYS
COUNT = transport_peer.COUNT


@pytest.fixture
def base_port() -> int:
    """A port with free ones after it, now."""
    while True:
        with ExitStack() as stack:
            first = stack.enter_context(socket.socket())
            first.bind(("127.0.0.1", 0))
            base: int = first.getsockname()[1]
            try:
                for rank in range(1, len(SERVICES)):
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", base + rank))
            except (OSError, OverflowError):
                continue
            return base


@contextmanager
def peer(role: str, base_port: int, clock: Clock = Clock.LOCKSTEP) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, str(PEER), role, str(base_port), clock.value])
    try:
        yield process
    finally:
        process.kill()
        process.wait(10.0)


def _open(service: str, base_port: int, clock: Clock = Clock.LOCKSTEP) -> Transport:
    return open_session(service, KEYS, TransportConfig(base_port=base_port), clock)


def test_lockstep_loses_nothing_and_keeps_the_order(base_port: int) -> None:
    with peer("burst", base_port), _open("hal", base_port) as hal:
        everything = hal.subscribe(KEYS.everything)
        hal.join(["controller"], 20.0)
        time.sleep(0.2)  # the messages pile up meanwhile
        samples = [everything.receive_sample(5.0) for _ in range(COUNT + 1)]
        assert [sample.sequence for sample in samples if sample] == list(range(COUNT + 1))
        last = samples[-1]
        assert last is not None
        assert (samples[0] and samples[0].topic, last.topic, last.time_ns) == ("command", "event", COUNT)
        assert decode(Event, last.data) == transport_peer.event(COUNT)


@pytest.mark.parametrize("clock", list(Clock))
def test_newest_is_kept(base_port: int, clock: Clock) -> None:
    with peer("burst", base_port, clock), _open("hal", base_port, clock) as hal:
        commands = hal.subscribe(KEYS.command, newest=True)
        events = hal.subscribe(KEYS.event)
        hal.join(["controller"], 20.0)
        last_event = events.receive(10.0)
        if clock is Clock.LOCKSTEP:
            assert last_event is not None
        deadline = time.monotonic() + 5.0
        newest = None
        while newest is None and time.monotonic() < deadline:
            newest = commands.receive_sample(0.1)
        assert newest is not None
        if clock is Clock.LOCKSTEP:
            assert newest.sequence == COUNT - 1
        assert commands.receive(0.0) is None


def test_request_and_answer(base_port: int) -> None:
    with peer("echo", base_port), _open("hal", base_port) as hal:
        answers = hal.subscribe(KEYS.command)
        hal.join(["controller"], 20.0)
        for k in range(200):
            hal.publish(KEYS.state, transport_peer.event(k))
            data = answers.receive(2.0)
            assert data is not None
            assert decode(Event, data).sequence == k


def test_killed_peer_is_named_within_half_a_second_and_wakes_the_reader(base_port: int) -> None:
    with peer("wait", base_port) as process, _open("hal", base_port) as hal:
        commands = hal.subscribe(KEYS.command)
        newest = hal.subscribe(KEYS.state, newest=True)
        hal.join(["controller"], 20.0)
        assert hal.alive == {"hal", "controller"}
        assert hal.lost == ()
        process.send_signal(signal.SIGKILL)
        killed = time.monotonic()
        assert commands.receive(5.0) is None
        assert time.monotonic() - killed < 0.5
        assert hal.lost == ("controller",)
        assert newest.receive(5.0) is None
        assert time.monotonic() - killed < 0.6
        with pytest.raises(PeerLostError, match="hal: controller ended while"):
            hal.wait_for_peers(["controller"], 5.0)


def test_observer_joins_late_and_sees_who_is_there(base_port: int) -> None:
    with peer("echo", base_port), _open("hal", base_port) as hal:
        hal.join(["controller"], 20.0)
        with _open("stop", base_port) as observer:
            states = observer.subscribe(KEYS.state)
            observer.wait_for_peers(["hal", "controller"], 5.0)
            observer.wait_for_peers(["hal", "controller"], 5.0, ready=True)
            deadline = time.monotonic() + 5.0
            heard = None
            while heard is None and time.monotonic() < deadline:
                hal.publish(KEYS.state, transport_peer.event(1))
                heard = states.receive(0.05)
            assert heard is not None


def test_missing_peers_are_named(base_port: int) -> None:
    with _open("hal", base_port) as hal:
        hal.announce()
        with pytest.raises(PeerTimeoutError, match=r"hal: plant, recorder not alive after 0.2 s"):
            hal.wait_for_peers(["plant", "hal", "recorder"], 0.2)
        with pytest.raises(JoinCancelledError, match="waiting for plant"):
            hal.wait_for_peers(["plant"], 5.0, cancelled=lambda: True)


def test_taken_port_and_bad_file_are_typed_errors(base_port: int, tmp_path: Path) -> None:
    with _open("hal", base_port), pytest.raises(TransportError, match=rf"127.0.0.1:{base_port + 1} taken"):
        _open("hal", base_port)
    for path, content in (("none.json5", None), ("bad.json5", "{ mode: ")):
        file = tmp_path / path
        if content is not None:
            file.write_text(content)
        with pytest.raises(TransportError, match=path):
            open_session("hal", KEYS, TransportConfig(base_port=base_port, zenoh_file=str(file)), Clock.LOCKSTEP)


@pytest.mark.parametrize("name", ["lan.json5", "router.json5"])
def test_packaged_network_files_are_read(name: str) -> None:
    import zenoh

    file = Path(__file__).parents[2] / "deploy" / "zenoh" / name
    config: Any = zenoh.Config.from_file(file)
    assert config.get_json("mode") in {'"peer"', '"client"', "peer", "client"}


def test_publishing_after_the_end_is_an_error(base_port: int) -> None:
    hal = _open("hal", base_port)
    hal.declare_publisher(KEYS.state)
    hal.close()
    with pytest.raises(TransportError, match="hal cannot publish on test/pendulum/state"):
        hal.publish(KEYS.state, transport_peer.event(0))
