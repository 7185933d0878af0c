"""How a service notices that others finish, vanish, or that it is told to stop; sessions on the loopback interface."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from deploy.session import free_base_port
from schemas.base import Clock
from schemas.keys import Keys
from schemas.lifecycle import STOPPED, Lifecycle
from schemas.messages import Event
from schemas.topics import decode
from schemas.transport import PeerLostError, Transport, TransportConfig, open_session

KEYS = Keys("test", "lifecycle")


@pytest.fixture
def config() -> TransportConfig:
    return TransportConfig(base_port=free_base_port())


@pytest.fixture
def sessions(config: TransportConfig) -> Iterator[tuple[Transport, Transport]]:
    """The HAL and its controller, the controller not yet announced."""
    with ExitStack() as stack:
        hal = open_session("hal", KEYS, config, Clock.LOCKSTEP)
        stack.callback(hal.close)
        controller = open_session("controller", KEYS, config, Clock.LOCKSTEP)
        stack.callback(controller.close)
        yield hal, controller


def wait_until_lost(transport: Transport) -> None:
    deadline = time.monotonic() + 5.0
    while not transport.lost:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def fail_at(transport: Transport, sequence: int) -> None:
    with Lifecycle(transport, needed=()) as life:
        life.stamp(sequence, 10 * sequence)
        raise RuntimeError("boom")


def test_a_peer_that_says_goodbye_is_finished_and_not_lost(sessions: tuple[Transport, Transport]) -> None:
    hal, controller = sessions
    with Lifecycle(hal, needed=("controller",)) as life:
        with Lifecycle(controller, needed=("hal",)) as other:
            other.transport.announce()
            hal.wait_for_peers(["controller"], 5.0)
            assert not life.finished("controller")
        wait_until_lost(hal)
        life.check_peers()
        assert life.finished("controller")


def test_a_needed_peer_that_vanishes_is_named(sessions: tuple[Transport, Transport]) -> None:
    hal, controller = sessions
    with Lifecycle(hal, needed=("controller",)) as life:
        controller.announce()
        hal.wait_for_peers(["controller"], 5.0)
        life.check_peers()
        controller.close()
        wait_until_lost(hal)
        with pytest.raises(PeerLostError, match="controller has gone"):
            life.check_peers()


def test_the_loss_of_another_peer_is_an_event(sessions: tuple[Transport, Transport], config: TransportConfig) -> None:
    hal, controller = sessions
    observer = open_session("observer", KEYS, config, Clock.LOCKSTEP)
    with observer, Lifecycle(hal, needed=("plant",)) as life:
        events = observer.subscribe(KEYS.event)
        hal.announce()
        observer.wait_for_peers(["hal"], 5.0)
        controller.announce()
        hal.wait_for_peers(["controller"], 5.0)
        controller.close()
        wait_until_lost(hal)
        life.check_peers()
        data = events.receive(5.0) or events.receive(5.0)  # the first may only tell that a peer is gone
        assert data is not None
        event = decode(Event, data)
        assert (event.kind, event.severity) == ("peer_lost", "warning")
        assert "controller" in event.text


def test_the_last_word_tells_of_the_error_and_then_of_the_stop(sessions: tuple[Transport, Transport]) -> None:
    hal, controller = sessions
    events = controller.subscribe(KEYS.event)
    controller.announce()
    hal.wait_for_peers(["controller"], 5.0)
    with pytest.raises(RuntimeError, match="boom"):
        fail_at(hal, 7)
    heard = [decode(Event, data) for _ in range(2) if (data := events.receive(5.0)) is not None]
    assert [event.kind for event in heard] == ["failed", STOPPED]
    assert [event.sequence for event in heard] == [7, 7]
    assert "boom" in heard[0].text


def test_signals_are_noted_and_their_handlers_given_back(sessions: tuple[Transport, Transport]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Lifecycle(sessions[0], needed=()) as life:
        assert life.signalled is None
        os.kill(os.getpid(), signal.SIGTERM)
        assert life.signalled == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before
