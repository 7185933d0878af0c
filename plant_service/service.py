"""The plant as a process: it hosts the virtual buses (or joins real ones) and lets the simulated robot live on them."""

from __future__ import annotations

import time
from typing import Final

from hal.bus.gather import PortGroup
from hal.bus.hub import BusHub
from hal.bus.ports import FramePort, open_port
from hal.profile.frames import view
from hal.profile.identifiers import SYNC
from plant_service.plant import Plant
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


class PlantService:
    """A `Plant` on its buses, with its truth on Zenoh."""

    def __init__(self, run: Run, buses: PortGroup, life: Lifecycle) -> None:
        self._run = run
        self._buses = buses
        self._life = life
        self._plant = Plant(run, free=run.scenario.clock is Clock.REALTIME)
        self._begun_s = 0.0
        """Wall clock at simulated time 0 (realtime)."""
        # More at once would trip the watchdogs of drives that have done nothing wrong.
        self._longest_lag = max(LEAST_LAG_CYCLES, run.robot.description.safety.sync_timeout_cycles - 2)
        self._period_s = run.robot.description.period_s
        self._meter = CycleMeter("plant", self._period_s)
        self._truth_key = life.transport.keys.truth
        self._health_key = life.transport.keys.health

    def lockstep(self) -> None:
        """Advance one period for each SYNC; by itself when the HAL is gone or silent for long.

        Raises:
            PeerLostError: the HAL vanished; the drives have been given the time to hold.

        """
        life, plant = self._life, self._plant
        patience_s = self._run.scenario.plant.free_run_after_s
        heard = time.monotonic()
        while life.signalled is None and not life.finished("hal"):
            if self._serve(LOOK_UP_S):
                heard = time.monotonic()
            if plant.sync_complete:
                self._cycle()
                continue
            try:
                life.check_peers()
                if plant.sequence >= 0 and time.monotonic() - heard > patience_s:
                    life.event("bus_silent", f"no SYNC for {patience_s:g} s; time runs on", "warning")
                    self._run_until_heard()
                    heard = time.monotonic()
            except PeerLostError:
                self._run_on(RUN_ON_S)
                raise

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
            arrived = self._buses.receive(max(1.5 * period - self._lag(), 0.0))
            if any(SYNC in view(packet)["can_id"] for _, packet in arrived):
                self._keep_pace()
            self._deliver(arrived)
            if self._lag() > 1.5 * period:
                self._pass_time()
            try:
                life.check_peers()
            except PeerLostError:
                self._run_on(RUN_ON_S)
                raise

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
        for port, packet in zip(self._buses.ports, self._plant.collect(), strict=True):
            if packet:
                port.send(packet)

    def _serve(self, timeout_s: float) -> bool:
        """Let the nodes answer what comes on the buses; whether anything came."""
        arrived = self._buses.receive(timeout_s)
        self._deliver(arrived)
        return bool(arrived)

    def _deliver(self, arrived: list[tuple[int, bytes]]) -> None:
        for index, packet in arrived:
            answer = self._plant.deliver(index, packet)
            if answer:
                self._buses.ports[index].send(answer)

    def _cycle(self) -> None:
        begun = time.perf_counter()
        truth = self._plant.truth()
        self._life.stamp(truth.sequence, truth.time_ns)
        before = self._plant.sequence < 0
        self._plant.advance()
        if before:
            return  # time 0 is the first SYNC
        self._life.publish(self._truth_key, truth)
        ended = time.perf_counter()
        self._meter.cycle(ended - begun)
        if (summary := self._meter.report(truth.sequence, truth.time_ns, ended)) is not None:
            self._life.publish(self._health_key, summary)

    def _run_on(self, duration_s: float) -> None:
        """Let time pass without a HAL, as fast as it goes; what the nodes say has no listener but is sent."""
        for _ in range(max(1, round(duration_s / self._period_s))):
            for port, packet in zip(self._buses.ports, self._plant.free_run(), strict=True):
                if packet:
                    port.send(packet)
            self._life.publish(self._truth_key, self._plant.truth())


def run_plant(run: Run, options: ServiceOptions) -> int:
    """Serve the robot's buses until the HAL leaves or a signal comes; returns the exit code.

    Raises:
        PeerLostError: the HAL vanished.
        BusError: a bus cannot be hosted or opened.

    """
    buses = PortGroup([_open(bus) for bus in run.robot.description.buses])
    try:
        with Lifecycle(open_service("plant", run, options), needed=("hal",)) as life:
            service = PlantService(run, buses, life)
            life.transport.declare_publisher(life.transport.keys.truth)
            if run.scenario.clock is Clock.LOCKSTEP:
                life.join(options.peers)
                service.lockstep()
            else:
                life.join(())  # the drives are powered, whoever comes to command them
                service.realtime()
    finally:
        buses.close()
    return 0


def _open(bus: Bus) -> FramePort:
    """Host a virtual bus, join any other."""
    return BusHub(bus.channel, bus.name) if bus.interface == "cosim" else open_port(bus)
