"""The network boot: from drives that were found to OPERATION ENABLED in position mode, holding where they stand.

Everything is set by NMT and SDO. No SYNC is sent to the profile's own drives, so that no simulated time passes, and the
frames depend on the robot description and the drives' answers alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hal.boot_objects import (
    HEARTBEAT_TOLERANCE,
    PROFILE_VENDOR_ID,
    Need,
    SdoWrite,
    communication_writes,
    drive_writes,
    pdo_plans,
)
from hal.bus.ports import FramePort
from hal.enable import PowerUp
from hal.errors import BootError, HalError
from hal.find import FoundNodes, NodeIdentity, disable, find_nodes, for_all
from hal.node_link import NodeLink
from hal.pdo_setup import set_up_pdo
from hal.profile import identifiers, objects
from hal.profile.cia402 import OperationMode
from hal.profile.frames import pack
from hal.profile.sensors import force_torque_command
from hal.profile.units import DriveUnits
from hal.sdo_client import SYNC_WINDOW_US
from schemas.base import Vector
from schemas.robot import Joint, RobotDescription

POSITION_MARGIN_RAD = 0.05
"""How far beyond its range a joint may stand at the boot."""
ECHOES: Final = 0.5
"""Share of answers heard twice that proves nothing yet: some may be another client's."""
HEARTBEAT_WAIT_S = 2.0
"""Wait for the first heartbeat of another maker's drive, at least."""
NOT_SIMULATED: Final = (
    "has the simulated drives' vendor id, but object 0x2006 does not say so; the standards' objects alone are used"
)


@dataclass(frozen=True, slots=True)
class DriveReport:
    """What one drive said of itself at the boot."""

    joint: str
    node_id: int
    vendor_id: int
    product_code: int
    supported_modes: int
    """Object 0x6502: bit n − 1 stands for mode n."""
    mode: OperationMode
    """Object 0x6061 once enabled."""
    position_counts: int
    """Object 0x6064."""
    position: float
    """The same at the joint [rad]."""
    foreign: bool
    """It is another maker's and lives in wall-clock time."""
    notes: tuple[str, ...] = ()
    """What the drive did not take but can do without, e.g. that it cannot watch the HAL's heartbeat."""


@dataclass(frozen=True, slots=True)
class BootReport:
    """All drives in the order of the description's joints, each in OPERATION ENABLED."""

    drives: tuple[DriveReport, ...]

    @property
    def position_measured(self) -> Vector:
        """Where the joints stood [rad]."""
        return tuple(drive.position for drive in self.drives)

    @property
    def position_counts(self) -> tuple[int, ...]:
        """Where the drives stood [counts]."""
        return tuple(drive.position_counts for drive in self.drives)

    @property
    def notes(self) -> tuple[str, ...]:
        """All drives' notes."""
        return tuple(note for drive in self.drives for note in drive.notes)


def boot_network(
    robot: RobotDescription, ports: Sequence[FramePort], timeout_s: float = 5.0, found: FoundNodes | None = None
) -> BootReport:
    """Boot every drive of a robot and start its sensors; whatever fails, all drives are left disabled.

    Args:
        robot: the description; `ports` follow its buses.
        ports: one open port a bus.
        timeout_s: time [s] for all nodes to appear, and again for each drive to be enabled.
        found: what `find_nodes` found on these ports; None: it is asked first.

    Raises:
        BootError: nodes are missing or others than described (all are named), refuse a parameter, stand outside their
            joint's range, send no heartbeat, or do not reach OPERATION ENABLED.
        BusLostError: a bus is gone.

    """
    if found is None:
        found = find_nodes(robot, ports, timeout_s)
    links = found.links
    climbs: list[PowerUp] = []
    try:
        _rejoin(found)
        notes = for_all(
            links, lambda index, link: _configure(robot, link, robot.joints[index], found.identities[index])
        )
        counts = for_all(links, lambda _, link: link.read(objects.POSITION_ACTUAL))
        positions = _positions(robot, counts)
        for_all(links, lambda index, link: _check_position(link, robot.joints[index], positions[index]))
        _check_nodes(found)
        _await_heartbeats(robot, found)
        _check_nodes(found)
        climbs += _climbs(robot, found, counts, timeout_s)
        for_all(links, lambda index, _: climbs[index].prepare())
        for link in links:
            link.command(identifiers.NMT_START)
        modes = [climb.run() for climb in climbs]
        _check_nodes(found)
    except HalError:  # a bus that went down included
        for climb in climbs:
            climb.give_up()
        disable(links)
        raise
    for sensor in robot.force_torque_sensors:
        ports[robot.bus_index(sensor.bus)].send(pack(sensor.command_id, force_torque_command(start=True)))
    stands = [climb.counts for climb in climbs]
    return BootReport(
        tuple(
            DriveReport(
                joint=link.joint,
                node_id=link.node_id,
                vendor_id=identity.vendor_id,
                product_code=identity.product_code,
                supported_modes=identity.supported_modes,
                mode=mode,
                position_counts=stand,
                position=position,
                foreign=identity.foreign,
                notes=note,
            )
            for link, identity, mode, stand, position, note in zip(
                links, found.identities, modes, stands, _positions(robot, stands), notes, strict=True
            )
        )
    )


