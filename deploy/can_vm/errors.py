"""Errors of the CAN machine."""

from __future__ import annotations

from deploy.errors import DeployError


class CanMachineError(DeployError):
    """Base of the CAN machine's errors."""


class MachineUnavailableError(CanMachineError):
    """A package the machine is built from is missing; the message names it and how to get it."""

    exit_code = 2


class MachineBootError(CanMachineError):
    """The guest did not come as far as the command, or its kernel broke; the message holds the console's last lines."""


class MachineTimeoutError(CanMachineError):
    """The command did not end in the time given to it; the machine has been switched off."""
