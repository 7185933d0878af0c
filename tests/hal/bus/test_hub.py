"""The host of the virtual bus: one order, nobody waits for anybody, paths, and what happens when somebody dies."""

from __future__ import annotations

import asyncio
import csv
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from hal.bus import address
from hal.bus.__main__ import main
from hal.bus.errors import BusError, BusInUseError, BusLostError, BusOverflowError, BusUnavailableError
from hal.bus.hub import BusHub, HubGroup, serve_in_thread
from hal.bus.ports import CosimPort
from hal.errors import HalError
from hal.profile.frames import pack

WAIT_S = 2.0


def numbered(*numbers: int) -> bytes:
    return b"".join(pack(number, number.to_bytes(4, "little")) for number in numbers)


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "bus")


class TestHost:
    def test_is_a_port_of_its_own_bus(self, path: str) -> None:
        with BusHub(path) as hub:
            one, other = CosimPort("one", path), CosimPort("other", path)
            one.send(numbered(1, 2))
            assert hub.receive(WAIT_S) == numbered(1, 2)
            assert other.receive(0.0) == numbered(1, 2)
            hub.send(numbered(3))
            assert one.receive(0.0) == other.receive(0.0) == numbered(3)
            assert hub.receive(0.0) == b""

    def test_all_see_one_order(self, path: str) -> None:
        with BusHub(path) as hub:
            senders = [CosimPort(str(index), path) for index in range(3)]
            watchers = [CosimPort(str(index), path) for index in range(2)]
            for round_ in range(20):
                for index, sender in enumerate(senders):
                    sender.send(numbered(10 * round_ + index))
            host = b""
            while len(host) < 60 * 16:
                host += hub.receive(WAIT_S)
            seen = [watcher.receive(0.0) for watcher in watchers]
            assert seen[0] == seen[1] == host

    def test_a_timeout_is_kept_below_a_millisecond(self, path: str) -> None:
        with BusHub(path) as hub:
            shortest = 1.0
            for _ in range(20):
                start = time.monotonic()
                assert hub.receive(0.0003) == b""
                shortest = min(shortest, time.monotonic() - start)
            assert 0.0003 <= shortest < 0.001

    def test_frames_sent_just_before_leaving_arrive(self, path: str) -> None:
        with BusHub(path) as hub:
            client = CosimPort("c", path)
            assert hub.receive(0.0) == b""
            hub.send(numbered(7))
            client.send(numbered(8))
            client.close()
            assert hub.receive(WAIT_S) == numbered(8)
            assert hub.receive(0.01) == b""
            assert hub.clients == 0

    def test_a_slow_client_loses_its_frames_and_blocks_nobody(self, path: str) -> None:
        with BusHub(path) as hub:
            slow, quick = CosimPort("slow", path), CosimPort("quick", path)
            assert hub.receive(0.0) == b""
            frames = numbered(*range(64))
            start = time.monotonic()
            for _ in range(5000):
                hub.send(frames)
                assert quick.receive(0.0) == frames
            assert time.monotonic() - start < 20.0
            assert hub.dropped_frames > 0
            assert hub.dropped_frames % 64 == 0
            assert slow.receive(0.0).startswith(frames)

    def test_a_malformed_packet_is_counted_and_goes_nowhere(self, path: str) -> None:
        with BusHub(path) as hub:
            other = CosimPort("other", path)
            rogue = address.connect(path, WAIT_S)
            rogue.send(bytes(15))
            rogue.send(bytes(address.MAX_PACKET + 16))
            assert hub.receive(0.01) == b""
            assert hub.malformed_packets == 2
            assert other.receive(0.0) == b""
            rogue.close()

    def test_half_frames_and_a_closed_hub_are_refused(self, path: str) -> None:
        hub = BusHub(path)
        with pytest.raises(BusError, match="not whole frames"):
            hub.send(bytes(15))
        hub.close()
        hub.close()
        with pytest.raises(BusLostError):
            hub.send(bytes(16))
        with pytest.raises(BusLostError):
            hub.receive(0.0)

    def test_long_packets_are_split(self, path: str) -> None:
        with BusHub(path) as hub:
            client = CosimPort("c", path)
            frames = numbered(*range(1500))
            client.send(frames)
            assert hub.receive(WAIT_S) == frames
            hub.send(frames)
            assert client.receive(WAIT_S) == frames


