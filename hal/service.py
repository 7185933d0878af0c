"""The HAL as a process: the master of the buses and of time, between the robot and the controller on Zenoh."""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from typing import Final

from hal.bus.counters import describe
from hal.bus.errors import BusLostError
from hal.bus.ports import open_port
from hal.bus.socketcan import ROOM_S, ROOM_SHARE
from hal.errors import HalError, NodesMissingError
from hal.filters import hal_filters
from hal.master import Master
from schemas.base import Clock
from schemas.lifecycle import Lifecycle
from schemas.load import Run
from schemas.messages import HalStatus, JointCommand, OperatorRequest, RobotState
from schemas.service import ServiceOptions
from schemas.statistics import CycleMeter
from schemas.topics import MalformedMessageError, decode
from schemas.transport import PeerLostError, open_service

CONNECT_S: Final = 30.0
"""Patience with a plant that is still starting, at least."""
CONNECT_SHARE: Final = 5.0
"""The same as a multiple of the processor time that the HAL took to start: a slow machine is slow for both."""
BOOT_S: Final = 10.0
LOOK_UP_S: Final = 0.02
"""How often signals, peers and the operator are looked at while a command is awaited."""
REPORT_TIMEOUT_S: Final = 1.0
"""Wall-clock wait in lockstep for the reports of a SYNC."""
COMMAND_MARGIN: Final = 0.2
"""Share of the period before the next SYNC that is kept for the RPDOs (realtime)."""
SIGNALLED: Final = 128
"""Exit code, plus the signal's number, of a run that a signal cut short: the shells' convention."""
BLAME_S: Final = 0.2
"""Wait after the loss of a bus for the loss of the service that hosted it."""
COUNT_S: Final = 1.0
"""How often the drop counters of the interfaces are read."""


class SafeStopError(HalError):
    """The HAL has stopped the robot by itself; the message says why."""


