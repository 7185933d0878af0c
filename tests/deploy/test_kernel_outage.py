"""Whole runs on the kernel's CAN whose interfaces go down or report trouble; run in `cosim can-vm`."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hal.profile.frames import pack
from schemas.log import LogReader
from schemas.messages import Event, PlantTruth
from tests.deploy import running
from tests.deploy.running import cosim_up
from tests.hal.bus.test_socketcan_kernel import has_interface, ip

pytestmark = [
    pytest.mark.processes,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not has_interface("vcan2"), reason="no vcan0-2 on this machine: run in `cosim can-vm`"),
]
VCAN = ("--bus", "vcan0,vcan1,vcan2")
CARDS = ("--bus", "can0,can2,can4", "--plant-bus", "can1,can3,can5")
BUS_OFF = pack(0x20000040, bytes(8))
PASSIVE = pack(0x20000004, bytes.fromhex("0020000000008000"))


def down_and_up(interface: str) -> Callable[[], None]:
    def act() -> None:
        ip("link", "set", interface, "down")
        time.sleep(1.0)
        ip("link", "set", interface, "up")

    return act


def inject(interface: str, frame: bytes) -> Callable[[], None]:
    def act() -> None:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            raw.bind((interface,))
            raw.send(frame)

    return act


@pytest.mark.parametrize(
    ("buses", "act", "kind", "also"),
    [
        pytest.param(VCAN, down_and_up("vcan1"), "bus_down", "bus_down", id="both-ends-down"),
        pytest.param(CARDS, down_and_up("can2"), "bus_down", "sync_missing", id="the-hals-card-down"),
        pytest.param(VCAN, inject("vcan1", BUS_OFF), "bus_off", None, id="bus-off"),
        pytest.param(VCAN, inject("vcan1", PASSIVE), "bus_error_passive", None, id="error-passive"),
    ],
)
def test_an_outage_is_a_safe_stop_and_is_recovered_from(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    buses: tuple[str, ...],
    act: Callable[[], None],
    kind: str,
    also: str | None,
) -> None:
    if buses is CARDS and not has_interface("can5"):
        pytest.skip("no pairs of controllers on this machine")
    monkeypatch.setattr(running, "PATIENCE_S", 300.0)
    with cosim_up(tmp_path, "arm9-transition", *buses, "--duration", "120") as up:
        up.wait_for_sequence(50)
        act()
        ending = up.end(300.0)
    assert ending.code == 1, ending.output
    assert "bus arm9-1" in ending.output
    reader = LogReader(up.log)
    events = list(reader.messages(Event))
    of_hal = [event.kind for event in events if event.service == "hal"]
    assert kind in of_hal, events
    assert of_hal.index(kind) < of_hal.index("safe_stop")
    assert "bus_recovered" in of_hal, [(event.kind, event.text) for event in events]
    if also is not None:
        assert also in [event.kind for event in events if event.service == "plant"], events
    truths = list(reader.messages(PlantTruth))
    stopped = next(event.sequence for event in events if event.kind == "safe_stop")
    position = np.array([truth.position for truth in truths if truth.sequence >= stopped])
    assert len(position) > 20
    assert np.abs(position - position[0]).max() < np.radians(1.0)
