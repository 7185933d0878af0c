"""Kernel modules: which ones the machine needs and in which order they load."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from deploy.can_vm.errors import MachineUnavailableError

HOST_FILES = ("virtio_pci", "virtio_console", "virtio_rng", "9pnet_virtio", "9p")
CAN = ("can_raw", "can_bcm", "vcan", "kvaser_pci")
WANTED = (*HOST_FILES, *CAN)
"""What the machine is made of; what these depend on comes by itself."""

_DEPENDS = re.compile(rb"\0depends=([^\0]*)\0")


def module_name(path: str) -> str:
    """Give the kernel's name of the module in a file: `…/can-raw.ko.xz` is `can_raw`."""
    return path.rsplit("/", 1)[-1].split(".ko", 1)[0].replace("-", "_")


def dependencies(module: bytes) -> tuple[str, ...]:
    """Read the modules a module needs from its `.modinfo` section."""
    found = _DEPENDS.search(module)
    names = found.group(1).decode().split(",") if found else []
    return tuple(name.replace("-", "_") for name in names if name)


def load_order(wanted: Iterable[str], needs: Callable[[str], Iterable[str] | None]) -> tuple[str, ...]:
    """Sort modules and all they need so that each comes after what it needs.

    `needs` gives a module's dependencies, or None for one built into the kernel.

    Raises:
        MachineUnavailableError: modules need each other in a circle.

    """
    order: list[str] = []
    pending: list[str] = []

    def visit(name: str) -> None:
        if name in order:
            return
        if name in pending:
            raise MachineUnavailableError(f"kernel modules need each other in a circle: {' → '.join([*pending, name])}")
        required = needs(name)
        if required is None:
            return
        pending.append(name)
        for other in required:
            visit(other)
        pending.pop()
        order.append(name)

    for name in wanted:
        visit(name)
    return tuple(order)
