"""What a drive's own objects do beside holding a value: checks, firmware parameters and set-points written by SDO."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from hal.profile import objects
from hal.profile.cia402 import AbortConnectionOption
from plant_service.axis import Axis, AxisGains
from plant_service.nmt import K_CONSUMER
from plant_service.object_dictionary import AbortCode, DeviceDictionary, key_of
from plant_service.pdo import CAN_ID_BITS
from plant_service.power import K_CONTROLWORD, K_MAX_TORQUE, K_MODE, K_POSITION, K_TORQUE, Power

K_SYNC_COB_ID: Final = key_of(objects.SYNC_COB_ID)
K_ABORT_OPTION: Final = key_of(objects.ABORT_CONNECTION_OPTION)
K_COUNTER: Final = key_of(objects.SYNC_COUNTER)
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
    *,
    setpoint: Callable[[int], None],
    routes: Callable[[], None],
) -> None:
    """Have SDO downloads act.

    Args:
        dictionary: of the drive; the heartbeat consumer's hooks are in it already.
        axis: takes the firmware parameters.
        supports: whether the drive has a mode.
        setpoint: called with the key after an object that commands the drive was written.
        routes: called after the drive came to listen to another identifier.

    """
    written = dictionary.written
    _install_checks(dictionary, supports)
    for key in GAIN_FIELDS:
        written[key] = partial(_configure, axis, key)
    for key in (K_CONTROLWORD, K_MODE, K_POSITION, K_TORQUE, K_MAX_TORQUE):
        written[key] = partial(_call, setpoint, key)
    written[K_SYNC_COB_ID] = lambda _: routes()
    watch = written[K_CONSUMER]

    def watch_another(value: int) -> None:
        watch(value)
        routes()

    written[K_CONSUMER] = watch_another


def abort_connection(power: Power, option: int, now_ns: int) -> bool:
    """Act by option 0x6007 when the connection to the master is lost; returns whether the drive is to fault."""
    if option == AbortConnectionOption.FAULT_SIGNAL:
        return True
    if option == AbortConnectionOption.DISABLE_VOLTAGE:
        power.disable_voltage()
    elif option == AbortConnectionOption.QUICK_STOP:
        power.quick_stop(now_ns)
    else:
        power.lose_command()
    return False


def _call(act: Callable[[int], None], key: int, _: int) -> None:
    act(key)


def _install_checks(dictionary: DeviceDictionary, supports: Callable[[int], bool]) -> None:
    """Have the dictionary refuse modes that the drive lacks, a SYNC producer, and a SYNC counter."""

    def check_mode(mode: int) -> None:
        if not supports(mode):
            raise dictionary.entries[K_MODE].abort(AbortCode.VALUE_INVALID)

    def check_sync(value: int) -> None:
        if value & ~CAN_ID_BITS or not value & CAN_ID_BITS:  # bit 30 would make it a producer
            raise dictionary.entries[K_SYNC_COB_ID].abort(AbortCode.VALUE_INVALID)

    def check_counter(value: int) -> None:
        if value:
            raise dictionary.entries[K_COUNTER].abort(AbortCode.VALUE_INVALID)

    dictionary.on_write |= {K_MODE: check_mode, K_SYNC_COB_ID: check_sync, K_COUNTER: check_counter}


def configure_all(dictionary: DeviceDictionary, axis: Axis) -> None:
    """Give the axis all firmware parameters of the dictionary."""
    for key in GAIN_FIELDS:
        _configure(axis, key, dictionary.values[key])


def _configure(axis: Axis, key: int, value: int) -> None:
    field, unit = GAIN_FIELDS[key]
    if value:  # 0 is "as the maker left it"
        axis.configure(AxisGains(**{field: value * unit}))
