"""The plant as a process: it hosts the virtual buses (or joins real ones) and lets the simulated robot live on them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Final

from hal.bus.counters import describe
from hal.bus.error_frames import split_errors
from hal.bus.errors import BusOverflowError, BusStuckError
from hal.bus.gather import PortGroup
from hal.bus.hub import BusHub
from hal.bus.ports import DropCounting, FramePort, open_port
from hal.bus.socketcan import ROOM_S, ROOM_SHARE
from hal.profile.frames import FRAME_BYTES, can_ids
from hal.profile.identifiers import SYNC
from plant_service.plant import Plant, SyncOrderError
from schemas.base import Clock
from schemas.lifecycle import Lifecycle
from schemas.load import Run
from schemas.robot import Bus
from schemas.service import ServiceOptions
from schemas.statistics import CycleMeter
from schemas.transport import PeerLostError, open_service

LOOK_UP_S: Final = 0.1
"""How often signals and peers are looked at while the bus is silent."""
LEAST_LAG_CYCLES: Final = 2
"""Realtime: periods behind the wall clock that are always made up for."""
SYNC_PULL: Final = 0.1
"""Realtime: share of a SYNC's distance from the nearest multiple of the period by which the plant follows it."""
RUN_ON_S: Final = 0.6
"""Simulated time after the loss of the HAL: the drives' watchdogs act, the hold's ramp ends, the robot settles."""
COUNT_S: Final = 1.0
"""How often the drop counters of the interfaces are read."""


