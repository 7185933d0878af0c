"""The boot of one drive of a whole simulated robot, frame by frame as a master of any make would write it."""

from __future__ import annotations

from plant_service.plant import Plant
from schemas.load import load_run

DIALOGUE = [
    ("605 40 00 10 00 00 00 00 00", "585 43 00 10 00 92 01 02 00"),  # a servo drive of CiA 402
    ("605 40 02 65 00 00 00 00 00", "585 43 02 65 00 80 02 00 00"),  # that has modes 8 and 10
    ("605 23 00 14 01 05 02 00 80", "585 60 00 14 01 00 00 00 00"),  # RPDO1 invalid
    ("605 2f 00 16 00 00 00 00 00", "585 60 00 16 00 00 00 00 00"),  # empty
    ("605 23 00 16 01 10 00 40 60", "585 60 00 16 01 00 00 00 00"),  # the controlword alone
    ("605 2f 00 16 00 01 00 00 00", "585 60 00 16 00 00 00 00 00"),  # one object
    ("605 23 00 14 01 05 02 00 00", "585 60 00 14 01 00 00 00 00"),  # RPDO1 valid
    ("605 2f 60 60 00 08 00 00 00", "585 60 60 60 00 00 00 00 00"),  # mode 8
    ("605 40 61 60 00 00 00 00 00", "585 4f 61 60 00 08 00 00 00"),  # displayed
    ("605 40 41 60 00 00 00 00 00", "585 4b 41 60 00 50 02 00 00"),  # Switch On Disabled
    ("605 2b 40 60 00 06 00 00 00", "585 60 40 60 00 00 00 00 00"),
    ("605 40 41 60 00 00 00 00 00", "585 4b 41 60 00 31 02 00 00"),  # Ready To Switch On
    ("605 2b 40 60 00 07 00 00 00", "585 60 40 60 00 00 00 00 00"),
    ("605 40 41 60 00 00 00 00 00", "585 4b 41 60 00 33 02 00 00"),  # Switched On
    ("000 01 05", None),
    ("605 2b 40 60 00 0f 00 00 00", "585 60 40 60 00 00 00 00 00"),
    ("605 40 41 60 00 00 00 00 00", "585 4b 41 60 00 37 02 00 00"),  # Operation Enabled
    ("605 40 00 30 00 00 00 00 00", "585 80 00 30 00 00 00 02 06"),  # no such object
]


def packet(frame: str) -> bytes:
    """`struct can_frame` of 16 bytes."""
    can_id, _, text = frame.partition(" ")
    data = bytes.fromhex(text)
    return int(can_id, 16).to_bytes(4, "little") + bytes([len(data), 0, 0, 0]) + data.ljust(8, b"\0")


def test_a_drive_is_identified_mapped_and_enabled():
    run = load_run("arm9-transition")
    robot = run.robot.description
    bus = next(robot.bus_index(joint.drive.bus) for joint in robot.joints if joint.drive.node_id == 5)
    plant = Plant(run)
    assert packet("705 00") in plant.deliver(bus, packet("000 81 00"))
    for request, answer in DIALOGUE:
        said = plant.deliver(bus, packet(request))
        assert said == (packet(answer) if answer else b""), request


def test_the_boot_up_message_of_every_drive_comes_first():
    run = load_run("arm9-transition")
    plant = Plant(run)
    for index, bus in enumerate(run.robot.description.buses):
        nodes = [joint.drive.node_id for joint in run.robot.description.joints if joint.drive.bus == bus.name]
        assert plant.deliver(index, packet("000 81 00")) == b"".join(packet(f"{0x700 + node:03x} 00") for node in nodes)
