"""What every bus owes its users: one set of laws for the virtual bus, python-can's `virtual` and SocketCAN."""

from __future__ import annotations

import socket
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from hal.bus.hub import serve_in_thread
from hal.bus.ports import FramePort, PythonCanPort, open_port
from hal.profile.frames import CAN_ERR_FLAG, CAN_RTR_FLAG, pack
from schemas.robot import Bus

OpenBus = Callable[..., can.BusABC]
WAIT_S = 2.0


def socketcan_exists() -> bool:
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind(("vcan0",))
    except OSError:
        return False
    return True


INTERFACES = ["cosim", "virtual", *(["socketcan"] if socketcan_exists() else [])]


@pytest.fixture(params=INTERFACES)
def address(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """(interface, channel) of a bus of its own."""
    interface = request.param
    if interface == "cosim":
        path = str(tmp_path / "bus")
        with serve_in_thread(path):
            yield interface, path
    else:
        yield interface, "vcan0" if interface == "socketcan" else uuid.uuid4().hex


@pytest.fixture
def open_bus(address: tuple[str, str]) -> Iterator[OpenBus]:
    opened: list[can.BusABC] = []

    def open_one(**options: Any) -> can.BusABC:
        bus = can.Bus(interface=address[0], channel=address[1], **options)
        opened.append(bus)
        return bus

    yield open_one
    for bus in opened:
        bus.shutdown()


def message(identifier: int, data: bytes = b"", **options: bool) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **options})


def take(bus: can.BusABC, count: int) -> list[can.Message]:
    taken = [bus.recv(WAIT_S) for _ in range(count)]
    assert None not in taken
    return [frame for frame in taken if frame is not None]