class HalService:
    """The cycle of one run. Its end, whatever it is, leaves the drives holding."""

    def __init__(self, run: Run, master: Master, life: Lifecycle) -> None:
        self._run = run
        self._robot = run.robot.description
        self._master = master
        self._core = master.core
        self._life = life
        self._keys = life.transport.keys
        self._realtime = run.scenario.clock is Clock.REALTIME
        # Not only the newest: a foreign controller's command must not displace ours; late ones are passed over.
        self._commands = life.transport.subscribe(self._keys.command)
        self._operator = life.transport.subscribe(self._keys.operator)
        self._meter = CycleMeter("hal", self._robot.period_s)
        self._sequence = 0
        self._next_sync_s = 0.0
        self._begun_s = 0.0
        self._last_error = ""
        self._stopped_by = ""
        self._count_due_s = 0.0
        self._answered = False
        self._missed_commands = 0
        for key in (self._keys.state, *(self._keys.bus(bus.name) for bus in self._robot.buses)):
            life.transport.declare_publisher(key)

    def run(self) -> None:
        """Run all cycles, then hold and leave.

        Raises:
            SafeStopError: the HAL, or an operator who did not reset it, stopped the robot before the run was over.
            PeerLostError: the controller or the plant vanished; the robot holds.
            BusLostError: a bus is gone; the drives hold by their own means.

        """
        core, life = self._core, self._life
        self._next_sync_s = self._begun_s = time.monotonic()
        try:
            while self._sequence < self._run.cycles and core.status is not HalStatus.SAFE_STOP:
                self._cycle()
                if life.signalled is not None:
                    core.stop(signal.Signals(life.signalled).name, emergency=True)
                    break
            lost = self._await_buses()
        except PeerLostError as loss:
            core.stop(str(loss))
            with suppress(BusLostError):  # a plant that hosts the bus takes it along, and `loss` tells of it
                self._master.apply(None)
                self._sequence += 1
                self._hold(core.cycles_to_hold)
            raise
        except BusLostError:
            self._blame_peers()
            raise
        finished, cycles = core.status is HalStatus.ACTIVE, core.cycles_to_hold
        if finished:
            core.leave()
        self._hold(cycles)
        self._count_drops()
        if not finished and life.signalled is None:
            reason = f"stopped at sequence {self._sequence}, the robot holds: {self._stopped_by or self._last_error}"
            raise SafeStopError(reason + lost) from core.cause

    def _await_buses(self) -> str:
        """Hold the other buses while one is in trouble, so that it finds its master when it comes back.

        States are published as before. What is to be said of a bus that did not come back is returned.
        """
        core, life = self._core, self._life
        patience_s = self._robot.safety.bus_recovery_s
        deadline = time.monotonic() + patience_s
        while core.troubled_buses and life.signalled is None:
            begun = time.monotonic()
            if begun >= deadline:
                return f"\nNot recovered after {patience_s:g} s: bus {', '.join(core.troubled_buses)}"
            self._exchange()
            while self._commands.receive(0.0) is not None:
                pass  # answers to these states: the robot is stopped
            self._serve_operator()
            life.check_peers()
            self._master.apply(None)
            self._sequence += 1
            if not self._realtime:  # with no bus left nothing else takes time
                time.sleep(max(0.0, begun + self._robot.period_s - time.monotonic()))
        if life.signalled is not None:
            core.stop(signal.Signals(life.signalled).name, emergency=True)
        return ""

    def _blame_peers(self) -> None:
        """Give a peer's loss the time to be noticed: whoever hosts a virtual bus takes it along.

        Raises:
            PeerLostError: naming the peer.

        """
        deadline = time.monotonic() + BLAME_S
        while time.monotonic() < deadline:
            self._life.check_peers()
            time.sleep(LOOK_UP_S)

    @property
    def _report_timeout_s(self) -> float:
        return 0.5 * self._robot.period_s if self._realtime else REPORT_TIMEOUT_S

    def _cycle(self) -> None:
        """One period: SYNC, state out, command in, RPDOs out."""
        state = self._exchange()
        self._master.apply(self._await_command(state.sequence))
        self._sequence += 1
        self._measure(state)

    def _exchange(self) -> RobotState:
        """Send a SYNC and publish what the robot answers."""
        self._sync()
        state = self._master.gather(self._sequence, self._report_timeout_s)
        self._life.stamp(self._sequence, state.time_ns)
        self._life.publish(self._keys.state, state)
        return state

    def _hold(self, cycles: int) -> None:
        """Run cycles of the HAL's own: no state is published and no command awaited, the frames are logged."""
        for _ in range(cycles):
            self._sync()
            self._master.gather(self._sequence, self._report_timeout_s)
            self._master.apply(None)
            self._sequence += 1
        for message in self._master.frames(self._sequence - 1):
            self._life.publish(self._keys.bus(message.bus), message)
        self._publish_events()

    def _sync(self) -> None:
        """Send the SYNC when its time has come, then tell of the cycle before, while the drives answer."""
        frames = self._master.frames(self._sequence - 1)
        if self._realtime:
            self._await_sync_time()
        self._master.sync(self._sequence)
        for message in frames:
            self._life.publish(self._keys.bus(message.bus), message)
        self._publish_events()

    def _await_sync_time(self) -> None:
        """Sleep until the next SYNC's time on the absolute timer; SYNCs whose time has passed are left out."""
        period = self._robot.period_s
        wait = self._next_sync_s - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        late = max(time.monotonic() - self._next_sync_s, 0.0)
        skipped = round(late / period)
        self._meter.late_cycles += skipped
        self._sequence += skipped
        self._next_sync_s += (1 + skipped) * period

    def _await_command(self, sequence: int) -> JointCommand | None:
        """Wait for the answer to a state; None when it does not come in time, or the robot is stopped meanwhile."""
        core, life = self._core, self._life
        if self._realtime:
            deadline = self._next_sync_s - COMMAND_MARGIN * self._robot.period_s
        else:
            deadline = time.monotonic() + self._robot.safety.command_timeout_s
        while life.signalled is None:
            remaining = deadline - time.monotonic()
            data = self._commands.receive(min(max(remaining, 0.0), LOOK_UP_S))
            self._master.keep_alive()
            self._serve_operator()
            life.check_peers()
            if data is not None:
                command = self._decode(data)
                if command is not None and not self._is_late(command, sequence) and core.accepts(command):
                    self._answered = True
                    return command
            if remaining <= 0.0 and (data is None or remaining < -self._robot.period_s):
                patience_s = self._robot.safety.command_timeout_s
                if not self._realtime or (not self._answered and sequence * self._robot.period_s > patience_s):
                    core.stop(f"no command for sequence {sequence} in {patience_s:g} s")
                return None
        return None

    def _is_late(self, command: JointCommand, sequence: int) -> bool:
        """Whether an answer missed its cycle (realtime): it has been counted as missed and is no intruder's."""
        return self._realtime and command.sequence < sequence and command.session == self._core.session

    def _decode(self, data: bytes) -> JointCommand | None:
        try:
            return decode(JointCommand, data)
        except MalformedMessageError as error:
            self._life.event("command_refused", str(error), "warning")
            return None

    def _serve_operator(self) -> None:
        while (data := self._operator.receive(0.0)) is not None:
            try:
                request = decode(OperatorRequest, data)
            except MalformedMessageError as error:
                # Whoever asks for something on this key that cannot be read is taken to mean stop.
                self._core.stop(str(error), emergency=True)
                return
            if request.action == "stop":
                if self._core.status is HalStatus.EMERGENCY_STOP:
                    self._life.event("emergency_stop", "it is latched already; the HAL holds", "warning")
                self._core.stop(request.reason or "operator", emergency=True)
            else:
                self._core.reset()

    def _publish_events(self) -> None:
        for event in self._core.drain_events():
            if event.severity == "error":
                self._last_error = event.text
            if event.kind == "safe_stop":
                self._stopped_by = event.text
            self._life.publish(self._keys.event, event)

    def _measure(self, state: RobotState) -> None:
        now = time.monotonic()
        self._meter.cycle(now - self._begun_s)
        self._begun_s = now
        self._meter.missed_commands += self._core.missed_commands - self._missed_commands
        self._missed_commands = self._core.missed_commands
        if now >= self._count_due_s:
            self._count_due_s = now + COUNT_S
            self._count_drops()
        last = self._sequence >= self._run.cycles
        if (summary := self._meter.report(state.sequence, state.time_ns, now, final=last)) is not None:
            self._life.publish(self._keys.health, summary)

    def _count_drops(self) -> None:
        for bus, rises in self._master.drops():
            self._life.event("frames_dropped", f"bus {bus}: frames were lost: {describe(rises)}", "warning")


