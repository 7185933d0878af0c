"""The port on the kernel's CAN: needs AF_CAN, vcan0-2 and two connected controllers can0, can1 (see `cosim can-vm`)."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator

import can
import pytest

from hal.bus.error_frames import (
    BUS_OFF,
    CONTROLLER,
    RESTARTED,
    RX_PASSIVE,
    Trouble,
    decode_error,
)
from hal.bus.errors import BusDownError, BusUnavailableError
from hal.bus.gather import PortGroup
from hal.bus.ports import PythonCanPort, open_port
from hal.bus.socketcan import SocketCanPort, is_hardware, open_socketcan
from hal.filters import filters_of
from hal.profile.frames import CAN_ERR_FLAG, CAN_RTR_FLAG, pack, unpack
from schemas.robot import Bus


def has_interface(name: str) -> bool:
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((name,))
    except OSError:
        return False
    return True


pytestmark = pytest.mark.skipif(not has_interface("vcan0"), reason="no vcan0 on this machine: run in `cosim can-vm`")
WAIT_S = 2.0
SYNC = pack(0x80, b"")


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def bus(channel: str) -> Bus:
    return Bus(name="right", interface="socketcan", channel=channel)


@pytest.fixture
def port() -> Iterator[SocketCanPort]:
    opened = open_socketcan(bus("vcan0"))
    yield opened
    opened.close()


@pytest.fixture
def other() -> Iterator[SocketCanPort]:
    opened = open_socketcan(bus("vcan0"))
    yield opened
    opened.close()


def receive(port: SocketCanPort, size: int) -> bytes:
    frames = b""
    deadline = time.monotonic() + WAIT_S
    while len(frames) < size and time.monotonic() < deadline:
        frames += port.receive(0.1)
    return frames


def test_the_open_port_is_the_raw_one() -> None:
    opened = open_port(bus("vcan0"))
    assert isinstance(opened, SocketCanPort)
    opened.close()
    assert not is_hardware("vcan0")


def test_python_can_and_the_port_see_the_same_frames(port: SocketCanPort) -> None:
    with can.Bus(interface="socketcan", channel="vcan0") as foreign:
        foreign.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\1\2\3"))
        assert list(unpack(receive(port, 16))) == [(0x181, b"\1\2\3")]
        port.send(pack(0x201, b"\4") + pack(0x202 | CAN_RTR_FLAG, b""))
        first, second = foreign.recv(WAIT_S), foreign.recv(WAIT_S)
    assert first is not None
    assert second is not None
    assert (first.arbitration_id, bytes(first.data)) == (0x201, b"\4")
    assert second.is_remote_frame


def test_filters_are_the_kernels(other: SocketCanPort) -> None:
    filtered = open_socketcan(bus("vcan0"), filters_of({0x181, 0x581}))
    other.send(b"".join(pack(can_id, b"") for can_id in (0x080, 0x181, 0x182, 0x581, 0x181 | CAN_RTR_FLAG)))
    other.send(pack(0x80000181, b"") + pack(0x181, b"\1"))
    assert receive(filtered, 3 * 16) == pack(0x181, b"") + pack(0x581, b"") + pack(0x181, b"\1")
    assert filtered.receive(0.0) == b""
    filtered.close()


@pytest.mark.parametrize(
    ("head", "data", "trouble"),
    [
        (BUS_OFF, bytes(8), Trouble.BUS_OFF),
        (RESTARTED, bytes(8), Trouble.RESTARTED),
        (CONTROLLER, bytes((0, RX_PASSIVE, 0, 0, 0, 0, 3, 130)), Trouble.ERROR_PASSIVE),
    ],
)
def test_error_frames_arrive_whatever_the_filter(head: int, data: bytes, trouble: Trouble) -> None:
    filtered = open_socketcan(bus("vcan0"), filters_of({0x181}))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind(("vcan0",))
        raw.send(pack(head | CAN_ERR_FLAG, data))
        frame = receive(filtered, 16)
    assert decode_error(frame).troubles == (trouble,)
    filtered.close()


def test_an_interface_that_goes_down_is_a_state_and_comes_back(port: SocketCanPort, other: SocketCanPort) -> None:
    descriptor = port.fileno()
    other.send(SYNC)
    ip("link", "set", "vcan0", "down")
    try:
        # What came before is still received; the wait ends although no time is over.
        assert PortGroup([port]).receive(WAIT_S) == [(0, SYNC)]
        assert port.down is not None
        assert "vcan0 is down" in port.down
        assert port.receive(0.01) == b""
        with pytest.raises(BusDownError, match="bus right: interface vcan0 is down"):
            port.send(SYNC)
    finally:
        ip("link", "set", "vcan0", "up")
    assert port.down is None
    assert other.receive(0.0) == b""
    assert other.down is not None, "an outage is told even when it is over"
    assert other.down is None
    port.send(SYNC)
    assert receive(other, 16) == SYNC
    assert port.fileno() == descriptor


def test_a_group_wakes_when_an_interface_goes_down(port: SocketCanPort) -> None:
    ip("link", "set", "vcan0", "down")
    try:
        begun = time.monotonic()
        assert PortGroup([port]).receive(WAIT_S) == [(0, b"")]
        assert time.monotonic() - begun < WAIT_S / 2
        assert port.down is not None
        assert PortGroup([port]).receive(0.01) == []
    finally:
        ip("link", "set", "vcan0", "up")


def test_an_adapter_that_is_unplugged_and_plugged_in_again() -> None:
    ip("link", "add", "dev", "vcan9", "type", "vcan")
    ip("link", "set", "vcan9", "up")
    opened = open_socketcan(bus("vcan9"), filters_of({0x181}))
    descriptor = opened.fileno()
    try:
        ip("link", "delete", "vcan9")
        assert opened.receive(WAIT_S) == b""
        assert "vcan9 is gone" in (opened.down or "")
        with pytest.raises(BusDownError):
            opened.send(SYNC)
        ip("link", "add", "dev", "vcan9", "type", "vcan")
        with pytest.raises(BusDownError):
            opened.send(SYNC)  # not yet up
        ip("link", "set", "vcan9", "up")
        foreign = open_socketcan(bus("vcan9"))
        opened.send(SYNC)
        assert receive(foreign, 16) == SYNC
        foreign.send(SYNC + pack(0x181, b"\7"))
        assert receive(opened, 16) == pack(0x181, b"\7")
        assert opened.fileno() == descriptor
        foreign.close()
    finally:
        opened.close()
        subprocess.run(["ip", "link", "delete", "vcan9"], check=False, capture_output=True)


def test_an_interface_that_is_down_cannot_be_opened() -> None:
    ip("link", "set", "vcan0", "down")
    try:
        with pytest.raises(BusUnavailableError, match="vcan0 is down; `ip link set vcan0 up"):
            open_port(bus("vcan0"))
    finally:
        ip("link", "set", "vcan0", "up")
    with pytest.raises(BusUnavailableError, match="no_such_can cannot be opened: no such interface"):
        open_port(bus("no_such_can"))


def test_a_slow_reader_is_told_what_it_lost(port: SocketCanPort, other: SocketCanPort) -> None:
    frames = pack(0x181, bytes(8)) * 256
    for _ in range(40):
        other.send(frames)
    received = 0
    while chunk := port.receive(0.0):
        received += len(chunk) // 16
    assert port.drops() == {"socket_dropped": 40 * 256 - received}
    assert received < 40 * 256
    assert port.drops() == {}


@pytest.mark.skipif(not has_interface("can0") or not has_interface("can1"), reason="no pair of controllers")
class TestControllers:
    """Two controllers on one bus whose wire takes no time."""

    @pytest.mark.parametrize("burst", [1, 5, 40, 200])
    def test_a_burst_loses_nothing(self, burst: int) -> None:
        near, far = open_socketcan(bus("can0")), open_socketcan(bus("can1"))
        assert is_hardware("can0")
        frames = b"".join(pack(0x180 + n % 128, n.to_bytes(8, "little")) for n in range(burst))
        begun = time.monotonic()
        near.send(frames)
        seconds = time.monotonic() - begun
        assert receive(far, len(frames)) == frames
        assert (near.drops(), far.drops()) == ({}, {})
        wire_s = burst * 111e-6
        assert seconds > 0.9 * (wire_s - 5 * 111e-6)
        near.close()
        far.close()

    def test_a_controller_that_goes_down_and_up(self) -> None:
        near, far = open_socketcan(bus("can0")), open_socketcan(bus("can1"))
        ip("link", "set", "can0", "down")
        try:
            assert near.receive(WAIT_S) == b""
            assert near.down is not None
            assert far.down is None
        finally:
            ip("link", "set", "can0", "up")
        near.send(SYNC)
        assert receive(far, 16) == SYNC
        far.send(SYNC)
        assert receive(near, 16) == SYNC
        near.close()
        far.close()


def test_the_raw_port_is_faster_than_python_cans() -> None:
    """Frames out and in through both ports, with the same kernel below."""
    packet = b"".join(pack(0x181 + n, bytes(8)) for n in range(10))
    seconds = {}
    for name, make in (
        ("python-can", lambda: PythonCanPort("right", can.Bus(interface="socketcan", channel="vcan0"))),
        ("raw", lambda: open_socketcan(bus("vcan0"))),
    ):
        near, far = make(), make()
        begun = time.perf_counter()
        for _ in range(50):
            near.send(packet)
            got = b""
            while len(got) < len(packet):
                got += far.receive(WAIT_S)
        seconds[name] = time.perf_counter() - begun
        near.close()
        far.close()
    assert seconds["raw"] < seconds["python-can"]