class TestPythonCanContract:
    def test_order_is_preserved(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        for number in range(200):
            sender.send(message(number + 1, number.to_bytes(2, "little")))
        received = take(receiver, 200)
        assert [frame.arbitration_id for frame in received] == list(range(1, 201))
        assert [int.from_bytes(frame.data, "little") for frame in received] == list(range(200))

    def test_everybody_else_receives_and_the_sender_does_not(self, open_bus: OpenBus) -> None:
        buses = [open_bus() for _ in range(4)]
        for index, sender in enumerate(buses):
            sender.send(message(0x100 + index))
            for receiver in buses:
                if receiver is not sender:
                    assert take(receiver, 1)[0].arbitration_id == 0x100 + index
        for bus in buses:
            assert bus.recv(0.0) is None

    def test_own_messages_come_back_on_request(self, open_bus: OpenBus) -> None:
        bus = open_bus(receive_own_messages=True)
        other = open_bus()
        bus.send(message(0x123, b"\x01"))
        assert take(bus, 1)[0].arbitration_id == 0x123
        assert take(other, 1)[0].arbitration_id == 0x123

    @pytest.mark.parametrize("length", range(9))
    def test_lengths(self, open_bus: OpenBus, length: int) -> None:
        sender, receiver = open_bus(), open_bus()
        data = bytes(range(0xF0, 0xF0 + length))
        sender.send(message(0x7FF, data))
        frame = take(receiver, 1)[0]
        assert (frame.arbitration_id, frame.dlc, bytes(frame.data)) == (0x7FF, length, data)
        assert not any((frame.is_extended_id, frame.is_remote_frame, frame.is_error_frame, frame.is_fd))

    def test_extended_and_remote_flags(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        sender.send(message(0x1ABCDEF0, b"\x07", is_extended_id=True))
        sender.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=5))
        sender.send(message(0x123))
        extended, remote, plain = take(receiver, 3)
        assert (extended.arbitration_id, extended.is_extended_id, bytes(extended.data)) == (0x1ABCDEF0, True, b"\x07")
        assert (remote.is_remote_frame, remote.dlc, remote.is_extended_id) == (True, 5, False)
        assert (plain.is_extended_id, plain.is_remote_frame) == (False, False)

    def test_an_empty_bus_times_out_in_time(self, open_bus: OpenBus) -> None:
        bus = open_bus()
        assert bus.recv(0.0) is None
        start = time.monotonic()
        assert bus.recv(0.05) is None
        assert 0.04 <= time.monotonic() - start < 1.0

    def test_timestamps_never_step_back(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        for number in range(50):
            sender.send(message(number))
        stamps = [frame.timestamp for frame in take(receiver, 50)]
        assert stamps == sorted(stamps)
        assert stamps[0] > 0.0

    def test_filters(self, open_bus: OpenBus) -> None:
        sender = open_bus()
        receiver = open_bus(can_filters=[{"can_id": 0x180, "can_mask": 0x780, "extended": False}])
        for identifier in (0x080, 0x181, 0x200, 0x1FF, 0x581):
            sender.send(message(identifier))
        assert [frame.arbitration_id for frame in take(receiver, 2)] == [0x181, 0x1FF]
        assert receiver.recv(0.01) is None

    def test_notifier_delivers(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        reader = can.BufferedReader()
        notifier = can.Notifier(receiver, [reader], timeout=0.05)
        try:
            sender.send(message(0x42, b"\x2a"))
            received = reader.get_message(WAIT_S)
        finally:
            notifier.stop()
        assert received is not None
        assert bytes(received.data) == b"\x2a"

    def test_shutdown_leaves_the_bus_to_the_others(self, open_bus: OpenBus) -> None:
        leaver, sender, receiver = open_bus(), open_bus(), open_bus()
        leaver.shutdown()
        sender.send(message(0x11))
        assert take(receiver, 1)[0].arbitration_id == 0x11


class TestPortContract:
    @pytest.fixture
    def ports(self, address: tuple[str, str]) -> Iterator[tuple[FramePort, FramePort, FramePort]]:
        bus = Bus(name="right", interface=address[0], channel=address[1])
        opened = (open_port(bus), open_port(bus), open_port(bus))
        yield opened
        for port in opened:
            port.close()

    def receive(self, port: FramePort, size: int) -> bytes:
        frames = b""
        while len(frames) < size:
            more = port.receive(WAIT_S)
            assert more
            frames += more
        return frames

    def test_packets_reach_the_others_whole(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        frames = b"".join(pack(0x200 + n, bytes(range(n % 9))) for n in range(40))
        ports[0].send(frames)
        assert self.receive(ports[1], len(frames)) == frames
        assert self.receive(ports[2], len(frames)) == frames
        assert ports[0].receive(0.0) == b""

    def test_flags_survive(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        frames = pack(0x123 | CAN_RTR_FLAG, b"") + pack(0x9ABCDEF0, b"\1\2") + pack(0x7FF, b"")
        ports[0].send(frames)
        assert self.receive(ports[1], len(frames)) == frames

    def test_what_waits_comes_at_once(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        for number in range(3):
            ports[0].send(pack(number, b""))
        received = self.receive(ports[1], 3 * 16)
        assert received == b"".join(pack(number, b"") for number in range(3))

    def test_timeout(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        assert ports[0].receive(0.0) == b""
        start = time.monotonic()
        assert ports[0].receive(0.03) == b""
        assert 0.02 <= time.monotonic() - start < 1.0

    def test_half_a_frame_is_refused(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        with pytest.raises(Exception, match="not whole frames"):
            ports[0].send(bytes(17))

    def test_name_is_the_bus(self, ports: tuple[FramePort, FramePort, FramePort]) -> None:
        assert ports[0].name == "right"


def test_error_frames_keep_their_flag(tmp_path: Path) -> None:
    path = str(tmp_path / "bus")
    with serve_in_thread(path):
        port = open_port(Bus(name="b", channel=path))
        bus = can.Bus(interface="cosim", channel=path)
        wrapped = PythonCanPort("b", bus)
        port.send(pack(0x20 | CAN_ERR_FLAG, bytes(8)))
        assert wrapped.receive(WAIT_S) == pack(0x20 | CAN_ERR_FLAG, bytes(8))
        wrapped.send(pack(0x20 | CAN_ERR_FLAG, bytes(8)))
        assert port.receive(WAIT_S) == pack(0x20 | CAN_ERR_FLAG, bytes(8))
        port.close()
        wrapped.close()