def _positions(robot: RobotDescription, counts: list[int]) -> list[float]:
    positions: list[float] = DriveUnits.of(robot).position_from_counts(np.array(counts, dtype=np.int32)).tolist()
    return positions


def _rejoin(found: FoundNodes) -> None:
    """Stop again what restarted since it was found: such a node may have gone to OPERATIONAL by itself."""
    for index, link in enumerate(found.links):
        link.network.pump(0.0)
        if link.boot_ups > found.boot_ups[index]:
            link.command(identifiers.NMT_PRE_OPERATIONAL)
        link.boot_ups = found.boot_ups[index]


def _check_nodes(found: FoundNodes) -> None:
    for link, boot_ups in zip(found.links, found.boot_ups, strict=True):
        if link.boot_ups > boot_ups:
            raise BootError(f"{link.where}: was reset during the boot; check its supply, or for another NMT master")
        if link.echoes > ECHOES:
            raise BootError(
                f"{link.where}: {link.echoes:.0%} of the SDO requests were answered twice;"
                " give each device a node id of its own"
            )


def _configure(robot: RobotDescription, link: NodeLink, joint: Joint, identity: NodeIdentity) -> tuple[str, ...]:
    """Write all parameters of one drive; what it did not take but can do without."""
    notes: list[str] = []
    absent: list[str] = []
    reports_errors, foreign = True, identity.foreign
    if foreign and identity.vendor_id == PROFILE_VENDOR_ID:
        notes.append(f"{link.where}: {NOT_SIMULATED}")
    if foreign:
        _settle(link, absent, notes)
        link.read(objects.TORQUE_ACTUAL)  # mapped, so it must be there, with the profile's length
        reports_errors = link.read_optional(objects.ERROR_CODE) is not None
        absent += [] if reports_errors else [f"0x{objects.ERROR_CODE:04X}:0"]
    link.heartbeats = 0
    for write in communication_writes(robot, foreign=foreign):
        _write(link, write, absent, notes)
    for plan in pdo_plans(joint.drive, foreign=foreign, reports_errors=reports_errors):
        note = set_up_pdo(link, plan)
        notes += [] if note is None else [note]
    for write in drive_writes(robot, joint, foreign=foreign):
        _write(link, write, absent, notes)
    if absent:
        notes.insert(0, f"{link.where}: the drive works without optional objects: {', '.join(absent)}")
    return tuple(notes)


def _write(link: NodeLink, write: SdoWrite, absent: list[str], notes: list[str]) -> None:
    refusal = link.try_write(write.index, write.subindex, write.value)
    if refusal is None:
        return
    if refusal.absent and write.need is not Need.ALWAYS:
        absent.append(f"0x{write.index:04X}:{write.subindex}")
    elif write.need is Need.WISH:
        notes.append(refusal.text)
    else:
        raise BootError(refusal.text)


def _settle(link: NodeLink, absent: list[str], notes: list[str]) -> None:
    """Have a drive take the HAL's SYNC, commands at any time before it, and send EMCY where the HAL listens."""
    for index, value, need in (
        (objects.SYNC_COB_ID, identifiers.SYNC, Need.ALWAYS),
        (SYNC_WINDOW_US, 0, Need.WISH),
        (objects.EMCY_COB_ID, identifiers.EMCY + link.node_id, Need.WISH),
    ):
        if link.read_optional(index) not in (None, value):
            _write(link, SdoWrite(index, 0, value, need), absent, notes)


def _check_position(link: NodeLink, joint: Joint, position: float) -> None:
    low, high = joint.position_min - POSITION_MARGIN_RAD, joint.position_max + POSITION_MARGIN_RAD
    if not low <= position <= high:
        raise BootError(
            f"{link.where}: stands at {position:.4f} rad, its range is [{joint.position_min:g}, {joint.position_max:g}]"
            f" ± {POSITION_MARGIN_RAD:g} rad; move it by hand or correct zero_offset"
        )


def _await_heartbeats(robot: RobotDescription, found: FoundNodes) -> None:
    """Hear a heartbeat of every drive of another maker; the profile's own beat in simulated time."""
    wait_s = max(HEARTBEAT_WAIT_S, HEARTBEAT_TOLERANCE * robot.safety.heartbeat_s)
    deadline = time.monotonic() + wait_s

    def check(index: int, link: NodeLink) -> None:
        if not found.identities[index].foreign:
            return
        if not link.network.wait_until(lambda: link.heartbeats > 0, deadline - time.monotonic()):
            raise BootError(
                f"{link.where}: no heartbeat within {wait_s:g} s although object 0x1017 asks for one every"
                f" {robot.safety.heartbeat_s * 1e3:g} ms; wrong drive, or check its firmware"
            )

    for_all(found.links, check)


def _climbs(robot: RobotDescription, found: FoundNodes, counts: list[int], timeout_s: float) -> list[PowerUp]:
    nodes = list(zip(found.links, found.identities, robot.joints, counts, strict=True))
    own_buses = {joint.drive.bus for _, identity, joint, _ in nodes if not identity.foreign}
    return [
        PowerUp(
            link,
            joint,
            stand,
            timeout_s,
            robot.period_s,
            foreign=identity.foreign,
            may_sync=joint.drive.bus not in own_buses,
        )
        for link, identity, joint, stand in nodes
    ]
