"""The plant as a process: it hosts the virtual buses (or joins real ones) and lets the simulated robot live on them."""

from __future__ import annotations

import time
from typing import Final

from hal.bus.gather import PortGroup
from hal.bus.hub import BusHub
from hal.bus.ports import FramePort, open_port
from plant_service.plant import Plant
from schemas.base import Clock
from schemas.lifecycle import Lifecycle, PeerLostError
from schemas.load import Run
from schemas.robot import Bus
from schemas.service import ServiceOptions
from schemas.statistics import CycleMeter
from schemas.transport import open_service

LOOK_UP_S: Final = 0.1
"""How often signals and peers are looked at while the bus is silent."""
RUN_ON_S: Final = 0.6
"""Simulated time after the loss of the HAL: the drives' watchdogs act, the hold's ramp ends, the robot settles."""


class PlantService:
    """A `Plant` on its buses, with its truth on Zenoh."""

    def __init__(self, run: Run, buses: PortGroup, life: Lifecycle) -> None:
        self._run = run
        self._buses = buses
        self._life = life
        self._plant = Plant(run)
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
            except PeerLostError:
                self._run_on(RUN_ON_S)
                raise
            if plant.sequence >= 0 and time.monotonic() - heard > patience_s:
                life.event("bus_silent", f"no SYNC for {patience_s:g} s; time runs on", "warning")
                while not self._serve(self._period_s) and life.signalled is None and not life.lost():
                    self._run_on(self._period_s)
                heard = time.monotonic()

    def realtime(self) -> None:
        """Follow the wall clock; each SYNC takes the period that is due, so that samples keep their distance.

        Raises:
            PeerLostError: the HAL vanished; the drives have been given the time to hold.

        """
        life, plant, period = self._life, self._plant, self._period_s
        started = time.monotonic()
        while life.signalled is None and not life.finished("hal"):
            lag = time.monotonic() - started - plant.time_ns * 1e-9
            self._serve(max(1.5 * period - lag, 0.0))
            lag = time.monotonic() - started - plant.time_ns * 1e-9
            if lag > (0.5 if plant.sync_complete else 1.5) * period:
                self._cycle()
            try:
                life.check_peers()
            except PeerLostError:
                self._run_on(RUN_ON_S)
                raise

    def _serve(self, timeout_s: float) -> bool:
        """Let the nodes answer what comes on the buses; whether anything came."""
        arrived = self._buses.receive(timeout_s)
        for index, packet in arrived:
            answer = self._plant.deliver(index, packet)
            if answer:
                self._buses.ports[index].send(answer)
        return bool(arrived)

    def _cycle(self) -> None:
        begun = time.perf_counter()
        truth = self._plant.truth()
        self._life.stamp(truth.sequence, truth.time_ns)
        self._plant.advance()
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
            life.join(options.peers)
            if run.scenario.clock is Clock.LOCKSTEP:
                service.lockstep()
            else:
                service.realtime()
    finally:
        buses.close()
    return 0


def _open(bus: Bus) -> FramePort:
    """Host a virtual bus, join any other."""
    return BusHub(bus.channel, bus.name) if bus.interface == "cosim" else open_port(bus)
