"""The plant's service on buses of which one goes away: a thread of its own, the HAL's master on the other side."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.bus.errors import BusDownError, BusOverflowError
from hal.bus.gather import PortGroup
from hal.bus.hub import BusHub
from hal.bus.ports import CosimPort, FramePort
from hal.bus.socketcan import open_socketcan
from hal.decode import upload_request
from hal.filters import hal_filters
from hal.master import Master
from plant_service.plant import Plant
from plant_service.service import PlantService
from schemas.base import Model
from schemas.keys import Keys
from schemas.load import load_run
from schemas.messages import DriveState, HalStatus, PlantTruth, RobotState
from schemas.robot import Bus
from tests.hal.bus.test_socketcan_kernel import has_interface, ip

KERNEL = ("vcan0", "vcan1", "vcan2")
PATIENCE_S = 20.0
AWAY = 1
"""Index of the bus that goes away."""


class Life:
    """In the place of `Lifecycle`: no processes, what is published is kept."""

    def __init__(self) -> None:
        self.transport = self
        self.keys = Keys("test", "arm9")
        self.signalled: int | None = None
        self.over = False
        self.events: list[tuple[str, str]] = []
        self.truths: list[PlantTruth] = []

    def declare_publisher(self, key: str) -> None:
        """Nothing to prepare."""

    def finished(self, service: str) -> bool:
        return self.over

    def check_peers(self) -> None:
        """The HAL lives in the same process."""

    def stamp(self, sequence: int, time_ns: int) -> None:
        """Events are kept without a time."""

    def publish(self, key: str, message: Model) -> None:
        if isinstance(message, PlantTruth):
            self.truths.append(message)

    def event(self, kind: str, text: str, severity: str = "info") -> None:
        self.events.append((kind, text))

    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.events]


class FullHub(BusHub):
    """A bus whose transmit queue may be full."""

    full = False

    def send(self, frames: bytes) -> None:
        if self.full:
            raise BusOverflowError(f"bus {self.name}: can7 takes no more frames")
        super().send(frames)


class Card:
    """The HAL's end of a bus, which may be taken down alone."""

    def __init__(self, port: FramePort) -> None:
        self._port = port
        self.name = port.name
        self.is_down = False

    @property
    def down(self) -> str | None:
        return f"bus {self.name}: interface can7 is down" if self.is_down else self._port.down

    def send(self, frames: bytes) -> None:
        if self.is_down:
            raise BusDownError(f"bus {self.name}: interface can7 is down")
        self._port.send(frames)

    def receive(self, timeout_s: float) -> bytes:
        frames = self._port.receive(timeout_s)
        return b"" if self.is_down else frames

    def fileno(self) -> int:
        return self._port.fileno()

    def close(self) -> None:
        self._port.close()


class Loop:
    """arm9's plant served in a thread, and its master."""

    def __init__(self, open_hal: Callable[[Bus], FramePort], plant_ports: list[FramePort]) -> None:
        run = load_run("arm9-transition", {"duration_s": 60.0})
        description = run.robot.description
        self.life = Life()
        self.buses = PortGroup(plant_ports)
        self.service = PlantService(run, Plant(run), self.buses, self.life)  # type: ignore[arg-type]  # stand-in
        self.cards = [Card(open_hal(bus)) for bus in description.buses]
        self.master = Master(description, self.cards, "me")
        self.core = self.master.core
        self.kinds: list[str] = []
        self.sequence = 0
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def boot(self) -> None:
        self.master.boot(PATIENCE_S)
        self.cycles(20)
        assert self.kinds == []

    def _serve(self) -> None:
        try:
            self.service.lockstep()
        except BaseException as error:  # noqa: BLE001 - told by `close`
            self.failure = error

    def cycles(self, count: int) -> RobotState:
        for _ in range(count):
            self.master.sync(self.sequence)
            state = self.master.gather(self.sequence, PATIENCE_S)
            self.master.apply(None)
            self.sequence += 1
            self.kinds += [event.kind for event in self.core.drain_events()]
            self.master.frames(self.sequence)
        return state

    def cycles_until(self, condition: Callable[[], bool]) -> RobotState:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            state = self.cycles(1)
            if condition():
                return state
            assert time.monotonic() < deadline, (self.kinds, self.life.events)

    def close(self) -> None:
        self.life.over = True
        self._thread.join(10.0)
        self.master.close()
        self.buses.close()
        assert self.failure is None, self.failure


