"""Looking for the nodes: all that are missing or wrong are named, late ones are waited for, nothing is enabled."""

from __future__ import annotations

import pytest

from hal.boot import boot_network
from hal.bus.errors import BusOverflowError
from hal.errors import BootError, NodesMissingError
from hal.find import find_nodes
from tests.hal.foreign_device import ENABLED, ForeignSlave
from tests.hal.foreign_objects import Habits
from tests.hal.foreign_robot import NODES, Wire, boot, foreign_robot, wire


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short patience: nothing here is slow but what is told to be."""
    monkeypatch.setattr("hal.find.ASK_S", 0.1)


def test_all_wrong_drives_are_named() -> None:
    bus = wire(Habits(vendor_id=0x99), Habits(), Habits(supported_modes=0x80))
    with pytest.raises(BootError, match=r"^2 of 3 drives cannot be used: .*joint1.*vendor_id.*; .*joint3.*0x6502"):
        boot(bus)
    assert not any(slave.power == ENABLED for slave in bus.slaves)


def test_a_drive_that_does_not_answer_is_told_from_a_missing_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.sdo_client.SDO_TIMEOUT_S", 0.05)
    with pytest.raises(BootError, match=r"joint2 .*SDO read of 0x1000:0 failed .*check the drive's power"):
        boot(wire(Habits(), Habits(answers=False)))


def test_all_missing_nodes_are_named_and_none_is_left_powered() -> None:
    bus = wire(Habits(), Habits(), Habits())
    boot(bus)
    bus.unplugged = {1, 3}
    with pytest.raises(
        BootError, match=r"^2 of 3 drives did not boot within 0\.3 s: .*node 1 on .*node 3 on bus right"
    ):
        boot(bus, timeout_s=0.3)
    assert bus.slaves[1].power != ENABLED


def test_a_drive_whose_power_comes_on_late_is_found() -> None:
    class Late(Wire):
        asked = 0

        def receive(self, timeout_s: float) -> bytes:
            self.asked += 1
            if self.asked == 4:
                self.unplugged.clear()
                self.slaves[1].reset()
            return super().receive(min(timeout_s, 0.05))

    bus = Late([ForeignSlave(node) for node in NODES])
    bus.unplugged = {2}
    boot(bus)
    assert all(slave.power == ENABLED for slave in bus.slaves)


def test_a_bus_without_any_node_takes_no_frame_and_names_all() -> None:
    class Dead(Wire):
        def send(self, frames: bytes) -> None:
            raise BusOverflowError("bus right: the transmit queue is full: nobody acknowledges")

    with pytest.raises(NodesMissingError, match=r"^3 of 3 drives did not boot within 0\.2 s"):
        find_nodes(foreign_robot(NODES), [Dead([])], 0.2)


def test_nodes_are_found_before_they_are_booted() -> None:
    bus = wire(Habits(), Habits(), Habits())
    robot = foreign_robot(NODES)
    found = find_nodes(robot, [bus], 1.0)
    assert {can_id for can_id, _ in bus.sent} == {0x000, 0x601, 0x602, 0x603}
    assert {data[0] for can_id, data in bus.sent if can_id > 0x600} == {0x40}, "nothing is written"
    assert [identity.device_type for identity in found.identities] == [0x20192] * 3
    bus.slaves[0].reset()  # somebody switched it off and on
    bus.sent.clear()
    assert len(boot_network(robot, [bus], 1.0, found).drives) == 3
    assert (0x000, bytes([0x82, 1])) not in bus.sent
    assert all(slave.power == ENABLED for slave in bus.slaves)