class TestPath:
    def test_a_second_host_is_refused_and_the_first_unharmed(self, path: str) -> None:
        with BusHub(path) as hub:
            client = CosimPort("c", path)
            with pytest.raises(BusInUseError, match=r"served by another process"):
                BusHub(path)
            client.send(numbered(1))
            assert hub.receive(WAIT_S) == numbered(1)

    def test_the_socket_goes_with_its_host(self, path: str) -> None:
        with BusHub(path):
            assert Path(path).is_socket()
            assert Path(path).stat().st_mode & 0o077 == 0
        assert not Path(path).exists()

    def test_a_stale_socket_is_replaced(self, path: str) -> None:
        left = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        left.bind(path)
        left.close()
        with BusHub(path) as hub:
            client = CosimPort("c", path)
            client.send(numbered(1))
            assert hub.receive(WAIT_S) == numbered(1)

    def test_a_file_in_the_way_is_left_alone(self, path: str) -> None:
        Path(path).write_text("mine")
        with pytest.raises(BusUnavailableError, match="no socket"):
            BusHub(path)
        assert Path(path).read_text() == "mine"

    def test_a_host_does_not_remove_its_successors_socket(self, path: str) -> None:
        first = BusHub(path)
        os.unlink(path)
        with BusHub(path):
            first.close()
            assert Path(path).is_socket()

    def test_a_directory_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(BusUnavailableError, match="cannot be hosted"):
            BusHub(tmp_path / "absent" / "bus")

    def test_a_path_too_long(self, tmp_path: Path) -> None:
        with pytest.raises(BusUnavailableError, match="longer than 107"):
            BusHub(tmp_path / ("x" * 120))

    def test_bare_names_lie_in_the_run_directory(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("COSIM_RUN_DIR", str(tmp_path / "run"))
        assert address.socket_path("bus0") == tmp_path / "run" / "bus0"
        assert (tmp_path / "run").stat().st_mode & 0o777 == 0o700
        assert address.socket_path("/absolute/bus0") == Path("/absolute/bus0")
        monkeypatch.delenv("COSIM_RUN_DIR")
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        assert address.run_directory() == tmp_path / f"hrp-cosim-{os.getuid()}"

    def test_errors_are_of_the_hal(self) -> None:
        assert issubclass(BusError, HalError)


class TestClient:
    def test_waits_for_its_host(self, path: str) -> None:
        hubs: list[BusHub] = []
        timer = threading.Timer(0.1, lambda: hubs.append(BusHub(path)))
        timer.start()
        client = CosimPort("c", path, connect_timeout_s=5.0)
        timer.join()
        client.send(numbered(1))
        assert hubs[0].receive(WAIT_S) == numbered(1)
        hubs[0].close()

    def test_waits_no_longer_than_told(self, path: str) -> None:
        start = time.monotonic()
        with pytest.raises(BusUnavailableError, match="start its server"):
            CosimPort("c", path, connect_timeout_s=0.05)
        with pytest.raises(can.CanInitializationError, match="start its server"):
            can.Bus(interface="cosim", channel=path, connect_timeout=0.05)
        assert time.monotonic() - start < 1.0

    def test_notices_that_its_host_is_gone(self, path: str) -> None:
        hub = BusHub(path)
        port, bus = CosimPort("left", path), can.Bus(interface="cosim", channel=path)
        assert hub.receive(0.0) == b""
        hub.close()
        with pytest.raises(BusLostError, match="left has gone"):
            port.receive(WAIT_S)
        with pytest.raises(BusLostError, match="left has gone"):
            port.send(numbered(1))
        with pytest.raises(can.CanOperationError, match="has gone"):
            bus.recv(WAIT_S)
        with pytest.raises(can.CanOperationError, match="has gone"):
            bus.send(can.Message(arbitration_id=1))
        bus.shutdown()

    def test_says_so_when_its_host_does_not_read(self, path: str) -> None:
        with BusHub(path):
            port, bus = CosimPort("c", path), can.Bus(interface="cosim", channel=path)

            def fill(send: Callable[[], None]) -> None:
                for _ in range(20000):
                    send()

            frames, message = numbered(*range(64)), can.Message(arbitration_id=1)
            with pytest.raises(BusOverflowError, match="stopped to read"):
                fill(lambda: port.send(frames))
            with pytest.raises(can.CanOperationError, match="no room"):
                fill(lambda: bus.send(message, timeout=0.01))
            bus.shutdown()

    def test_a_packet_of_several_frames_wakes_an_asynchronous_reader_for_each(self, path: str) -> None:
        async def listen(hub: BusHub, bus: can.BusABC) -> list[int]:
            reader = can.AsyncBufferedReader()
            notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())
            hub.send(numbered(1, 2, 3, 4, 5))
            received = [await asyncio.wait_for(reader.get_message(), WAIT_S) for _ in range(5)]
            notifier.stop()
            return [frame.arbitration_id for frame in received]

        with BusHub(path) as hub, can.Bus(interface="cosim", channel=path) as bus:
            assert hub.receive(0.0) == b""
            assert asyncio.run(listen(hub, bus)) == [1, 2, 3, 4, 5]

    def test_can_fd_is_refused(self, path: str) -> None:
        with serve_in_thread(path):
            bus = can.Bus(interface="cosim", channel=path)
            with pytest.raises(ValueError, match="classic CAN"):
                bus.send(can.Message(arbitration_id=1, data=bytes(12), is_fd=True))
            bus.shutdown()