def run_hal(run: Run, options: ServiceOptions) -> int:
    """Find the robot's nodes, join the run, boot them, run the cycles, leave them holding; returns the exit code.

    Raises:
        BusUnavailableError: a bus cannot be opened.
        BootError: nodes missing or wrong; told at once, whether or not anybody else is there.
        SafeStopError, PeerLostError, BusLostError: see `HalService.run`.

    """
    robot = run.robot.description
    needed = tuple(peer for peer in ("plant", "controller") if peer in options.peers)
    with Lifecycle(open_service("hal", run, options), needed) as life:
        patience_s = max(CONNECT_S, CONNECT_SHARE * time.process_time())
        room_s = ROOM_SHARE * robot.period_s if run.scenario.clock is Clock.REALTIME else ROOM_S
        ports = [open_port(bus, patience_s, hal_filters(robot, bus.name), room_s) for bus in robot.buses]
        master = Master(robot, ports, options.session)
        try:
            service = HalService(run, master, life)
            _find(master, life, patience_s if "plant" in options.peers else 0.0)
            life.join(options.peers)
            for note in master.boot(BOOT_S):
                life.event("boot_note", note, "warning")
            service.run()
        finally:
            master.close()
    return 0 if life.signalled is None else SIGNALLED + life.signalled


def _find(master: Master, life: Lifecycle, patience_s: float) -> None:
    """Look for the nodes until they are there; no longer than once when the plant is there, or none is expected.

    Raises:
        BootError: nodes missing or wrong.

    """
    deadline = time.monotonic() + patience_s
    while life.signalled is None:  # whoever asked to stop meanwhile is heard when the run is joined
        last = "plant" in life.transport.alive or time.monotonic() + BOOT_S > deadline
        try:
            master.find(BOOT_S)
        except NodesMissingError:
            if last:
                raise
        else:
            return
