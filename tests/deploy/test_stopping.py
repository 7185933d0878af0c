"""Runs as separate processes that are stopped, disturbed or left hanging: the robot holds, and somebody says why."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from threading import Event as Flag
from threading import Thread

import numpy as np
import pytest

from deploy.runner import run_to_log
from deploy.series import read_series
from schemas.base import Clock
from schemas.keys import Keys
from schemas.load import load_run
from schemas.log import LogReader
from schemas.messages import Event, HalStatus, JointCommand, PlantTruth, RobotState
from schemas.topics import decode, encode
from schemas.transport import TransportConfig, open_session
from tests.deploy.running import Running, cosim_up

pytestmark = [pytest.mark.processes, pytest.mark.timeout(240)]
PHASE = "controller.phases."
EARLY = {f"{PHASE}reach.posture": {}} | {f"{PHASE}{name}.duration_s": 0.1 for name in ("reach", "settle", "switch")}
"""Torque mode from sequence 102 on; from 150 on the hand follows a circle for three seconds."""
ENDLESS = ("arm9-transition", "--duration", "60", *(f"--set={path}={value}" for path, value in EARLY.items()))
AT_REST = f"--set={PHASE}switch.duration_s=60"
IN_TORQUE = 130
MOVING = 350
ONE_DEGREE = np.radians(1.0)
STEP_LIMIT = 0.01
LIMITS = np.array([joint.torque_limit for joint in load_run("arm9-transition").robot.description.joints])


def events(log: Path) -> list[tuple[str, str, str]]:
    return [(event.service, event.kind, event.text) for event in LogReader(log).messages(Event)]


def drop(truths: list[PlantTruth], sequence: int, until: int | None = None) -> float:
    """Farthest that any joint goes from where it was at a sequence [rad]."""
    position = np.array(
        [t.position for t in truths if t.sequence >= sequence and (until is None or t.sequence < until)]
    )
    assert len(position) > 50, "time did not go on"
    return float(np.abs(position - position[0]).max())


def test_operator_stop_latches_until_reset_and_neither_makes_the_robot_jump(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS, AT_REST) as running:
        running.wait_for_sequence(IN_TORQUE)
        assert "cable caught" in running.cli("stop", "--reason", "cable caught")
        held = running.wait_for_sequence(running.wait_for_sequence(0).sequence + 150)
        assert held.status is HalStatus.EMERGENCY_STOP
        assert "latched already" in running.cli("stop")
        assert "cleared" in running.cli("stop", "--reset")
        running.wait_for_sequence(running.wait_for_sequence(0).sequence + 150)
        running.interrupt()
        running.end()
    states = list(LogReader(running.log).messages(RobotState))
    stopped = [s.sequence for s in states if s.status is HalStatus.EMERGENCY_STOP]
    first, last = stopped[0], stopped[-1]
    assert stopped == list(range(first, last + 1)), "latched without a gap"
    # Its commands are refused: what is applied is the HAL's own.
    assert {s.applied.sequence for s in states if first + 2 <= s.sequence <= last} == {-1}
    assert states[-1].sequence > last + 100
    series = read_series(running.log)
    truth = series.truth
    window = (truth.sequence >= first) & (truth.sequence <= last)
    assert set(truth.mode[window][5:].ravel()) == {8}
    assert np.abs(truth.position[window] - truth.position[window][0]).max() < ONE_DEGREE
    steps = np.abs(truth.motor_torque_substeps[1:, 0] - truth.motor_torque_substeps[:-1, -1]) / LIMITS
    around = (truth.sequence[1:] > first - 5) & (truth.sequence[1:] < last + 50)
    assert steps[around].max() < STEP_LIMIT
    # After the reset it goes on from where it stands.
    after = (truth.sequence > last) & (truth.sequence < last + 20)
    assert np.abs(truth.position[after] - truth.position[after][0]).max() < ONE_DEGREE


def test_sigterm_to_the_hal_holds_the_robot_and_ends_the_run(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS) as running:
        running.wait_for_sequence(IN_TORQUE)
        running.signal("hal", signal.SIGTERM)
        ending = running.end()
    assert ending.code != 0
    assert "hal" in ending.output
    truths = list(LogReader(running.log).messages(PlantTruth))
    stopped = list(LogReader(running.log).messages(RobotState))[-1].sequence
    assert drop(truths, stopped) < ONE_DEGREE
    assert set(truths[-1].mode) == {8}
    assert any(kind == "emergency_stop" and "SIGTERM" in text for _, kind, text in events(running.log))


def test_sigterm_stops_everything_within_two_seconds(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS) as running:
        running.wait_for_sequence(IN_TORQUE)
        running.process.send_signal(signal.SIGTERM)
        begun = time.monotonic()
        services = [running.pid_of(name) for name in ("plant", "hal", "controller", "recorder")]
        while any(Path(f"/proc/{pid}/cmdline").exists() for pid in services) and time.monotonic() - begun < 10.0:
            time.sleep(0.01)
        assert time.monotonic() - begun < 2.5  # two, and the noise of a shared machine
        assert running.end().code != 0
    assert LogReader(running.log).complete


def test_hanging_controller_makes_the_hal_stop_the_robot(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS) as running:
        running.wait_for_sequence(MOVING)
        running.signal("controller", signal.SIGSTOP)
        ending = running.end()
    assert ending.code != 0
    assert "no command for sequence" in ending.output, ending.output
    truths = list(LogReader(running.log).messages(PlantTruth))
    stopped = list(LogReader(running.log).messages(RobotState))[-1].sequence
    assert drop(truths, stopped) < ONE_DEGREE
    assert any((service, kind) == ("hal", "safe_stop") for service, kind, _ in events(running.log))


def test_drives_hold_when_the_hal_hangs(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS, "--set", "plant.free_run_after_s=0.3") as running:
        running.wait_for_sequence(MOVING)
        running.signal("hal", signal.SIGSTOP)
        time.sleep(2.0)
        running.signal("hal", signal.SIGCONT)
        ending = running.end()
    assert ending.code != 0, ending.output  # the drives have left the HAL's lead meanwhile, which it finds out
    truths = list(LogReader(running.log).messages(PlantTruth))
    hung = next(k for k, t in enumerate(truths) if truths[k + 1].sequence == t.sequence)
    position = np.array([t.position for t in truths[hung:]])
    assert len(position) > 50
    assert np.abs(position - position[0]).max() < ONE_DEGREE
    assert set(truths[hung + 10].mode) == {8}
    assert any((service, kind) == ("plant", "bus_silent") for service, kind, _ in events(running.log))


class Intruder:
    """A second controller with a session of its own that answers every state with a torque of its own."""

    def __init__(self, running: Running) -> None:
        note = running.session()
        self._keys = Keys(note.namespace, note.robot)
        self._config = TransportConfig(base_port=note.base_port)
        self._stop = Flag()
        self.answers = 0
        self._thread = Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        with open_session("intruder", self._keys, self._config, Clock.REALTIME) as transport:
            states = transport.subscribe(self._keys.state)
            while not self._stop.is_set():
                data = states.receive(0.1)
                if data is None:
                    continue
                state = decode(RobotState, data)
                torque = (5.0,) * len(state.position_measured)
                command = JointCommand(
                    session="intruder", sequence=state.sequence, time_ns=state.time_ns, mode="torque", torque=torque
                )
                transport.publish_bytes(self._keys.command, encode(command), state.sequence, state.time_ns)
                self.answers += 1


def test_a_second_controller_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    with cosim_up(tmp_path, *ENDLESS, "--duration", "0.6", "--seed", "3") as running:
        running.wait_for_sequence(0)
        intruder = Intruder(running)
        ending = running.end()
        intruder.close()
    assert ending.code == 0, ending.output
    assert intruder.answers > 20
    refusals = [text for _, kind, text in events(running.log) if kind == "command_refused"]
    assert len(refusals) == 1, "told once, however often it comes"
    assert "intruder" in refusals[0]
    run = load_run("arm9-transition", {**EARLY, "duration_s": 0.6, "seed": 3})
    undisturbed = LogReader(run_to_log(run, tmp_path / "alone"))
    disturbed = LogReader(running.log)
    for message in (RobotState, PlantTruth):
        assert list(disturbed.messages(message)) == list(undisturbed.messages(message))
    sessions = [command.session for command in disturbed.messages(JointCommand)]
    assert sessions.count("intruder") > 20
