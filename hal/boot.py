"""The network boot: from powered drives to OPERATION ENABLED in position mode, holding where they stand.

Everything is set by NMT and SDO, no SYNC is sent, so that no simulated time passes. The frames depend on the robot
description and the drives' answers alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from hal.boot_objects import SdoWrite, communication_writes, drive_writes, pdo_writes
from hal.bus.ports import FramePort
from hal.errors import BootError
from hal.node_link import NodeLink, PortNetwork
from hal.profile import identifiers, objects
from hal.profile.cia402 import SUPPORTED_MODES, Controlword, OperationMode, decode_state, next_controlword
from hal.profile.frames import pack
from hal.profile.sensors import force_torque_command
from hal.profile.units import DriveUnits
from schemas.base import Vector
from schemas.messages import DriveState
from schemas.robot import Joint, RobotDescription

POSITION_MARGIN_RAD = 0.05
"""How far beyond its range a joint may stand at the boot."""
POLL_S = 0.001
"""Pause before a drive that is on its way is asked again."""


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


def boot_network(robot: RobotDescription, ports: Sequence[FramePort], timeout_s: float = 5.0) -> BootReport:
    """Boot every drive of a robot and start its sensors.

    Args:
        robot: the description; `ports` follow its buses.
        ports: one open port a bus.
        timeout_s: time [s] for all nodes to appear, and again for each drive to be enabled.

    Raises:
        BootError: nodes are missing (all are named), a drive is another than described, refuses a parameter, stands
            outside its joint's range, or does not reach OPERATION ENABLED.
        BusLostError: a bus is gone.

    """
    if len(ports) != len(robot.buses):
        raise BootError(f"robot {robot.name} has {len(robot.buses)} buses, {len(ports)} ports are open")
    networks = [PortNetwork(port) for port in ports]
    links = [
        NodeLink(networks[robot.bus_index(joint.drive.bus)], joint.drive.node_id, joint.name) for joint in robot.joints
    ]
    _reset(networks, links, timeout_s)
    identities = [_identify(link, joint) for link, joint in zip(links, robot.joints, strict=True)]
    for link, joint in zip(links, robot.joints, strict=True):
        _write_all(link, communication_writes(robot, joint.drive))
        _write_all(link, pdo_writes(joint.drive))
        _write_all(link, drive_writes(robot, joint))
    counts = np.array([link.read(objects.POSITION_ACTUAL) for link in links], dtype=np.int32)
    positions = DriveUnits.of(robot).position_from_counts(counts)
    for link, joint, position in zip(links, robot.joints, positions.tolist(), strict=True):
        _check_position(link, joint, position)
    for link, joint, stand in zip(links, robot.joints, counts.tolist(), strict=True):
        _prepare(link, joint, stand)
    for link in links:
        link.command(identifiers.NMT_START)
    try:
        modes = [_enable(link, timeout_s) for link in links]
    except BootError:
        _disable(links)
        raise
    for sensor in robot.force_torque_sensors:
        ports[robot.bus_index(sensor.bus)].send(pack(sensor.command_id, force_torque_command(start=True)))
    return BootReport(
        tuple(
            DriveReport(link.joint, link.node_id, *identity, mode, stand, position)
            for link, identity, mode, stand, position in zip(
                links, identities, modes, counts.tolist(), positions.tolist(), strict=True
            )
        )
    )


def _reset(networks: Iterable[PortNetwork], links: Sequence[NodeLink], timeout_s: float) -> None:
    """Reset the communication of all nodes and wait for their boot-up messages."""
    for network in networks:
        network.pump(0.0)
    for link in links:
        link.booted = False
        link.command(identifiers.NMT_RESET_COMMUNICATION)
    deadline = time.monotonic() + timeout_s
    for link in links:
        link.network.wait_until(lambda link=link: link.booted, deadline - time.monotonic())  # type: ignore[misc]
    missing = [link.where for link in links if not link.booted]
    if missing:
        raise BootError(
            f"{len(missing)} of {len(links)} drives did not boot within {timeout_s:g} s: {', '.join(missing)};"
            " check power, node ids and wiring"
        )
    for link in links:
        link.command(identifiers.NMT_PRE_OPERATIONAL)


def _identify(link: NodeLink, joint: Joint) -> tuple[int, int, int]:
    """Vendor, product and modes of a drive, once they are known to be those described."""
    vendor_id, product_code = link.read(objects.IDENTITY, 1), link.read(objects.IDENTITY, 2)
    for name, found, expected in (
        ("vendor_id", vendor_id, joint.drive.vendor_id),
        ("product_code", product_code, joint.drive.product_code),
    ):
        if found != expected:
            raise BootError(
                f"{link.where}: {name} is 0x{found:08X}, the robot description says 0x{expected:08X};"
                " wrong drive, or correct the description"
            )
    supported, needed = link.read(objects.SUPPORTED_DRIVE_MODES), SUPPORTED_MODES[joint.drive.kind]
    if supported & needed != needed:
        raise BootError(
            f"{link.where}: object 0x6502 is 0x{supported:08X}, a {joint.drive.kind} drive needs 0x{needed:08X}"
            " (bit n-1 for mode n)"
        )
    return vendor_id, product_code, supported


def _write_all(link: NodeLink, writes: Iterable[SdoWrite]) -> None:
    for write in writes:
        link.write(write.index, write.subindex, write.value, optional=write.optional)


def _check_position(link: NodeLink, joint: Joint, position: float) -> None:
    low, high = joint.position_min - POSITION_MARGIN_RAD, joint.position_max + POSITION_MARGIN_RAD
    if not low <= position <= high:
        raise BootError(
            f"{link.where}: stands at {position:.4f} rad, its range is [{joint.position_min:g}, {joint.position_max:g}]"
            f" ± {POSITION_MARGIN_RAD:g} rad; move it by hand or correct zero_offset"
        )


def _prepare(link: NodeLink, joint: Joint, counts: int) -> None:
    """Set position mode and, unless the drive holds already, targets that keep the joint where it stands."""
    link.write(objects.MODE, 0, OperationMode.CSP)
    if decode_state(link.read(objects.STATUSWORD)) is not DriveState.OPERATION_ENABLED:
        link.write(objects.TARGET_POSITION, 0, counts)
        if joint.drive.kind == "torque":
            link.write(objects.TARGET_TORQUE, 0, 0)


def _disable(links: Iterable[NodeLink]) -> None:
    """Take the power from all drives after a boot that failed: nobody will watch them, and their brakes hold."""
    for link in links:
        with suppress(BootError):  # the failure that led here is the one to tell of
            link.write(objects.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)


def _enable(link: NodeLink, timeout_s: float) -> OperationMode:
    """Lead a drive to OPERATION ENABLED, reading a fresh statusword before each step; its mode then."""
    deadline = time.monotonic() + timeout_s
    before: DriveState | None = None
    fault_was_reset = False
    while True:
        state = decode_state(link.read(objects.STATUSWORD))
        if state is DriveState.OPERATION_ENABLED:
            break
        if time.monotonic() > deadline or (state is DriveState.FAULT and fault_was_reset):
            code = link.read_optional(objects.ERROR_CODE) or 0
            raise BootError(
                f"{link.where}: stays in {state.name} instead of OPERATION_ENABLED, error code 0x{code:04X};"
                " remove the cause and start again"
            )
        command = next_controlword(state, DriveState.OPERATION_ENABLED)
        if command == Controlword.FAULT_RESET:
            fault_was_reset = True
            link.write(objects.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)
        elif state is before:
            time.sleep(POLL_S)
        before = state
        link.write(objects.CONTROLWORD, 0, command)
    mode = link.read(objects.MODE_DISPLAY)
    if mode != OperationMode.CSP:
        raise BootError(f"{link.where}: reports mode {mode} (object 0x6061) after mode {OperationMode.CSP:d} was set")
    return OperationMode.CSP
