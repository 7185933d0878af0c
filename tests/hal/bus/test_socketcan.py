"""The parts of the port that do not need the kernel's CAN: a socket pair stands in for the interface."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.bus.counters import DropCounters, describe
from hal.bus.errors import BusDownError, BusError, BusLostError, BusOverflowError, BusUnavailableError
from hal.bus.gather import PortGroup
from hal.bus.ports import DirectPort, RecordingPort
from hal.bus.socketcan import SocketCanPort, is_hardware, open_socketcan
from hal.profile.frames import pack
from schemas.robot import Bus

SYNC = pack(0x80, b"")


class PairBus:
    """One end of a socket pair in the place of python-can's bus."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def shutdown(self) -> None:
        self.socket.close()


class FailingSocket:
    """A socket whose next calls fail by given errors, once each."""

    def __init__(self, inner: socket.socket) -> None:
        self._inner = inner
        self.errors: list[int] = []

    def send(self, data: bytes, flags: int) -> int:
        self._fail()
        return self._inner.send(data, flags)

    def recv(self, size: int, flags: int) -> bytes:
        self._fail()
        return self._inner.recv(size, flags)

    def _fail(self) -> None:
        if self.errors and (number := self.errors.pop(0)):
            raise OSError(number, errno.errorcode[number])

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)


@pytest.fixture
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[SocketCanPort, FailingSocket, socket.socket]]:
    """(port on the loopback interface's name, its socket, the other end); its patience [s] may be given."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    far.setblocking(False)
    failing = FailingSocket(near)
    room_s: float = getattr(request, "param", 30.0)
    port = SocketCanPort("right", "lo", PairBus(failing), room_s=room_s)  # type: ignore[arg-type]  # as good a socket
    yield port, failing, far
    port.close()
    far.close()


def test_frames_go_one_by_one(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, _, far = pair
    frames = [SYNC, pack(0x201, b"\1\2")]
    port.send(b"".join(frames))
    assert [far.recv(64), far.recv(64)] == frames
    for frame in frames:
        far.send(frame)
    assert port.receive(1.0) == b"".join(frames)
    assert port.receive(0.0) == b""
    with pytest.raises(BusError, match="not whole frames"):
        port.send(bytes(17))


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENETUNREACH, errno.ENODEV, errno.ENXIO])
def test_an_outage_is_told_once_and_over_when_the_interface_is_up(
    pair: tuple[SocketCanPort, FailingSocket, socket.socket], number: int
) -> None:
    port, failing, far = pair
    failing.errors = [0, number]
    with pytest.raises(BusDownError, match="bus right: interface lo is down") as caught:
        port.send(SYNC * 3)
    assert caught.value.sent == 16
    assert far.recv(64) == SYNC
    assert port.down is not None
    assert port.down is None, "lo is up"
    port.send(SYNC)
    assert far.recv(64) == SYNC


def test_what_came_before_an_outage_is_received(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, far = pair
    far.send(SYNC)
    failing.errors = [errno.ENETDOWN]
    assert port.receive(0.0) == SYNC
    with pytest.raises(BusDownError):
        port.send(SYNC)  # an outage that nobody has been told of yet
    port.send(SYNC)
    assert far.recv(64) == SYNC


def test_a_group_shows_an_outage_once(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, far = pair
    group = PortGroup([port])
    far.send(SYNC)
    failing.errors = [errno.ENETDOWN, errno.EAGAIN]
    assert group.receive(5.0) == [(0, b"")]
    assert group.receive(5.0) == [(0, SYNC)]
    assert group.receive(0.0) == []


def test_room_in_the_queue_is_waited_for(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, far = pair
    failing.errors = [errno.ENOBUFS, errno.EAGAIN, errno.ENOBUFS, 0]
    port.send(SYNC)
    assert far.recv(64) == SYNC


@pytest.mark.parametrize("pair", [0.005], indirect=True)
def test_a_queue_that_stays_full_is_an_overflow(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, far = pair
    failing.errors = [0, *[errno.ENOBUFS] * 10_000]
    with pytest.raises(BusOverflowError, match="lo takes no more frames; does a node acknowledge") as caught:
        port.send(SYNC * 2)
    assert caught.value.sent == 16
    left = len(failing.errors)
    with pytest.raises(BusOverflowError):
        port.send(SYNC)
    assert len(failing.errors) == left - 1, "a queue that was full is not waited for again"
    failing.errors = []
    assert port.down is None
    port.send(SYNC)
    assert far.recv(64) == SYNC


def test_any_other_error_is_the_end(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, _ = pair
    failing.errors = [errno.EIO]
    with pytest.raises(BusLostError, match="bus right has gone: lo"):
        port.send(SYNC)
    failing.errors = [errno.EIO]
    with pytest.raises(BusLostError, match="bus right has gone: lo"):
        port.receive(0.0)


def test_an_absent_interface_stays_down() -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    failing = FailingSocket(near)
    port = SocketCanPort("right", "no_such_can", PairBus(failing))  # type: ignore[arg-type]  # as above
    failing.errors = [errno.ENODEV]
    assert port.receive(0.0) == b""
    for _ in range(3):
        assert port.down is not None
        with pytest.raises(BusDownError):
            port.send(SYNC)
    port.close()
    far.close()


def test_the_log_holds_what_went_out(pair: tuple[SocketCanPort, FailingSocket, socket.socket]) -> None:
    port, failing, _ = pair
    recording = RecordingPort(port)
    failing.errors = [0, errno.ENETDOWN]
    with pytest.raises(BusDownError):
        recording.send(SYNC * 2)
    assert recording.take() == (SYNC, b"")
    assert recording.down is not None
    assert DirectPort("b", lambda frames: frames).down is None


def test_counters_tell_their_rises(tmp_path: Path) -> None:
    statistics = tmp_path / "can7" / "statistics"
    statistics.mkdir(parents=True)
    (statistics / "rx_over_errors").write_text("7\n")
    (statistics / "tx_dropped").write_text("0\n")
    near, far = socket.socketpair()
    counters = DropCounters("can7", near, str(tmp_path))
    assert counters.rises() == {}
    (statistics / "rx_over_errors").write_text("10\n")
    (statistics / "tx_dropped").write_text("2\n")
    rises = counters.rises()
    assert rises == {"rx_over_errors": 3, "tx_dropped": 2}
    assert describe(rises) == "rx_over_errors +3, tx_dropped +2"
    assert counters.rises() == {}
    (statistics / "rx_over_errors").write_text("1\n")  # a new life of the interface
    assert counters.rises() == {"rx_over_errors": 1}
    counters.close()
    near.close()
    far.close()


def test_an_interface_without_a_controller_behind_it_is_not_paced(tmp_path: Path) -> None:
    for place, name in (("virtual/net", "vcan0"), ("pci0000:00/0000:00:05.0/net", "can0")):
        (tmp_path / "devices" / place / name).mkdir(parents=True)
        (tmp_path / "class").mkdir(exist_ok=True)
        (tmp_path / "class" / name).symlink_to(tmp_path / "devices" / place / name)
    assert not is_hardware("vcan0", str(tmp_path / "class"))
    assert is_hardware("can0", str(tmp_path / "class"))


def test_a_missing_interface_is_one_clear_error() -> None:
    with pytest.raises(BusUnavailableError, match=r"bus right: socketcan no_such_can cannot be opened: .*; "):
        open_socketcan(Bus(name="right", interface="socketcan", channel="no_such_can"))
