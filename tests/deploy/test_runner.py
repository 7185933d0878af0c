"""A run to a log: it says so when the robot was stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from deploy import runner
from deploy.errors import RunStoppedError
from deploy.inprocess import InProcess
from schemas.base import ControlMode
from schemas.load import load_run
from schemas.log import LogReader
from schemas.messages import JointCommand

STOPPED_AT = 5


class Stopping(InProcess):
    """A run whose HAL stops the robot by itself."""

    def step(self) -> None:
        if self.sequence == STOPPED_AT:
            self.master.core.stop("made to")
        super().step()


def test_a_safe_stop_fails_the_run_and_leaves_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = load_run("arm9-transition", {"duration_s": 0.1})
    assert runner.run_to_log(run, tmp_path / "whole").is_file()
    monkeypatch.setattr(runner, "InProcess", Stopping)
    with pytest.raises(RunStoppedError, match=r"safe stop: made to") as caught:
        runner.run_to_log(run, tmp_path / "stopped")
    logs = list((tmp_path / "stopped").glob("*.mcap"))
    assert [str(log) in str(caught.value) for log in logs] == [True]
    assert LogReader(logs[0]).complete


@pytest.mark.parametrize("torque", [False, True])
def test_a_run_is_left_when_its_offset_is_gone(torque: bool) -> None:
    run = load_run("arm9-transition", {"duration_s": 0.1})
    robot = run.robot.description
    cycle = InProcess(run, lambda topic, message: None)
    cycle.boot()
    cycle.step()
    core, mode = cycle.master.core, ControlMode.TORQUE if torque else ControlMode.POSITION
    values: dict[str, Any] = {"torque" if torque else "position": (0.0,) * len(robot.joints)}
    cycle._exchange()
    cycle._advance()
    session = str(core.session)
    cycle.master.apply(JointCommand(session=session, sequence=cycle.sequence, time_ns=0, mode=mode, **values))
    cycle._close_cycle()
    before = cycle.sequence
    cycle.finish()
    ramp = round(robot.safety.hold_ramp_s * robot.rate_hz)
    assert (cycle.sequence - before > ramp) == torque
    assert cycle.sequence - before > robot.command_delay_cycles
