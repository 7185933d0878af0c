"""Indices of the object dictionary, the PDOs of each kind of drive and their byte layouts (see `drive.eds`)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from importlib import resources
from typing import Final

import numpy as np

from hal.profile import identifiers

DEVICE_TYPE: Final = 0x1000
ERROR_REGISTER: Final = 0x1001
ERROR_HISTORY: Final = 0x1003
SYNC_COB_ID: Final = 0x1005
SYNC_PERIOD_US: Final = 0x1006
HARDWARE_VERSION: Final = 0x1009
SOFTWARE_VERSION: Final = 0x100A
EMCY_COB_ID: Final = 0x1014
CONSUMER_HEARTBEAT: Final = 0x1016
"""Sub 1: node << 16 | ms."""
PRODUCER_HEARTBEAT_MS: Final = 0x1017
IDENTITY: Final = 0x1018
SYNC_COUNTER: Final = 0x1019
"""Value after which the counter in the SYNC starts again at 1; 0: SYNC has no counter."""
ERROR_BEHAVIOUR: Final = 0x1029
"""Sub 1: NMT state after a lost heartbeat: 0 pre-operational, 1 as it is, 2 stopped."""
RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00

ABORT_CONNECTION_OPTION: Final = 0x6007
ERROR_CODE: Final = 0x603F
CONTROLWORD: Final = 0x6040
STATUSWORD: Final = 0x6041
QUICK_STOP_OPTION: Final = 0x605A
SHUTDOWN_OPTION: Final = 0x605B
DISABLE_OPERATION_OPTION: Final = 0x605C
HALT_OPTION: Final = 0x605D
FAULT_REACTION_OPTION: Final = 0x605E
MODE: Final = 0x6060
MODE_DISPLAY: Final = 0x6061
POSITION_ACTUAL: Final = 0x6064
FOLLOWING_ERROR_WINDOW: Final = 0x6065
VELOCITY_ACTUAL: Final = 0x606C
TARGET_TORQUE: Final = 0x6071
MAX_TORQUE: Final = 0x6072
TORQUE_DEMAND: Final = 0x6074
RATED_TORQUE_MNM: Final = 0x6076
TORQUE_ACTUAL: Final = 0x6077
TARGET_POSITION: Final = 0x607A
SOFTWARE_POSITION_LIMIT: Final = 0x607D
"""Sub 1 min, sub 2 max, counts."""
ENCODER_RESOLUTION: Final = 0x608F
"""Sub 1 counts per sub 2 motor turns."""
INTERPOLATION_PERIOD: Final = 0x60C2
"""Sub 1 × 10^(sub 2) s."""
SUPPORTED_DRIVE_MODES: Final = 0x6502

POSITION_GAIN: Final = 0x2001
"""Maker's, U32: k_p at the joint [mN·m/rad]."""
VELOCITY_GAIN: Final = 0x2002
"""Maker's, U32: k_d at the joint [mN·m·s/rad]."""
JOINT_TORQUE_LIMIT: Final = 0x2003
"""Maker's, U32: largest motor torque at the joint [mN·m]."""
WATCHDOG_CYCLES: Final = 0x2004
"""Maker's, U16: SYNC periods without SYNC or RPDO after which the drive holds by itself; 0 is off."""
HOLD_RAMP_MS: Final = 0x2005
"""Maker's, U16: time over which a held torque offset ramps to zero."""
TIME_BASE: Final = 0x2006
"""Maker's, U8: see `TimeBase`."""


def entry(index: int, subindex: int, bits: int) -> int:
    """Build the mapping entry of a PDO: index << 16 | subindex << 8 | bits (CiA 301 section 7.5.2.36)."""
    return index << 16 | subindex << 8 | bits


class TimeBase:
    """Values of object 0x2006."""

    WALL_CLOCK: Final = 0
    SIMULATION: Final = 1
    """The drive's time is that of the simulation, which stands still before the first SYNC of a lockstep run."""


