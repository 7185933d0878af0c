"""Replays on the frames of the buses: the HAL's core and the plant."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from deploy.compare import HAL, PLANT, Difference, Tolerances, compare
from deploy.replay import ReplayError
from hal.cycle import HalCore
from hal.profile.frames import FRAME_BYTES, unpack
from hal.profile.identifiers import HAL_NODE_ID, HEARTBEAT, SYNC
from plant_service.plant import Plant
from schemas.base import Clock
from schemas.log import LogReader
from schemas.messages import BusFrames, Event, JointCommand, RobotState
from schemas.topics import BUS_PREFIX, decode

STOPS = {"safe_stop": False, "emergency_stop": True}
"""Kinds of the HAL's events that say it was stopped, and whether by emergency."""


@dataclass(slots=True)
class _Cycle:
    """What a log holds of one sequence number."""

    sent: dict[str, bytes] = field(default_factory=dict)
    received: dict[str, bytes] = field(default_factory=dict)
    state: RobotState | None = None
    commands: list[JointCommand] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)


def replay_hal(reader: LogReader, exact: bool) -> tuple[int, Difference | None]:
    """Feed logged frames and commands to a fresh `HalCore`; returns the number of equal states and a difference.

    What the HAL sent is compared as well while it follows the controller.
    """
    cycles = _cycles(reader)
    used = _used_commands(reader, cycles)
    core = _fresh_core(reader, cycles)
    if core is None:
        return 0, None
    tolerances: Tolerances | None = None if exact else HAL
    buses = [bus.name for bus in reader.run.robot.description.buses]
    compared = 0
    for sequence, cycle in _in_order(cycles, buses, gaps=_has_gaps(reader), complete=reader.complete):
        assert cycle.state is not None
        state = core.decode(sequence, [cycle.received[bus] for bus in buses])
        if (difference := compare(sequence, "state", cycle.state, state, tolerances)) is not None:
            return compared, difference
        compared += 1
        stopped = _apply_events(core, cycle)
        command = next((each for each in cycle.commands if sequence in used and core.accepts(each)), None)
        packets = core.apply(command)
        if exact and command is not None and not stopped:
            for bus, packet in zip(buses, packets, strict=True):
                logged = _after_sync(cycle.sent[bus])
                if logged != packet:
                    return compared, _frame_difference(sequence, f"{BUS_PREFIX}{bus}.sent", logged, packet)
    return compared, None


def replay_plant(reader: LogReader, exact: bool) -> tuple[int, Difference | None]:
    """Feed what the HAL sent, boot included, to a fresh `Plant`; returns the number of equal cycles and a difference.

    Exact: the plant's frames are compared; with tolerances: the states decoded from them.
    """
    cycles = _cycles(reader)
    buses = [bus.name for bus in reader.run.robot.description.buses]
    boot = cycles.get(-1)
    if boot is None:
        return 0, None
    plant = Plant(reader.run)
    late = [plant.deliver(index, boot.sent[bus]) for index, bus in enumerate(buses)]
    if exact:
        for index, bus in enumerate(buses):
            if late[index] != boot.received[bus]:
                return 0, _frame_difference(-1, f"{BUS_PREFIX}{bus}.received", boot.received[bus], late[index])
    late = [b""] * len(buses)
    used = _used_commands(reader, cycles)
    core = None if exact else _fresh_core(reader, cycles)
    compared, last_sequence = 0, -1
    ordered = _in_order(cycles, buses, gaps=_has_gaps(reader), complete=reader.complete, need_state=not exact)
    for sequence, cycle in ordered:
        for _ in range(last_sequence + 1, sequence):
            plant.advance()
        last_sequence = sequence
        received = [late[index] + plant.deliver(index, _to_sync(cycle.sent[bus])) for index, bus in enumerate(buses)]
        plant.advance()
        # RPDOs arrive while the plant has integrated; what it answers to them, the HAL reads with the next reports.
        late = [plant.deliver(index, _after_sync(cycle.sent[bus])) for index, bus in enumerate(buses)]
        if core is None:
            for bus, packet in zip(buses, received, strict=True):
                if packet != cycle.received[bus]:
                    where = f"{BUS_PREFIX}{bus}.received"
                    return compared, _frame_difference(sequence, where, cycle.received[bus], packet)
        else:
            assert cycle.state is not None
            state = core.decode(sequence, received)
            if (difference := compare(sequence, "state", cycle.state, state, PLANT)) is not None:
                return compared, difference
            _apply_events(core, cycle)
            core.apply(next((each for each in cycle.commands if sequence in used and core.accepts(each)), None))
        compared += 1
    return compared, None


