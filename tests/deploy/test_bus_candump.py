"""A log on the kernel's own CAN: sent by canplayer, captured by candump, the same log again."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.bus_files import ChannelMap, read_frames, write_frames
from deploy.bus_frames import from_zero, in_time
from deploy.bus_import import messages_of
from deploy.can_vm import VCAN, run_in_machine
from schemas.log import LogReader
from schemas.messages import BusFrames, RobotState
from tests.deploy.conftest import GOLDEN

pytestmark = [pytest.mark.can_machine, pytest.mark.timeout(900)]
SCRIPT = """
candump -r 8388608 -L {interfaces} >/dev/shm/captured.log & capture=$!
sleep 2
canplayer -I run.log {assignments}
sleep 2
kill -INT $capture; wait $capture
cp /dev/shm/captured.log .
"""
"""The file is in memory and the socket's buffer is large: candump drops what it cannot write in time."""


def test_a_log_replayed_by_canplayer_decodes_to_the_same_states(can_machine: None, tmp_path: Path) -> None:
    log = LogReader(GOLDEN)
    robot = log.run.robot.description
    buses = [bus.name for bus in robot.buses]
    original = list(log.messages(BusFrames))
    frames = from_zero(in_time(robot, original), robot.period_ns)
    write_frames(tmp_path / "run.log", frames, ChannelMap(robot, {}), buses)
    interfaces = dict(zip(buses, VCAN, strict=False))
    assignments = " ".join(f"{interface}={bus}" for bus, interface in interfaces.items())
    script = SCRIPT.format(interfaces=" ".join(interfaces.values()), assignments=assignments)
    done = run_in_machine(["sh", "-c", script], directory=tmp_path, timeout_s=300.0)
    captured = tmp_path / "captured.log"
    assert captured.is_file(), done.stderr
    messages = list(messages_of(read_frames(captured, ChannelMap(robot, interfaces)), log.run))
    assert [message for _, message in messages if isinstance(message, BusFrames)] == original
    states = {message.sequence: message for _, message in messages if isinstance(message, RobotState)}
    for state in log.messages(RobotState):
        untold = {"applied": state.applied, "status": state.status}
        assert states[state.sequence].model_copy(update=untold) == state
