"""What a drive's own objects do beside holding a value: checks, firmware parameters and set-points written by SDO."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from hal.profile import objects
from hal.profile.cia402 import AbortConnectionOption
from hal.profile.stop_options import (
    DisableOperationOption,
    FaultReactionOption,
    HaltOption,
    QuickStopOption,
    ShutdownOption,
)
from plant_service.axis import Axis, AxisGains
from plant_service.object_dictionary import AbortCode, DeviceDictionary, key_of
from plant_service.power import K_CONTROLWORD, K_MAX_TORQUE, K_MODE, K_POSITION, K_TORQUE, Power

K_ABORT_OPTION: Final = key_of(objects.ABORT_CONNECTION_OPTION)
OPTION_CODES: Final = {
    K_ABORT_OPTION: frozenset(AbortConnectionOption),
    key_of(objects.QUICK_STOP_OPTION): frozenset(QuickStopOption),
    key_of(objects.SHUTDOWN_OPTION): frozenset(ShutdownOption),
    key_of(objects.DISABLE_OPERATION_OPTION): frozenset(DisableOperationOption),
    key_of(objects.HALT_OPTION): frozenset(HaltOption),
    key_of(objects.FAULT_REACTION_OPTION): frozenset(FaultReactionOption),
}
"""Option code → values that the drive has; others are refused."""
GAIN_FIELDS: Final = {
    key_of(objects.POSITION_GAIN): ("position_gain", 1e-3),
    key_of(objects.VELOCITY_GAIN): ("velocity_gain", 1e-3),
    key_of(objects.HOLD_RAMP_MS): ("hold_ramp_s", 1e-3),
    key_of(objects.JOINT_TORQUE_LIMIT): ("torque_limit", 1e-3),
    key_of(objects.RATED_TORQUE_MNM): ("rated_motor_torque", 1e-3),
}
"""Firmware parameters: object → field of `AxisGains` and its unit in SI."""


def install_hooks(
    dictionary: DeviceDictionary,
    axis: Axis,
    supports: Callable[[int], bool],
    setpoint: Callable[[int], None],
) -> None:
    """Have SDO downloads act.

    Args:
        dictionary: of the drive.
        axis: takes the firmware parameters.
        supports: whether the drive has a mode.
        setpoint: called with the key after an object that commands the drive was written.

    """
    written = dictionary.written
    _install_checks(dictionary, supports)
    for key in GAIN_FIELDS:
        written[key] = partial(_configure, axis, key)
    for key in (K_CONTROLWORD, K_MODE, K_POSITION, K_TORQUE, K_MAX_TORQUE):
        written[key] = partial(_call, setpoint, key)


def abort_connection(power: Power, option: int, now_ns: int, *, watched: bool) -> bool:
    """Act by option 0x6007 when the connection to the master is lost; returns whether the drive is to fault.

    Option 0, "no action", leaves the drive to the maker's watchdogs, which hold it at once if they are on (`watched`).
    """
    if option == AbortConnectionOption.FAULT_SIGNAL:
        return True
    if option == AbortConnectionOption.DISABLE_VOLTAGE:
        power.disable_voltage()
    elif option == AbortConnectionOption.QUICK_STOP:
        power.quick_stop(now_ns)
    elif watched:
        power.lose_command()
    return False


def _call(act: Callable[[int], None], key: int, _: int) -> None:
    act(key)


def _install_checks(dictionary: DeviceDictionary, supports: Callable[[int], bool]) -> None:
    """Have the dictionary refuse the modes and option codes that the drive lacks."""
    entries = dictionary.entries

    def check_mode(mode: int) -> None:
        if not supports(mode):
            raise entries[K_MODE].abort(AbortCode.VALUE_INVALID)

    def check_option(key: int, value: int) -> None:
        if value not in OPTION_CODES[key]:
            raise entries[key].abort(AbortCode.VALUE_INVALID)

    dictionary.on_write[K_MODE] = check_mode
    dictionary.on_write |= {key: partial(check_option, key) for key in OPTION_CODES}


def configure_all(dictionary: DeviceDictionary, axis: Axis) -> None:
    """Give the axis all firmware parameters of the dictionary."""
    for key in GAIN_FIELDS:
        _configure(axis, key, dictionary.values[key])


def _configure(axis: Axis, key: int, value: int) -> None:
    field, unit = GAIN_FIELDS[key]
    if value:  # 0 is "as the maker left it"
        axis.configure(AxisGains(**{field: value * unit}))