def _cycles(reader: LogReader) -> dict[int, _Cycle]:
    cycles: dict[int, _Cycle] = defaultdict(_Cycle)
    for record in reader.records():
        if record.topic == "state":
            state = decode(RobotState, record.data)
            cycles[state.sequence].state = state
        elif record.topic == "command":
            command = decode(JointCommand, record.data)
            cycles[command.sequence].commands.append(command)
        elif record.topic == "event":
            event = decode(Event, record.data)
            if event.service == "hal":
                cycles[event.sequence].events.append(event)
        elif record.topic.startswith(BUS_PREFIX):
            frames = decode(BusFrames, record.data)
            cycles[frames.sequence].sent[frames.bus] = frames.sent
            cycles[frames.sequence].received[frames.bus] = frames.received
    return cycles


def _has_gaps(reader: LogReader) -> bool:
    """Whether a whole log may lack sequences: SYNCs whose time had passed are left out in realtime."""
    return reader.run.scenario.clock is Clock.REALTIME


def _in_order(
    cycles: dict[int, _Cycle], buses: list[str], *, gaps: bool, complete: bool, need_state: bool = True
) -> Iterator[tuple[int, _Cycle]]:
    """Cycles from 0 on, up to the first that the log does not hold whole; with `gaps` those are passed over.

    Raises:
        ReplayError: a `complete` log goes on after such a cycle: something was taken out of it.

    """
    for expected, sequence in enumerate(sorted(key for key in cycles if key >= 0)):
        cycle = cycles[sequence]
        whole = len(cycle.sent) == len(buses) and (cycle.state is not None or not need_state)
        if not gaps and (not whole or sequence != expected):
            if complete and any(c.state and len(c.sent) == len(buses) for key, c in cycles.items() if key > expected):
                raise ReplayError(f"the log lacks state or frames of tick {expected}, yet goes on after it")
            return
        if whole:
            yield sequence, cycle


def _used_commands(reader: LogReader, cycles: dict[int, _Cycle]) -> set[int]:
    """Sequences whose commands were in time: all in lockstep; in realtime those that a later state shows applied."""
    if reader.run.scenario.clock is Clock.LOCKSTEP:
        return set(cycles)
    return {cycle.state.applied.sequence for cycle in cycles.values() if cycle.state is not None}


def _fresh_core(reader: LogReader, cycles: dict[int, _Cycle]) -> HalCore | None:
    """Start a core where the boot left it: holding at the target that the first state reports as applied."""
    first = cycles.get(0)
    if first is None or first.state is None or first.state.applied.position is None:
        return None
    session = next((each.session for each in first.commands), None)
    core = HalCore(reader.run.robot.description, session)
    core.start(np.array(first.state.applied.position))
    return core


def _apply_events(core: HalCore, cycle: _Cycle) -> bool:
    """Stop and reset as the log says it was done in this cycle; True when anything was."""
    acted = False
    for event in cycle.events:
        if event.kind in STOPS:
            core.stop(event.text, emergency=STOPS[event.kind])
            acted = True
        elif event.kind == "reset":
            core.reset()
            acted = True
    core.drain_events()
    return acted


def _to_sync(packet: bytes) -> bytes:
    return packet[: _sync_end(packet)]


def _after_sync(packet: bytes) -> bytes:
    return packet[_sync_end(packet) :]


def _sync_end(packet: bytes) -> int:
    """Where the commands begin: after the SYNC, and the HAL's heartbeat if it goes with it."""
    end, synced = 0, False
    for index, (can_id, _) in enumerate(unpack(packet)):
        if can_id == SYNC:
            synced = True
        elif synced and can_id != HEARTBEAT + HAL_NODE_ID:
            break
        if synced:
            end = (index + 1) * FRAME_BYTES
    return end


def _frame_difference(tick: int, where: str, logged: bytes, replayed: bytes) -> Difference:
    """Name the first frame that differs, as `identifier#data`."""
    one, other = (_names(packet) for packet in (logged, replayed))
    index = next((i for i, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    values = [names[index] if index < len(names) else "none" for names in (one, other)]
    return Difference(tick, f"{where}[{index}]", *values)


def _names(packet: bytes) -> list[str]:
    """Write each frame as identifier and data, and the bytes beyond its length where they are not zero."""
    names = []
    for index, (can_id, data) in enumerate(unpack(packet)):
        beyond = packet[index * FRAME_BYTES + 8 + len(data) : (index + 1) * FRAME_BYTES]
        names.append(f"{can_id:03X}#{data.hex().upper()}" + (f" +{beyond.hex()}" if any(beyond) else ""))
    return names
