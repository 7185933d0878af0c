"""Errors of starting and supervising a run."""

from __future__ import annotations

from schemas.errors import ConfigurationError, CosimError


class DeployError(CosimError):
    """Base of this package's errors."""


class LaunchError(DeployError):
    """A service cannot be started: no free ports, no room for sockets."""


class ChildDiedError(DeployError):
    """A service ended before the run did; the message names it and what it printed last."""


class RunStoppedError(DeployError):
    """The HAL stopped the robot before the run was over; the message says why."""


class ReportError(DeployError):
    """A log holds too little for what was asked of it."""


class UsageError(DeployError, ConfigurationError):
    """An option on the command line does not make sense."""

    exit_code = 2