@pytest.fixture(params=["cosim", *(["socketcan"] if has_interface("vcan2") else [])])
def loop(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Loop]:
    names = [f"arm9-{index}" for index in range(3)]
    if request.param == "cosim":
        hosted: list[FramePort] = [BusHub(tmp_path / name, name) for name in names]
        made = Loop(lambda bus: CosimPort(bus.name, tmp_path / bus.name), hosted)
    else:
        robot = load_run("arm9-transition").robot.description
        kernel = {
            name: Bus(name=name, interface="socketcan", channel=channel)
            for name, channel in zip(names, KERNEL, strict=True)
        }
        joined: list[FramePort] = [open_socketcan(kernel[name]) for name in names]
        made = Loop(lambda bus: open_socketcan(kernel[bus.name], hal_filters(robot, bus.name)), joined)
    try:
        made.boot()
        yield made
    finally:
        made.close()


def assert_recovered(loop: Loop, state: RobotState, before: RobotState) -> None:
    assert loop.core.status is HalStatus.SAFE_STOP
    assert loop.kinds.count("safe_stop") == 1
    assert loop.kinds.count("bus_recovered") == 1
    assert set(state.drive_state) == {DriveState.OPERATION_ENABLED}
    moved = np.abs(np.array(state.position_measured) - np.array(before.position_measured)).max()
    assert moved < np.radians(1.0)


def test_the_hals_card_alone_goes_down(loop: Loop) -> None:
    before = loop.cycles(1)
    loop.cards[AWAY].is_down = True
    served = len(loop.life.truths)
    loop.cycles(50)
    assert loop.core.troubled_buses == ("arm9-1",)
    assert loop.life.kinds() == ["sync_missing"]
    assert "arm9-1" in loop.life.events[0][1]
    assert len(loop.life.truths) - served >= 48, "time went on for the others"
    loop.cards[AWAY].is_down = False
    state = loop.cycles_until(lambda: not loop.core.troubled_buses)
    assert_recovered(loop, state, before)
    loop.cycles(20)
    assert loop.life.kinds() == ["sync_missing"]


@pytest.mark.skipif(not has_interface("vcan2"), reason="no vcan0-2 on this machine: run in `cosim can-vm`")
@pytest.mark.parametrize("loop", ["socketcan"], indirect=True)
@pytest.mark.parametrize("away", [(AWAY,), (0, 1, 2)])
def test_interfaces_of_both_go_down(loop: Loop, away: tuple[int, ...]) -> None:
    before = loop.cycles(1)
    for index in away:
        ip("link", "set", KERNEL[index], "down")
    try:
        for _ in range(30):
            loop.cycles(1)
            time.sleep(0.002)
        assert len(loop.core.troubled_buses) == len(away)
        assert loop.life.kinds() == ["bus_down"] * len(away)
    finally:
        for index in away:
            ip("link", "set", KERNEL[index], "up")
    state = loop.cycles_until(lambda: not loop.core.troubled_buses)
    assert loop.kinds.count("bus_recovered") == len(away)
    assert set(state.drive_state) == {DriveState.OPERATION_ENABLED}
    moved = np.abs(np.array(state.position_measured) - np.array(before.position_measured)).max()
    assert moved < np.radians(1.0)
    assert loop.life.kinds().count("bus_recovered") == len(away)


def test_a_full_bus_is_told_once_and_is_back_when_it_takes_a_frame(tmp_path: Path) -> None:
    run = load_run("arm9-transition", {"clock": "realtime", "duration_s": 60.0})
    hubs = [FullHub(tmp_path / bus.name, bus.name) for bus in run.robot.description.buses]
    life, buses = Life(), PortGroup(hubs)
    service = PlantService(run, Plant(run, free=True), buses, life)  # type: ignore[arg-type]  # stand-in
    node = next(joint.drive.node_id for joint in run.robot.description.joints if joint.drive.bus == hubs[AWAY].name)
    client = CosimPort("client", hubs[AWAY].path)
    thread = threading.Thread(target=service.realtime)
    thread.start()

    def ask(times: int) -> None:
        for _ in range(times):
            client.send(upload_request(node, 0x1000))
            time.sleep(0.005)

    try:
        hubs[AWAY].full = True
        ask(20)
        assert life.kinds() == ["bus_down"]
        hubs[AWAY].full = False
        ask(20)
        assert life.kinds() == ["bus_down", "bus_recovered"]
        assert client.receive(PATIENCE_S)
    finally:
        life.over = True
        thread.join(10.0)
        client.close()
        buses.close()