class PlantService:
    """A `Plant` on its buses, with its truth on Zenoh."""

    def __init__(self, run: Run, plant: Plant, buses: PortGroup, life: Lifecycle) -> None:
        self._run = run
        self._buses = buses
        self._life = life
        self._plant = plant
        self._realtime = run.scenario.clock is Clock.REALTIME
        self._begun_s = 0.0
        """Wall clock at simulated time 0 (realtime)."""
        # More at once would trip the watchdogs of drives that have done nothing wrong.
        self._longest_lag = max(LEAST_LAG_CYCLES, run.robot.description.safety.sync_timeout_cycles - 2)
        self._period_s = run.robot.description.period_s
        self._meter = CycleMeter("plant", self._period_s)
        keys = life.transport.keys
        self._truth_key, self._health_key = keys.truth, keys.health
        self._names = tuple(bus.name for bus in run.robot.description.buses)
        self._load_keys = {name: keys.load(name) for name in self._names}
        for key in (self._truth_key, *self._load_keys.values()):
            life.transport.declare_publisher(key)
        self._down = [False] * len(self._names)
        self._full = [False] * len(self._names)
        """Of these, buses that took no frames: they are back when they take one."""
        self._sync_missing = False
        """Some bus goes without SYNC while another has it; told once."""
        self._count_due_s = 0.0

    def lockstep(self) -> None:
        """Advance one period for each SYNC; by itself when the HAL is gone or silent for long.

        Raises:
            PeerLostError: the HAL vanished; the drives have been given the time to hold.

        """
        life, plant = self._life, self._plant
        patience_s = self._run.scenario.plant.free_run_after_s
        heard = time.monotonic()
        while life.signalled is None and not life.finished("hal"):
            all_down = all(self._down)
            if self._serve(self._period_s if all_down else LOOK_UP_S):
                heard = time.monotonic()
            elif all_down and plant.sequence >= 0:
                self._run_on(self._period_s)
            if plant.sync_complete:
                self._sync_missing = any(self._down)
                self._cycle()
                continue
            try:
                life.check_peers()
                if plant.sequence >= 0 and not all_down and time.monotonic() - heard > patience_s:
                    life.event("bus_silent", f"no SYNC for {patience_s:g} s; time runs on", "warning")
                    self._run_until_heard()
                    heard = time.monotonic()
            except PeerLostError:
                self._run_on(RUN_ON_S)
                self._end()
                raise
        self._serve(0.0)  # the last commands count, whoever is faster to leave
        self._end()

    def _run_until_heard(self) -> None:
        while not self._serve(self._period_s) and self._life.signalled is None:
            self._run_on(self._period_s)
            self._life.check_peers()

    def realtime(self) -> None:
        """Follow the wall clock; a SYNC takes the period that is due, so that samples keep their distance.

        Raises:
            PeerLostError: the HAL vanished; the drives have been given the time to hold.

        """
        life, plant, period = self._life, self._plant, self._period_s
        self._begun_s = time.monotonic() - plant.time_ns * 1e-9
        while life.signalled is None and not life.finished("hal"):
            arrived = self._receive(self._idle_s(self._lag()))
            if any(SYNC in can_ids(packet) for _, packet in arrived):
                self._keep_pace()
            self._deliver(arrived)
            if self._lag() > 1.5 * period:
                self._pass_time()
            self._send_all(plant.pump(self._after_ns))
            try:
                life.check_peers()
            except PeerLostError:
                self._run_on(RUN_ON_S)
                self._end()
                raise
        self._end()

    def _idle_s(self, lag: float) -> float:
        """Time [s] until something is to be done even if nothing comes: the next period, or a frame on its wire."""
        plant = self._plant
        idle = 1.5 * self._period_s - lag
        if plant.busy_ns is not None:
            idle = min(idle, 1e-9 * (plant.busy_ns - plant.time_ns) - lag)
        return max(idle, 0.0)

    @property
    def _after_ns(self) -> int:
        """Wall time since the plant's time [ns] (realtime)."""
        if not self._realtime:
            return 0
        return round(1e9 * (time.monotonic() - self._begun_s)) - self._plant.time_ns

    def _lag(self) -> float:
        """Time by which the simulation is behind the wall clock [s]; what is too much is left out and counted."""
        lag = time.monotonic() - self._begun_s - self._plant.time_ns * 1e-9
        left_out = round(lag / self._period_s) - self._longest_lag
        if left_out > 0:
            self._meter.late_cycles += left_out
            self._plant.skip(left_out)
            self._begun_s += left_out * self._period_s
            lag -= left_out * self._period_s
        return lag

    def _keep_pace(self) -> None:
        """Pass the periods that are due at a SYNC, and draw the plant's clock towards it; the first SYNC sets it."""
        lag = self._lag()
        due = round(lag / self._period_s)
        off = lag - due * self._period_s
        self._begun_s += off if self._plant.sequence < 0 else SYNC_PULL * off
        for _ in range(due):
            self._pass_time()

    def _pass_time(self) -> None:
        """Let one period pass; what the nodes say by themselves is sent at once."""
        self._cycle()
        self._send_all(self._plant.collect())

    def _serve(self, timeout_s: float) -> bool:
        """Let the nodes answer what comes on the buses; whether anything came."""
        arrived = self._receive(timeout_s)
        self._deliver(arrived)
        return bool(arrived)

    def _receive(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Wait for frames of the wire; buses that go down or come back, and frames that were lost, are told of."""
        arrived = []
        for index, packet in self._buses.receive(timeout_s):
            port = self._buses.ports[index]
            if not packet or port.down is not None:
                self._lose(index, port.down or f"bus {port.name}: the interface went down")
            elif self._down[index] and not self._full[index]:
                self._regain(index)
            if frames := split_errors(packet)[0]:
                arrived.append((index, frames))
        for index, port in enumerate(self._buses.ports):
            # In lockstep a bus counts again with its next SYNC: until then the master may not know that it is back.
            if self._down[index] and port.down is None and self._realtime and not self._full[index]:
                self._regain(index)
        if time.monotonic() >= self._count_due_s:
            self._count_drops()
        return arrived

    def _deliver(self, arrived: list[tuple[int, bytes]]) -> None:
        for index, packet in arrived:
            for part in (packet,) if self._realtime else _parts(packet):
                self._send(index, self._hear(index, part))

    def _hear(self, index: int, packet: bytes) -> bytes:
        """Give frames of a bus (in lockstep with at most one SYNC) to the plant; its answer.

        In lockstep a SYNC may come before the period is over because another bus has none: time goes on all the same.
        """
        try:
            return self._plant.deliver(index, packet, self._after_ns)
        except SyncOrderError as error:
            if not self._plant.sync_complete and not self._sync_missing:
                self._sync_missing = True
                self._life.event("sync_missing", f"{error}; time goes on without it", "warning")
            self._cycle()
            return self._plant.deliver(index, packet)

    def _send_all(self, packets: Sequence[bytes]) -> None:
        for index, packet in enumerate(packets):
            self._send(index, packet)

    def _send(self, index: int, packet: bytes) -> None:
        if packet:
            try:
                self._buses.ports[index].send(packet)
            except BusStuckError as error:
                self._lose(index, str(error))
                self._full[index] = isinstance(error, BusOverflowError)
            else:
                if self._full[index]:
                    self._regain(index)

    def _lose(self, index: int, reason: str) -> None:
        """Go on without a bus: its drives hear nothing, and hold by their own means."""
        if not self._down[index]:
            self._down[index] = True
            self._plant.set_bus_down(index, True)
            self._life.event("bus_down", reason, "warning")

    def _regain(self, index: int) -> None:
        self._down[index] = self._full[index] = False
        self._plant.set_bus_down(index, False)
        self._life.event("bus_recovered", f"bus {self._names[index]}: works again")

    def _count_drops(self) -> None:
        self._count_due_s = time.monotonic() + COUNT_S
        for name, port in zip(self._names, self._buses.ports, strict=True):
            if isinstance(port, DropCounting) and (rises := port.drops()):
                self._life.event("frames_dropped", f"bus {name}: frames were lost: {describe(rises)}", "warning")

    def _end(self) -> None:
        """Tell what came of the last frames."""
        self._count_drops()
        self._publish_statistics(final=True)

    def _publish_statistics(self, *, final: bool = False) -> None:
        for message in self._plant.statistics(final=final):
            self._life.publish(self._load_keys[message.bus], message)

    def _cycle(self) -> None:
        begun = time.perf_counter()
        truth = self._plant.truth()
        self._life.stamp(truth.sequence, truth.time_ns)
        before = self._plant.sequence < 0
        self._plant.advance()
        if before:
            return  # time 0 is the first SYNC
        self._life.publish(self._truth_key, truth)
        self._publish_statistics()
        ended = time.perf_counter()
        self._meter.cycle(ended - begun)
        if (summary := self._meter.report(truth.sequence, truth.time_ns, ended)) is not None:
            self._life.publish(self._health_key, summary)

    def _run_on(self, duration_s: float) -> None:
        """Let time pass without a HAL, as fast as it goes; what the nodes say has no listener but is sent."""
        for _ in range(max(1, round(duration_s / self._period_s))):
            self._send_all(self._plant.free_run())
            self._life.publish(self._truth_key, self._plant.truth())


def run_plant(run: Run, options: ServiceOptions) -> int:
    """Serve the robot's buses until the HAL leaves or a signal comes; returns the exit code.

    Raises:
        PeerLostError: the HAL vanished.
        BusError: a bus cannot be hosted or opened.

    """
    # Before the buses: whoever finds a bus finds its nodes.
    plant = Plant(run, free=run.scenario.clock is Clock.REALTIME)
    robot = run.robot.description
    room_s = ROOM_SHARE * robot.period_s if run.scenario.clock is Clock.REALTIME else ROOM_S
    buses = PortGroup([_open(bus.of_plant(), room_s) for bus in robot.buses])
    try:
        with Lifecycle(open_service("plant", run, options), needed=("hal",)) as life:
            service = PlantService(run, plant, buses, life)
            life.join(())  # the drives are powered, whoever comes to command them
            if run.scenario.clock is Clock.LOCKSTEP:
                service.lockstep()
            else:
                service.realtime()
    finally:
        buses.close()
    return 0


def _open(bus: Bus, room_s: float) -> FramePort:
    """Host a virtual bus, join any other.

    No filters: what a master sends is meant for some drive, whose identifiers it may change, and the plant's own frames
    do not come back.
    """
    return BusHub(bus.channel, bus.name) if bus.interface == "cosim" else open_port(bus, room_s=room_s)


def _parts(packet: bytes) -> Iterator[bytes]:
    """Cut a packet after each SYNC that is not its last."""
    begin = 0
    identifiers = can_ids(packet)
    if identifiers.count(SYNC) > 1:
        for row, identifier in enumerate(identifiers[:-1]):
            if identifier == SYNC:
                end = (row + 1) * FRAME_BYTES
                yield packet[begin:end]
                begin = end
    yield packet[begin:]
