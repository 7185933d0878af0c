"""Whole runs as separate processes: repeatable, stoppable, and safe when one of them is killed."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from deploy.runner import run_to_log
from schemas.load import load_run
from schemas.log import LogReader
from schemas.messages import Event, JointCommand, PlantTruth, RobotState
from tests.deploy.running import cosim_up

pytestmark = [pytest.mark.processes, pytest.mark.timeout(240)]
IN_TORQUE = 850
"""A sequence of arm9-transition well inside torque mode."""
ONE_DEGREE = np.radians(1.0)


def channels(path: Path) -> dict[str, list[tuple[int, int, bytes]]]:
    """(log time, sequence, bytes) of all messages per channel but health and events, which tell of wall-clock time."""
    messages = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            if channel.topic not in ("/health", "/event"):
                messages[channel.topic].append((message.log_time, message.sequence, message.data))
    return dict(messages)


def test_a_run_loses_nothing_and_repeats_bit_for_bit_however_it_is_wired(tmp_path: Path) -> None:
    logs = []
    for name in ("first", "second"):
        with cosim_up(tmp_path / name, "arm9-transition", "--duration", "1.8", "--seed", "3") as running:
            ending = running.end()
        assert ending.code == 0, ending.output
        logs.append(channels(running.log))
    assert len(logs[0]["/state"]) == len(logs[0]["/command"]) == 900
    assert logs[0].keys() >= {"/state", "/command", "/trace", "/truth", "/bus/arm9-0"}
    assert logs[0] == logs[1]
    run = load_run("arm9-transition", {"duration_s": 1.8, "seed": 3})
    assert channels(run_to_log(run, tmp_path / "one-process")) == logs[0]


def test_another_seed_is_another_run(tmp_path: Path) -> None:
    first, second = (
        channels(run_to_log(load_run("arm9-transition", {"duration_s": 0.1, "seed": seed}), tmp_path / str(seed)))
        for seed in (1, 2)
    )
    assert first["/truth"] != second["/truth"]


@pytest.mark.parametrize("service", ["plant", "hal", "controller"])
def test_killing_a_service_stops_the_run_and_the_drives_hold(tmp_path: Path, service: str) -> None:
    with cosim_up(tmp_path, "arm9-transition", "--duration", "60") as running:
        running.wait_for_sequence(IN_TORQUE)
        running.kill(service)
        ending = running.end()
    assert ending.code != 0
    assert ending.seconds < 3.0
    assert f"{service} was killed by SIGKILL" in ending.output, ending.output
    reader = LogReader(running.log)
    states = list(reader.messages(RobotState))
    events = [event for event in reader.messages(Event) if event.service != service]
    assert any(f"{service} has gone" in event.text for event in events), events
    if service == "plant":
        return  # no truth comes after it: the simulated robot is gone with it
    truths = list(reader.messages(PlantTruth))
    last = states[-1].sequence
    position = np.array([truth.position for truth in truths])
    at_loss = next(k for k, truth in enumerate(truths) if truth.sequence == last)
    assert len(truths) - at_loss > 100, "time did not go on"
    assert np.abs(position[at_loss:] - position[at_loss]).max() < ONE_DEGREE
    cycles = next(k for k, truth in enumerate(truths[at_loss:]) if set(truth.mode) == {8})
    # The watchdog's five cycles, and one for the period that the truth of a SYNC reports of.
    assert cycles <= 6


def test_the_run_goes_on_without_its_recorder(tmp_path: Path) -> None:
    with cosim_up(tmp_path, "arm9-transition", "--duration", "3") as running:
        running.wait_for_sequence(300)
        running.kill("recorder")
        running.wait_for_sequence(1000)
        ending = running.end()
    assert "recorder was killed by SIGKILL" in ending.output, ending.output
    assert "run goes on" in ending.output


def test_ctrl_c_stops_everything_within_two_seconds_and_the_log_is_whole(tmp_path: Path) -> None:
    with cosim_up(tmp_path, "arm9-transition", "--duration", "60") as running:
        running.wait_for_sequence(IN_TORQUE)
        running.interrupt()
        ending = running.end()
    assert ending.seconds < 3.0, ending.output  # two for the services, the rest for the summary
    reader = LogReader(running.log)
    assert reader.complete
    assert len(list(reader.messages(JointCommand))) >= IN_TORQUE
    events = list(reader.messages(Event))
    assert any(event.kind == "emergency_stop" for event in events), [event.text for event in events]
    final = list(reader.messages(PlantTruth))[-1]
    assert set(final.mode) == {8}
    assert np.abs(final.velocity).max() < 0.05
