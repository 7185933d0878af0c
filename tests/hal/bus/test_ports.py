"""Ports without a bus, and waiting on several."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from hal.bus.errors import BusDownError, BusLostError, BusUnavailableError
from hal.bus.gather import PortGroup
from hal.bus.hub import BusHub
from hal.bus.ports import CosimPort, DirectPort, FramePort, PythonCanPort, RecordingPort, open_port
from hal.profile.frames import pack
from schemas.robot import Bus

SYNC = pack(0x80, b"")
Wired = tuple[list[FramePort], list[FramePort]]
"""Near ends and far ends."""


def test_direct_port_answers_at_once() -> None:
    port = DirectPort("b", lambda frames: frames + pack(0x181, b"\1"))
    port.send(SYNC)
    port.send(pack(1, b""))
    assert port.receive(0.0) == SYNC + pack(0x181, b"\1") + pack(1, b"") + pack(0x181, b"\1")
    assert port.receive(0.0) == b""


def test_recording_port_keeps_what_passed_since_the_last_take() -> None:
    port = RecordingPort(DirectPort("b", lambda frames: pack(0x181, b"\1")))
    port.send(SYNC)
    assert port.receive(0.0) == pack(0x181, b"\1")
    port.send(pack(0x201, b""))
    assert port.take() == (SYNC + pack(0x201, b""), pack(0x181, b"\1"))
    assert port.take() == (b"", b"")
    assert port.name == "b"


def test_unknown_interface_is_one_clear_error() -> None:
    with pytest.raises(BusUnavailableError, match="bus right: no_such_interface can7 cannot be opened"):
        open_port(Bus(name="right", interface="no_such_interface", channel="can7"))


def test_missing_kernel_interface_is_one_clear_error() -> None:
    with pytest.raises(BusUnavailableError, match="socketcan no_such_can"):
        open_port(Bus(name="right", interface="socketcan", channel="no_such_can"))


class TestPortGroup:
    @pytest.fixture(params=["cosim", "virtual", "direct", "mixed"])
    def wired(self, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Wired]:
        """Near ends and far ends of two buses."""
        near: list[FramePort] = []
        far: list[FramePort] = []
        for index in range(2):
            kind = request.param if request.param != "mixed" else ("cosim", "virtual")[index]
            if kind == "cosim":
                hub = BusHub(tmp_path / f"bus{index}")
                far.append(hub)
                near.append(CosimPort("n", hub.path))
                hub.receive(0.0)
            elif kind == "virtual":
                bus = Bus(name="v", interface="virtual", channel=f"{tmp_path}{index}")
                near.append(open_port(bus))
                far.append(open_port(bus))
                assert isinstance(near[-1], PythonCanPort)
            else:
                end = DirectPort("d", lambda frames: frames)
                near.append(end)
                far.append(end)
        yield near, far
        for port in (*near, *far):
            port.close()

    def test_gathers_until_complete(self, wired: Wired) -> None:
        near, far = wired
        far[1].send(pack(0x181, b"") + pack(0x182, b""))
        far[0].send(pack(0x183, b""))
        got = [b"", b""]

        def complete(index: int, frames: bytes) -> bool:
            got[index] += frames
            return len(got[0]) == 16 and len(got[1]) == 32

        assert PortGroup(near).gather(complete, 2.0)
        assert got == [pack(0x183, b""), pack(0x181, b"") + pack(0x182, b"")]

    def test_gives_up_at_the_deadline(self, wired: Wired) -> None:
        near, far = wired
        far[0].send(SYNC)
        start = time.monotonic()
        assert not PortGroup(near).gather(lambda index, frames: False, 0.05)
        assert 0.045 <= time.monotonic() - start < 1.0
        assert PortGroup(near).receive(0.0) == []

    def test_what_waits_is_seen_although_no_time_is_left(self, wired: Wired) -> None:
        near, far = wired
        far[1].send(SYNC)
        time.sleep(0.01)
        assert PortGroup(near).gather(lambda index, frames: (index, frames) == (1, SYNC), 0.0)


def test_group_notices_a_lost_bus(tmp_path: Path) -> None:
    hubs = [BusHub(tmp_path / name) for name in ("a", "b")]
    group = PortGroup([CosimPort(hub.name, hub.path) for hub in hubs])
    hubs[0].receive(0.0)
    hubs[1].receive(0.0)
    hubs[1].close()
    with pytest.raises(BusLostError, match="has gone"):
        group.receive(2.0)
    hubs[0].close()
    group.close()


def test_what_came_before_the_end_of_a_bus_is_still_received(tmp_path: Path) -> None:
    hub = BusHub(tmp_path / "bus")
    port = CosimPort("bus", tmp_path / "bus")
    hub.poll()
    hub.send(SYNC)
    hub.send(pack(0x181, b"\1"))
    hub.close()
    assert port.receive(0.5) == SYNC + pack(0x181, b"\1")
    with pytest.raises(BusLostError):
        port.receive(0.5)
    port.close()


def test_an_error_of_python_can_is_a_state_that_may_end() -> None:
    bus = can.Bus(interface="virtual", channel="flaky", receive_own_messages=True)
    port = PythonCanPort("flaky", bus)
    send, failing = bus.send, iter([False, True, True])

    def unsteady(message: can.Message, timeout: float | None = None) -> None:
        if next(failing, False):
            raise can.CanOperationError("transmit queue full")
        send(message, timeout)

    bus.send = unsteady  # type: ignore[method-assign]  # an adapter's driver says so
    with pytest.raises(BusDownError, match="bus flaky: python-can cannot send: transmit queue full") as caught:
        port.send(SYNC * 3)
    assert (caught.value.sent, port.receive(1.0)) == (len(SYNC), SYNC)
    with pytest.raises(BusDownError):
        port.send(SYNC)
    assert port.down is not None
    port.send(SYNC)
    assert (port.down, port.receive(1.0)) == (None, SYNC)
    port.close()
    assert port.receive(0.0) == b""
    assert "cannot receive" in str(port.down)