class TestGroup:
    def test_waits_on_all_buses_together(self, tmp_path: Path) -> None:
        paths = [str(tmp_path / f"bus{index}") for index in range(3)]
        with HubGroup([BusHub(each) for each in paths]) as group:
            clients = [CosimPort(each, each) for each in paths]
            clients[2].send(numbered(2))
            clients[0].send(numbered(0))
            arrived: dict[int, bytes] = {}
            while len(arrived) < 2:
                arrived.update(group.wait(WAIT_S))
            assert arrived == {0: numbered(0), 2: numbered(2)}
            assert group.wait(0.0) == []
            start = time.monotonic()
            assert group.wait(0.02) == []
            assert 0.015 <= time.monotonic() - start < 1.0

    def test_an_interrupt_ends_the_wait(self, path: str) -> None:
        with HubGroup([BusHub(path)]) as group:
            threading.Timer(0.05, group.interrupt).start()
            start = time.monotonic()
            assert group.wait(30.0) == []
            assert time.monotonic() - start < 5.0
            assert group.wait(0.0) == []


@pytest.mark.processes
class TestProcesses:
    def run(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def test_two_programs_talk_over_a_bare_bus(self, path: str) -> None:
        host = self.run("-m", "hal.bus", path)
        assert host.stdout is not None
        assert host.stdout.readline() == f"bus {path}\n"
        echo = (
            "import can, sys\n"
            "bus = can.Bus(interface='cosim', channel=sys.argv[1])\n"
            "bus.send(can.Message(arbitration_id=1, is_extended_id=False))\n"
            "m = bus.recv(20)\n"
            "bus.send(can.Message(arbitration_id=m.arbitration_id + 1, data=m.data, is_extended_id=False))\n"
            "bus.shutdown()\n"
        )
        port = CosimPort("here", path)
        client = self.run("-c", echo, path)
        assert port.receive(20.0) == pack(1, b"")
        port.send(pack(0x20, b"hello"))
        assert port.receive(20.0) == pack(0x21, b"hello")
        assert client.wait(20) == 0
        host.send_signal(signal.SIGTERM)
        assert host.wait(20) == 0
        with pytest.raises(BusLostError):
            port.receive(WAIT_S)
        assert not Path(path).exists()

    def test_a_killed_host_is_noticed_and_replaced(self, path: str) -> None:
        host = self.run("-m", "hal.bus", path)
        assert host.stdout is not None
        host.stdout.readline()
        port = CosimPort("c", path)
        host.kill()
        host.wait()
        with pytest.raises(BusLostError):
            port.receive(WAIT_S)
        assert Path(path).is_socket()
        with BusHub(path):
            CosimPort("d", path).close()

    def test_can_logger_writes_what_was_sent(self, path: str, tmp_path: Path) -> None:
        log = tmp_path / "bus.csv"
        with BusHub(path) as hub:
            # As `python -m can.logger`, with the Ctrl-C that a program started in the background lacks.
            heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
            module = "import runpy; runpy.run_module('can.logger', run_name='__main__')"
            logger = self.run("-c", f"{heed}; {module}", "-i", "cosim", "-c", path, "-f", str(log))
            deadline = time.monotonic() + 30.0
            while hub.clients == 0 and time.monotonic() < deadline:
                hub.receive(0.05)
            for number in range(20):
                hub.send(pack(0x180 + number, bytes((number,) * (number % 9))))
            # It ends on Ctrl-C only once its reader thread runs, which the frames' arrival does not show.
            while logger.poll() is None and time.monotonic() < deadline:
                time.sleep(0.3)
                logger.send_signal(signal.SIGINT)
            assert logger.returncode is not None
        with log.open() as file:
            rows = list(csv.DictReader(file))
        assert [int(row["arbitration_id"], 16) for row in rows] == list(range(0x180, 0x180 + 20))
        assert [int(row["dlc"]) for row in rows] == [number % 9 for number in range(20)]

    def test_a_bus_in_use_ends_the_program(self, path: str, capsys: pytest.CaptureFixture[str]) -> None:
        with BusHub(path):
            assert main([path]) == 1
        assert "served by another process" in capsys.readouterr().err
