"""What the boot sets in a drive: pure lists of values, from the robot description and the profile's PDOs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

from hal.profile import identifiers, objects
from hal.profile.cia402 import AbortConnectionOption
from hal.profile.objects import Pdo, TransmissionType
from schemas.robot import Drive, Joint, RobotDescription

PROFILE_VENDOR_ID = 0x00000402
"""Of the profile's own drive; `hal.find` tells it from others that claim the same."""
HEARTBEAT_TOLERANCE = 3
"""Missing heartbeats that mean a loss."""
PDO_RECORDS = 2
"""PDO records of each direction that the profile uses."""
FOREIGN_PDO_RECORDS = 4
"""PDO records that CiA 402 drives of other makers preset: the unused ones are made invalid."""
FOREIGN_RPDO_TYPES: Final = (TransmissionType.EVERY_SYNC, 0, TransmissionType.EVENT_DRIVEN, 254)
FOREIGN_MODE_TYPES: Final = (TransmissionType.EVERY_SYNC, TransmissionType.SYNC_ON_CHANGE, 255, 254)
"""Another maker's drive reports mode and error after every SYNC where it can: stacks differ in what is a change."""


TPDO_MODE_ALONE: Final = Pdo(
    objects.TPDO_MODE.number, objects.TPDO_MODE.cob_base, objects.TPDO_MODE.entries[:1], TransmissionType.EVERY_SYNC
)
"""TPDO2 of a drive that has no error code 0x603F: 1 byte."""


class Need(Enum):
    """What becomes of a drive that does not take a value."""

    ALWAYS = "always"
    """It is refused."""
    IF_PRESENT = "if present"
    """It is refused, unless it has no such object at all."""
    WISH = "wish"
    """It is used all the same."""


@dataclass(frozen=True, slots=True)
class SdoWrite:
    """One value for one object."""

    index: int
    subindex: int
    value: int
    need: Need = Need.ALWAYS


@dataclass(frozen=True, slots=True)
class PdoPlan:
    """One PDO record of a drive and what it has to hold."""

    name: str
    """E.g. `TPDO1`, in the standard's counting."""
    communication: int
    """Index of its communication record."""
    mapping: int
    """Index of its mapping record."""
    pdo: Pdo | None
    """None: the PDO is not used, and made invalid where it exists."""
    cob_id: int = 0
    """Entry of sub-index 1 that makes it valid."""
    types: tuple[int, ...] = ()
    """Transmission types that do, the best first."""


def communication_writes(description: RobotDescription, *, foreign: bool) -> tuple[SdoWrite, ...]:
    """Heartbeats, SYNC period and interpolation period: objects 0x1016, 0x1017, 0x1006, 0x60C2."""
    heartbeat_ms = max(1, round(description.safety.heartbeat_s * 1000.0))
    consumer = identifiers.HAL_NODE_ID << 16 | HEARTBEAT_TOLERANCE * heartbeat_ms
    mantissa, exponent = interpolation_period(description.period_s)
    if_present, wish = (Need.IF_PRESENT, Need.WISH) if foreign else (Need.ALWAYS, Need.ALWAYS)
    return (
        SdoWrite(objects.PRODUCER_HEARTBEAT_MS, 0, heartbeat_ms),
        SdoWrite(objects.CONSUMER_HEARTBEAT, 1, consumer, if_present),
        SdoWrite(objects.SYNC_PERIOD_US, 0, round(description.period_s * 1e6), wish),
        SdoWrite(objects.INTERPOLATION_PERIOD, 1, mantissa, if_present),
        SdoWrite(objects.INTERPOLATION_PERIOD, 2, exponent, if_present),
    )


def drive_writes(description: RobotDescription, joint: Joint, *, foreign: bool) -> tuple[SdoWrite, ...]:
    """Rated torque 0x6076 [mN·m], its limit 0x6072 [‰], and our maker's firmware parameters 0x2001 to 0x2005.

    Another maker's drive may have anything at those indices, and no watchdog: it gets option 0x6007 "quick stop"
    instead, by which it stops when the HAL's heartbeat is missing.
    """
    drive, safety = joint.drive, description.safety
    rated, limit = round(drive.rated_motor_torque * 1000.0), torque_limit_per_mille(joint)
    if foreign:
        need = Need.ALWAYS if drive.kind == "servo" else Need.IF_PRESENT
        return (
            SdoWrite(objects.RATED_TORQUE_MNM, 0, rated, Need.IF_PRESENT),
            SdoWrite(objects.MAX_TORQUE, 0, limit, need),
            SdoWrite(objects.ABORT_CONNECTION_OPTION, 0, AbortConnectionOption.QUICK_STOP, Need.WISH),
        )
    return (
        SdoWrite(objects.RATED_TORQUE_MNM, 0, rated),
        SdoWrite(objects.MAX_TORQUE, 0, limit),
        SdoWrite(objects.POSITION_GAIN, 0, round(drive.position_gain * 1000.0)),
        SdoWrite(objects.VELOCITY_GAIN, 0, round(drive.velocity_gain * 1000.0)),
        SdoWrite(objects.JOINT_TORQUE_LIMIT, 0, round(joint.torque_limit * 1000.0)),
        SdoWrite(objects.WATCHDOG_CYCLES, 0, safety.sync_timeout_cycles),
        SdoWrite(objects.HOLD_RAMP_MS, 0, round(safety.hold_ramp_s * 1000.0)),
    )


def torque_limit_per_mille(joint: Joint) -> int:
    """Object 0x6072: the joint's torque limit in ‰ of the rated torque, rounded down."""
    rated = joint.drive.rated_motor_torque * joint.gear_ratio
    return math.floor(1000.0 * joint.torque_limit / rated * (1.0 + 1e-12))


def pdo_plans(drive: Drive, *, foreign: bool, reports_errors: bool = True) -> tuple[PdoPlan, ...]:
    """List the PDO records of a drive: those of its kind, and all others invalid.

    Args:
        drive: as described.
        foreign: it is another maker's.
        reports_errors: it has object 0x603F.
    """
    node = drive.node_id
    rpdos = {pdo.number: pdo for pdo in objects.RPDOS[drive.kind]}
    tpdos = {pdo.number: pdo for pdo in (objects.TPDO_STATE, objects.TPDO_MODE if reports_errors else TPDO_MODE_ALONE)}
    plans: list[PdoPlan] = []
    for number in range(FOREIGN_PDO_RECORDS if foreign else PDO_RECORDS):
        tpdo, rpdo = tpdos.get(number), rpdos.get(number)
        cob_id = 0
        types: tuple[int, ...] = ()
        if tpdo is not None:
            cob_id = identifiers.COB_ID_NO_RTR | tpdo.cob_id(node)
            types = FOREIGN_MODE_TYPES if foreign and tpdo is not objects.TPDO_STATE else (tpdo.transmission_type,)
        records = (objects.TPDO_COMMUNICATION + number, objects.TPDO_MAPPING + number)
        plans.append(PdoPlan(f"TPDO{number + 1}", *records, tpdo, cob_id, types))
        cob_id, types = 0, ()
        if rpdo is not None:
            cob_id, types = rpdo.cob_id(node), FOREIGN_RPDO_TYPES if foreign else (rpdo.transmission_type,)
        records = (objects.RPDO_COMMUNICATION + number, objects.RPDO_MAPPING + number)
        plans.append(PdoPlan(f"RPDO{number + 1}", *records, rpdo, cob_id, types))
    return tuple(plans)


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