class TransmissionType:
    """PDO transmission types, CiA 301 section 7.5.2.35."""

    SYNC_ON_CHANGE: Final = 0
    """Synchronous, acyclic: after the SYNC, when an event occurred before it."""
    EVERY_SYNC: Final = 1
    EVENT_DRIVEN: Final = 255


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO of the profile: which record of the dictionary, base COB-ID, what it maps and when it is sent.

    `number` counts from 0: communication record `0x1400 + number` (RPDO) or `0x1800 + number` (TPDO).
    """

    number: int
    cob_base: int
    entries: tuple[int, ...]
    transmission_type: int = TransmissionType.EVERY_SYNC

    @property
    def size(self) -> int:
        """Data bytes."""
        return sum(mapped & 0xFF for mapped in self.entries) // 8

    def cob_id(self, node_id: int) -> int:
        """Return the identifier of one node's PDO."""
        return self.cob_base + node_id


TPDO_STATE: Final = Pdo(
    0,
    identifiers.TPDO1,
    (entry(STATUSWORD, 0, 16), entry(POSITION_ACTUAL, 0, 32), entry(TORQUE_ACTUAL, 0, 16)),
)
"""8 bytes, after every SYNC."""
TPDO_MODE: Final = Pdo(
    1,
    identifiers.TPDO2,
    (entry(MODE_DISPLAY, 0, 8), entry(ERROR_CODE, 0, 16)),
    TransmissionType.SYNC_ON_CHANGE,
)
"""3 bytes, after a SYNC by which mode or error changed."""
RPDO_POSITION: Final = Pdo(
    0, identifiers.RPDO1, (entry(CONTROLWORD, 0, 16), entry(MODE, 0, 8), entry(TARGET_POSITION, 0, 32))
)
"""7 bytes."""
RPDO_TORQUE: Final = Pdo(
    1, identifiers.RPDO2, (entry(CONTROLWORD, 0, 16), entry(MODE, 0, 8), entry(TARGET_TORQUE, 0, 16))
)
"""5 bytes."""
RPDO_SERVO: Final = Pdo(
    0, identifiers.RPDO1, (entry(CONTROLWORD, 0, 16), entry(TARGET_POSITION, 0, 32), entry(MAX_TORQUE, 0, 16))
)
"""8 bytes."""

TPDOS: Final = (TPDO_STATE, TPDO_MODE)
RPDOS: Final[dict[str, tuple[Pdo, ...]]] = {
    "position_pd": (RPDO_POSITION,),
    "torque": (RPDO_POSITION, RPDO_TORQUE),
    "servo": (RPDO_SERVO,),
}
"""RPDOs of each kind of drive; any other of the two records is made invalid."""

STATE_STRUCT: Final = struct.Struct("<Hih")
"""statusword, position [counts], torque [‰]."""
MODE_STRUCT: Final = struct.Struct("<bH")
"""mode, error code."""
POSITION_STRUCT: Final = struct.Struct("<Hbi")
"""controlword, mode, target position [counts]."""
TORQUE_STRUCT: Final = struct.Struct("<Hbh")
"""controlword, mode, target torque [‰]."""
SERVO_STRUCT: Final = struct.Struct("<HiH")
"""controlword, target position [counts], max torque [‰]."""
EMCY_STRUCT: Final = struct.Struct("<HB5s")
"""error code, error register, maker's bytes."""

STATE_LAYOUT: Final = np.dtype([("statusword", "<u2"), ("position", "<i4"), ("torque", "<i2")])
MODE_LAYOUT: Final = np.dtype([("mode", "i1"), ("error_code", "<u2")])
POSITION_LAYOUT: Final = np.dtype([("controlword", "<u2"), ("mode", "i1"), ("position", "<i4")])
TORQUE_LAYOUT: Final = np.dtype([("controlword", "<u2"), ("mode", "i1"), ("torque", "<i2")])
SERVO_LAYOUT: Final = np.dtype([("controlword", "<u2"), ("position", "<i4"), ("max_torque", "<u2")])


def eds_path() -> str:
    """Path of the drive's EDS file (CiA 306), for `canopen.import_od`."""
    return str(resources.files("hal.profile").joinpath("drive.eds"))
