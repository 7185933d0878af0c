"""The first part of the boot: which nodes are on the buses, and whether they are those of the robot description.

Nothing is configured and nothing is enabled: NMT reset communication, boot-up messages, identity, modes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TypeVar

from hal.boot_objects import PROFILE_VENDOR_ID
from hal.bus.errors import BusError, BusOverflowError
from hal.bus.ports import FramePort
from hal.errors import BootError, HalError, NodesMissingError
from hal.node_link import NodeLink
from hal.profile import identifiers, objects
from hal.profile.cia402 import SUPPORTED_MODES, Controlword
from hal.sdo_client import PortNetwork
from schemas.robot import Joint, RobotDescription

ASK_S: Final = 2.0
"""Silence after which a node without a boot-up message is asked whether it is there."""
DISABLE_S: Final = 0.5
"""Wait for the drives to confirm that they are disabled."""
DRIVE_PROFILES: Final = (402, 0)
"""Lower half of object 0x1000: CiA 402, or none claimed."""

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """What one node says of itself: objects 0x1000, 0x1018, 0x6502, and 0x2006 of what claims to be the profile's."""

    device_type: int
    vendor_id: int
    product_code: int
    supported_modes: int
    """Bit n − 1 stands for mode n."""
    foreign: bool
    """Not the profile's own, simulated drive: it lives in wall-clock time and has the standards' objects at most.

    The vendor id alone does not tell: a device made after the profile's EDS may have it too.
    """


@dataclass(frozen=True, slots=True)
class FoundNodes:
    """All drives of a robot, in the order of its joints: each is there, and is the one described."""

    links: tuple[NodeLink, ...]
    identities: tuple[NodeIdentity, ...]
    boot_ups: tuple[int, ...]
    """Boot-up messages heard of each node so far; one more and it has restarted since."""


def find_nodes(robot: RobotDescription, ports: Sequence[FramePort], timeout_s: float = 5.0) -> FoundNodes:
    """Reset the communication of a robot's nodes, wait for them and check what they are.

    A node whose power comes on meanwhile is found by its boot-up message; one that lives but sends none, by its answer.

    Args:
        robot: the description; `ports` follow its buses.
        ports: one open port a bus.
        timeout_s: time [s] for all nodes to appear.

    Raises:
        NodesMissingError: nodes did not appear; all are named.
        BootError: nodes are others than described; all are named. In both cases those that answered are left disabled.
        BusLostError: a bus is gone.

    """
    if len(ports) != len(robot.buses):
        raise BootError(f"robot {robot.name} has {len(robot.buses)} buses, {len(ports)} ports are open")
    networks = [PortNetwork(port) for port in ports]
    links = tuple(
        NodeLink(networks[robot.bus_index(joint.drive.bus)], joint.drive.node_id, joint.name) for joint in robot.joints
    )
    for network in networks:
        network.pump(0.0)
    for link in links:
        link.boot_ups = 0
        with suppress(BusOverflowError):  # nobody is there to acknowledge a frame: all its nodes are missing
            link.command(identifiers.NMT_RESET_COMMUNICATION)
    try:
        _await_nodes(links, timeout_s)
        for link in links:
            link.command(identifiers.NMT_PRE_OPERATIONAL)
        identities = for_all(links, lambda index, link: _identify(link, robot.joints[index]))
    except HalError:
        disable(links)
        raise
    return FoundNodes(links, tuple(identities), tuple(link.boot_ups for link in links))


def for_all(links: Sequence[NodeLink], step: Callable[[int, NodeLink], Result]) -> list[Result]:
    """Do one step with every node, index and link, even when it fails for some.

    Raises:
        BootError: names what failed at every node.

    """
    results, errors = [], []
    for index, link in enumerate(links):
        try:
            results.append(step(index, link))
        except BootError as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        found = "; ".join(map(str, errors))
        raise BootError(f"{len(errors)} of {len(links)} drives cannot be used: {found}") from errors[0]
    return results


def disable(links: Iterable[NodeLink]) -> None:
    """Take the power from all drives that live, after a boot that failed: nobody will watch them, their brakes hold.

    What fails here is not told of: the failure that led here is.
    """
    alive = [(link, link.answers) for link in links if link.boot_ups or link.answers]
    for link, _ in alive:
        with suppress(BusError):
            link.order(Controlword.DISABLE_VOLTAGE)
    deadline = time.monotonic() + DISABLE_S
    for link, before in alive:
        with suppress(BusError):
            link.network.wait_until(
                lambda link=link, before=before: link.answers > before,  # type: ignore[misc]  # bound in the loop
                deadline - time.monotonic(),
            )


def _await_nodes(links: Sequence[NodeLink], timeout_s: float) -> None:
    now = time.monotonic()
    deadline, pause = now + timeout_s, min(ASK_S, 0.5 * timeout_s)
    ask_at = now + pause
    while (missing := _missing(links, lambda link: link.boot_ups > 0)) and now < deadline:
        if now >= ask_at:
            ask_at += pause
            for link in missing:
                with suppress(BusOverflowError):  # as for the reset
                    link.ask()
        first = missing[0]
        first.network.wait_until(lambda first=first: first.boot_ups > 0, min(deadline, ask_at) - now)  # type: ignore[misc]
        now = time.monotonic()
    # One that never sent a boot-up message but answers is there; until now it may have been on its way to reset.
    missing = _missing(links, lambda link: link.boot_ups > 0 or link.answers > 0)
    if missing:
        raise NodesMissingError(
            f"{len(missing)} of {len(links)} drives did not boot within {timeout_s:g} s:"
            f" {', '.join(link.where for link in missing)}; check power, node ids and wiring"
        )


def _missing(links: Sequence[NodeLink], there: Callable[[NodeLink], bool]) -> list[NodeLink]:
    for network in {id(link.network): link.network for link in links}.values():
        network.pump(0.0)
    return [link for link in links if not there(link)]


def _identify(link: NodeLink, joint: Joint) -> NodeIdentity:
    """Ask a node what it is; it has to be what the description says."""
    device_type = link.read(objects.DEVICE_TYPE)
    if device_type & 0xFFFF not in DRIVE_PROFILES:
        raise BootError(
            f"{link.where}: device type 0x1000 is 0x{device_type:08X}, profile CiA {device_type & 0xFFFF};"
            " a drive has CiA 402"
        )
    vendor_id, product_code = link.read(objects.IDENTITY, 1), link.read_optional(objects.IDENTITY, 2) or 0
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
    own = vendor_id == PROFILE_VENDOR_ID and link.peek(objects.TIME_BASE) == objects.TimeBase.SIMULATION
    return NodeIdentity(device_type, vendor_id, product_code, supported, foreign=not own)
