"""A master that is not ours, `canopen.profiles.p402.BaseNode402`, drives a simulated drive in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from hal.bus.hub import BusHub
from hal.bus.ports import FramePort, PythonCanPort
from hal.profile.frames import unpack
from hal.profile.objects import eds_path

MS = 1_000_000
NODE = 5
CYCLE_S = 0.01


class Host:
    """A thread that gives a bench's drive the frames of a bus and the time of the wall clock."""

    def __init__(self, bench, port: FramePort) -> None:
        self.bench = bench
        self._port = port
        self._faults: list[int] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @contextmanager
    def running(self) -> Iterator[Host]:
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join()
            self._port.close()

    def fault(self, code: int) -> None:
        self._faults.append(code)

    def _serve(self) -> None:
        bench, device, start = self.bench, self.bench.device, time.monotonic_ns()
        while not self._stop.is_set():
            received = self._port.receive(0.001)
            answers: list[bytes] = []
            while bench.now_ns + MS <= time.monotonic_ns() - start:
                bench.axis.integrate(1e-3)
                bench.now_ns += MS
                answers += device.tick(bench.now_ns)
            while self._faults:
                device.fault(self._faults.pop())
            for can_id, data in unpack(received):
                answers += device.receive(can_id, data, bench.now_ns)
            if answers:
                self._port.send(b"".join(answers))


@pytest.fixture(params=["virtual", "cosim"])
def master(request, bench, tmp_path) -> Iterator[tuple[Host, canopen.Network]]:
    if request.param == "virtual":
        channel = str(tmp_path)
        port: FramePort = PythonCanPort("virtual", can.Bus(interface="virtual", channel=channel))
    else:
        channel = str(tmp_path / "bus")
        port = BusHub(channel)
    with Host(bench, port).running() as host:
        network = canopen.Network()
        network.connect(interface=request.param, channel=channel)
        try:
            yield host, network
        finally:
            network.disconnect()


def wait_for(condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


@contextmanager
def operated(network: canopen.Network, target: int) -> Iterator[BaseNode402]:
    """A node configured with the set-point `target` in RPDO1, SYNC and RPDO1 running."""
    node = BaseNode402(NODE, eds_path())
    network.add_node(node)
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo[0x1006].raw = round(CYCLE_S * 1e6)
    node.sdo[0x2004].raw = 100
    node.rpdo[1].read()
    node.rpdo[1].clear()
    for index in (0x6040, 0x6060, target):
        node.rpdo[1].add_variable(index)
    node.rpdo[1].save()
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    network.sync.start(CYCLE_S)
    node.rpdo[1].start(CYCLE_S)
    try:
        yield node
    finally:
        node.rpdo[1].stop()
        network.sync.stop()


def test_position_fault_and_reset(master):
    host, network = master
    with operated(network, target=0x607A) as node:
        node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
        node.state = "OPERATION ENABLED"
        assert (node.state, node.op_mode) == ("OPERATION ENABLED", "CYCLIC SYNCHRONOUS POSITION")

        node.rpdo[1][0x607A].raw = 2000
        assert wait_for(lambda: abs(node.tpdo[1][0x6064].raw - 2000) <= 2)

        host.fault(0x7305)
        assert wait_for(node.is_faulted)
        assert wait_for(lambda: [error.code for error in node.emcy.log] == [0x7305])
        assert wait_for(lambda: node.sdo[0x603F].raw == 0x7305)
        node.reset_from_fault()
        assert node.state == "OPERATION ENABLED"
        assert (node.sdo[0x603F].raw, node.sdo[0x1001].raw) == (0, 0)

        node.rpdo[1][0x607A].raw = 1500
        assert wait_for(lambda: abs(node.tpdo[1][0x6064].raw - 1500) <= 2)


def test_torque(master):
    _, network = master
    with operated(network, target=0x6071) as node:
        node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
        node.state = "OPERATION ENABLED"
        assert (node.state, node.op_mode) == ("OPERATION ENABLED", "CYCLIC SYNCHRONOUS TORQUE")
        start = node.tpdo[1][0x6064].raw
        node.rpdo[1][0x6071].raw = 10
        assert wait_for(lambda: node.tpdo[1][0x6064].raw > start + 1000)
        assert node.tpdo[1][0x6077].raw == 10
        node.state = "SWITCH ON DISABLED"
        assert wait_for(lambda: node.tpdo[1][0x6077].raw == 0)


def test_unsupported_mode_is_refused(master):
    _, network = master
    with operated(network, target=0x607A) as node:
        with pytest.raises(TypeError):
            node.op_mode = "PROFILED POSITION"
        with pytest.raises(canopen.SdoAbortedError, match="0x06090030"):
            node.sdo[0x6060].raw = 1
        assert node.sdo[0x1008].raw == "cosim CiA 402 drive"
