"""A virtual machine with real CAN: Debian's kernel in QEMU with vcan and emulated controllers, on the host's files."""

from deploy.can_vm.config import PAIRS, VCAN, MachineConfig
from deploy.can_vm.errors import CanMachineError, MachineBootError, MachineTimeoutError, MachineUnavailableError
from deploy.can_vm.machine import Completed, run_in_machine
from deploy.can_vm.packages import default_cache, missing_packages, prepare

__all__ = [
    "PAIRS",
    "VCAN",
    "CanMachineError",
    "Completed",
    "MachineBootError",
    "MachineConfig",
    "MachineTimeoutError",
    "MachineUnavailableError",
    "default_cache",
    "missing_packages",
    "prepare",
    "run_in_machine",
]
