"""What the boot writes to a drive: pure lists of SDO writes, from the robot description and the profile's PDOs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hal.profile import identifiers, objects
from hal.profile.cia402 import AbortConnectionOption
from schemas.robot import Drive, Joint, RobotDescription

PROFILE_VENDOR_ID = 0x00000402
"""Maker of the profile's own drive, which has every object of the EDS; other makers' may lack the optional ones."""
HEARTBEAT_TOLERANCE = 3
"""Missing heartbeats that mean a loss."""
PDO_RECORDS = 2
"""PDO records of each direction that the profile uses."""
FOREIGN_PDO_RECORDS = 4
"""PDO records that CiA 402 drives of other makers preset: the unused ones are made invalid."""


@dataclass(frozen=True, slots=True)
class SdoWrite:
    """One write; an optional one may fail because the device has no such object."""

    index: int
    subindex: int
    value: int
    optional: bool = False


def communication_writes(description: RobotDescription, drive: Drive) -> tuple[SdoWrite, ...]:
    """Heartbeats, SYNC period and interpolation period: objects 0x1016, 0x1017, 0x1006, 0x60C2."""
    heartbeat_ms = max(1, round(description.safety.heartbeat_s * 1000.0))
    consumer = identifiers.HAL_NODE_ID << 16 | HEARTBEAT_TOLERANCE * heartbeat_ms
    mantissa, exponent = interpolation_period(description.period_s)
    foreign = drive.vendor_id != PROFILE_VENDOR_ID
    return (
        SdoWrite(objects.PRODUCER_HEARTBEAT_MS, 0, heartbeat_ms),
        SdoWrite(objects.CONSUMER_HEARTBEAT, 1, consumer),
        SdoWrite(objects.SYNC_PERIOD_US, 0, round(description.period_s * 1e6), foreign),
        SdoWrite(objects.INTERPOLATION_PERIOD, 1, mantissa, foreign),
        SdoWrite(objects.INTERPOLATION_PERIOD, 2, exponent, foreign),
    )


def drive_writes(description: RobotDescription, joint: Joint) -> tuple[SdoWrite, ...]:
    """Rated torque 0x6076 [mN·m], its limit 0x6072 [‰], and our maker's firmware parameters 0x2001 to 0x2005.

    Another maker's drive may have anything at those indices, and no watchdog: it gets option 0x6007 "quick stop"
    instead, by which it stops when the HAL's heartbeat is missing.
    """
    drive, safety = joint.drive, description.safety
    per_mille = math.floor(1000.0 * joint.torque_limit / (drive.rated_motor_torque * joint.gear_ratio) * (1.0 + 1e-12))
    torque = (
        SdoWrite(objects.RATED_TORQUE_MNM, 0, round(drive.rated_motor_torque * 1000.0)),
        SdoWrite(objects.MAX_TORQUE, 0, per_mille),
    )
    if drive.vendor_id != PROFILE_VENDOR_ID:
        return (*torque, SdoWrite(objects.ABORT_CONNECTION_OPTION, 0, AbortConnectionOption.QUICK_STOP, optional=True))
    return (
        *torque,
        SdoWrite(objects.POSITION_GAIN, 0, round(drive.position_gain * 1000.0)),
        SdoWrite(objects.VELOCITY_GAIN, 0, round(drive.velocity_gain * 1000.0)),
        SdoWrite(objects.JOINT_TORQUE_LIMIT, 0, round(joint.torque_limit * 1000.0)),
        SdoWrite(objects.WATCHDOG_CYCLES, 0, safety.sync_timeout_cycles),
        SdoWrite(objects.HOLD_RAMP_MS, 0, round(safety.hold_ramp_s * 1000.0)),
    )


def pdo_writes(drive: Drive) -> tuple[SdoWrite, ...]:
    """Map the PDOs of a drive's kind and make all others invalid."""
    rpdos = {pdo.number: pdo for pdo in objects.RPDOS[drive.kind]}
    tpdos = {pdo.number: pdo for pdo in objects.TPDOS}
    node = drive.node_id
    foreign = drive.vendor_id != PROFILE_VENDOR_ID
    writes: list[SdoWrite] = []
    for number in range(FOREIGN_PDO_RECORDS if foreign else PDO_RECORDS):
        step = 0x100 * number
        if number in tpdos:
            communication = objects.TPDO_COMMUNICATION + number
            cob_id = identifiers.COB_ID_NO_RTR | tpdos[number].cob_id(node)
            writes += _remap(communication, objects.TPDO_MAPPING + number, tpdos[number], cob_id)
        else:
            cob_id = identifiers.COB_ID_NO_RTR | identifiers.TPDO1 + step + node
            writes.append(_invalidate(objects.TPDO_COMMUNICATION + number, cob_id, number >= PDO_RECORDS))
        if number in rpdos:
            communication = objects.RPDO_COMMUNICATION + number
            writes += _remap(communication, objects.RPDO_MAPPING + number, rpdos[number], rpdos[number].cob_id(node))
        else:
            cob_id = identifiers.RPDO1 + step + node
            writes.append(_invalidate(objects.RPDO_COMMUNICATION + number, cob_id, number >= PDO_RECORDS))
    return tuple(writes)


def interpolation_period(period_s: float) -> tuple[int, int]:
    """Object 0x60C2: (mantissa, exponent) with mantissa · 10^exponent s nearest to a period, mantissa below 256."""
    exponent = math.floor(math.log10(period_s)) - 2
    while round(period_s / 10.0**exponent) > 255:
        exponent += 1
    mantissa = round(period_s / 10.0**exponent)
    while mantissa % 10 == 0:
        mantissa //= 10
        exponent += 1
    return mantissa, exponent


def _remap(communication: int, mapping: int, pdo: objects.Pdo, cob_id: int) -> list[SdoWrite]:
    """Follow the sequence of CiA 301 section 7.5.2.36: invalid, empty, entries, count, type, valid."""
    entries = [SdoWrite(mapping, number, entry) for number, entry in enumerate(pdo.entries, 1)]
    return [
        _invalidate(communication, cob_id),
        SdoWrite(mapping, 0, 0),
        *entries,
        SdoWrite(mapping, 0, len(entries)),
        SdoWrite(communication, 2, pdo.transmission_type),
        SdoWrite(communication, 1, cob_id),
    ]


def _invalidate(communication: int, cob_id: int, optional: bool = False) -> SdoWrite:
    return SdoWrite(communication, 1, identifiers.COB_ID_INVALID | cob_id, optional)
