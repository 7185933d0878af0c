"""The realtime clock: the wall clock sets the pace, what is late is counted, what stays away stops the robot.

The machine may be slow: the robot's rate is low, and nothing is asserted of a single cycle's time.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import pytest

from schemas.log import LogReader
from schemas.messages import CycleStatistics, Event, JointCommand, PlantTruth, RobotState
from tests.deploy.running import Running, cosim_up

pytestmark = [pytest.mark.processes, pytest.mark.timeout(120)]
RATE_HZ = 50
PATIENT = 200
"""Cycles of silence that stop nothing."""
ONE_DEGREE = np.radians(1.0)


def realtime(directory: Path, duration_s: float, *, missed_commands: int = PATIENT, sync_timeout_cycles: int = PATIENT):
    sets = {
        "robot.rate_hz": RATE_HZ,
        "robot.safety.missed_commands": missed_commands,
        "robot.safety.sync_timeout_cycles": sync_timeout_cycles,
    }
    line = ["arm9-transition", "--clock", "realtime", "--duration", str(duration_s)]
    return cosim_up(directory, *line, *(f"--set={path}={value}" for path, value in sets.items()))


def pause(running: Running, service: str, seconds: float) -> None:
    running.signal(service, signal.SIGSTOP)
    time.sleep(seconds)
    running.signal(service, signal.SIGCONT)


def test_states_keep_the_wall_clocks_pace_and_what_is_late_is_counted(tmp_path: Path) -> None:
    with realtime(tmp_path, 2.4) as running:
        first = running.wait_for_sequence(10).sequence
        begun = time.monotonic()
        pause(running, "controller", 0.5)
        last = running.wait_for_sequence(first + 60).sequence
        wall_s = time.monotonic() - begun
        ending = running.end()
    assert ending.code == 0, ending.output
    # A subscription anew takes part of a second.
    assert (last - first) / RATE_HZ == pytest.approx(wall_s, abs=1.0)
    reader = LogReader(running.log)
    states = list(reader.messages(RobotState))
    sequences = [state.sequence for state in states]
    assert sequences == sorted(set(sequences))
    assert [state.time_ns for state in states] == [k * 1_000_000_000 // RATE_HZ for k in sequences]
    # SYNCs whose time had passed are left out and counted: nothing else is missing.
    hal = [each for each in reader.messages(CycleStatistics) if each.service == "hal"]
    assert len(states) + sum(each.late_cycles for each in hal) == sequences[-1] + 1 >= 2.4 * RATE_HZ
    # Half a second without answers: counted as missed, the last command held, the newest state answered first.
    assert sum(each.missed_commands for each in hal) >= 20
    commands = [command.sequence for command in reader.messages(JointCommand)]
    assert len(commands) <= len(states) - 10
    held = [state.applied.sequence for state in states]
    assert max(np.unique(held, return_counts=True)[1]) >= 20
    kinds = {event.kind for event in reader.messages(Event) if event.severity != "info"}
    assert "command_missed" in kinds
    assert not kinds & {"command_refused", "safe_stop"}
    # Truth and states tell of the same instants; a late process may answer a cycle early or late.
    truths = {truth.sequence: truth for truth in reader.messages(PlantTruth)}
    assert all(truth.time_ns == k * 1_000_000_000 // RATE_HZ for k, truth in truths.items())
    pairs = [(s.position_measured, truths[s.sequence].position) for s in states if s.sequence in truths]
    assert len(pairs) > RATE_HZ
    assert np.median(np.abs([np.subtract(*pair) for pair in pairs]).max(axis=1)) < 1e-4


def test_a_controller_that_stays_away_makes_the_hal_stop(tmp_path: Path) -> None:
    with realtime(tmp_path, 60.0, missed_commands=25) as running:
        running.wait_for_sequence(30)
        running.signal("controller", signal.SIGSTOP)
        ending = running.end()
    assert ending.code != 0
    assert "25 cycles in a row without a valid command" in ending.output
    reader = LogReader(running.log)
    assert any((event.service, event.kind) == ("hal", "safe_stop") for event in reader.messages(Event))
    stopped = list(reader.messages(RobotState))[-1].sequence
    position = np.array([truth.position for truth in reader.messages(PlantTruth) if truth.sequence >= stopped])
    assert len(position) > 5
    assert np.abs(position - position[0]).max() < ONE_DEGREE


def test_time_goes_on_without_the_hal_and_the_drives_hold(tmp_path: Path) -> None:
    with realtime(tmp_path, 60.0, sync_timeout_cycles=20) as running:
        paused = running.wait_for_sequence(30).sequence
        pause(running, "hal", 1.5)
        ending = running.end()
    assert ending.code != 0  # the drives have told the HAL that they had to hold by themselves
    assert "EMCY" in ending.output, ending.output
    # Of the HAL's own states none need follow: it may have been paused with its SYNC on the way.
    truths = list(LogReader(running.log).messages(PlantTruth))
    meanwhile = [truth for truth in truths if paused < truth.sequence <= paused + 1.5 * RATE_HZ]
    assert meanwhile[-1].sequence > paused + RATE_HZ
    assert len(meanwhile) > 0.5 * RATE_HZ
    assert set(meanwhile[-1].mode) == {8}
    position = np.array([truth.position for truth in meanwhile if truth.sequence > paused + 30])
    assert len(position) > 10
    assert np.abs(position - position[0]).max() < ONE_DEGREE
