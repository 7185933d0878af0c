"""Option codes of CiA 402-2: how a drive stops. Values that no drive of ours has are left out, and refused by SDO."""

from __future__ import annotations

from enum import IntEnum


class QuickStopOption(IntEnum):
    """Object 0x605A; the standard's 4 and 8, at the voltage limit, are left out."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
    SLOW_DOWN_RAMP_STAY = 5
    QUICK_STOP_RAMP_STAY = 6
    CURRENT_LIMIT_STAY = 7


class ShutdownOption(IntEnum):
    """Object 0x605B."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1


class DisableOperationOption(IntEnum):
    """Object 0x605C."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1


class HaltOption(IntEnum):
    """Object 0x605D; the standard's 4, at the voltage limit, is left out."""

    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3


class FaultReactionOption(IntEnum):
    """Object 0x605E; the standard's 4, at the voltage limit, is left out."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
