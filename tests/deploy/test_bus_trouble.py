"""A whole run in which a bus's controller reports trouble: stop, recovery, end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deploy.replay_bus import replay_hal
from hal.bus.ports import CosimPort
from hal.profile.frames import pack
from schemas.log import LogReader
from schemas.messages import Event, HalStatus, PlantTruth, RobotState
from tests.deploy.running import cosim_up

pytestmark = [pytest.mark.processes, pytest.mark.timeout(240)]
IN_TORQUE = 850
"""A sequence of arm9-transition well inside torque mode."""
ONE_DEGREE = np.radians(1.0)


@pytest.mark.parametrize(
    ("frame", "kind"),
    [
        (pack(0x20000040, bytes(8)), "bus_off"),
        (pack(0x20000004, bytes.fromhex("0020000000008000")), "bus_error_passive"),
    ],
)
def test_trouble_of_a_bus_is_a_safe_stop_and_is_recovered_from(tmp_path: Path, frame: bytes, kind: str) -> None:
    with cosim_up(tmp_path, "arm9-transition", "--duration", "60") as running:
        running.wait_for_sequence(IN_TORQUE)
        port = CosimPort("arm9-1", Path(running.session().directory) / "arm9-1")
        port.send(frame)
        ending = running.end()
        port.close()
    assert ending.code == 1, ending.output
    assert "safe stop: bus arm9-1: " in ending.output
    reader = LogReader(running.log)
    events = list(reader.messages(Event))
    kinds = [event.kind for event in events if event.service == "hal"]
    assert [each for each in kinds if each != "mode_change"][:3] == [kind, "safe_stop", "bus_recovered"], events
    stopped = next(event.sequence for event in events if event.kind == "safe_stop")
    states = list(reader.messages(RobotState))
    assert states[-1].sequence > stopped
    assert states[-1].status is HalStatus.SAFE_STOP
    truths = list(reader.messages(PlantTruth))
    position = np.array([truth.position for truth in truths if truth.sequence >= stopped])
    assert np.abs(position - position[0]).max() < ONE_DEGREE
    assert set(truths[-1].mode) == {8}
    compared, difference = replay_hal(reader, exact=True)
    assert difference is None, difference
    assert compared == len(states)
