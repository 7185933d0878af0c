"""COB-IDs of the predefined connection set, CiA 301 section 7.3.5: base plus node id."""

from __future__ import annotations

from typing import Final

NMT: Final = 0x000
SYNC: Final = 0x080
EMCY: Final = 0x080
TPDO1: Final = 0x180
RPDO1: Final = 0x200
TPDO2: Final = 0x280
RPDO2: Final = 0x300
SDO_TX: Final = 0x580
"""Server to client: what the drive answers."""
SDO_RX: Final = 0x600
"""Client to server: what the HAL asks."""
HEARTBEAT: Final = 0x700

HAL_NODE_ID: Final = 127
"""The HAL's own node id, under which it sends its heartbeat."""

COB_ID_INVALID: Final = 0x80000000
"""Bit 31 of a PDO's COB-ID entry: the PDO does not exist."""
COB_ID_NO_RTR: Final = 0x40000000
"""Bit 30 of a TPDO's COB-ID entry: no remote request."""

NMT_START: Final = 0x01
NMT_STOP: Final = 0x02
NMT_PRE_OPERATIONAL: Final = 0x80
NMT_RESET_NODE: Final = 0x81
NMT_RESET_COMMUNICATION: Final = 0x82

HEARTBEAT_BOOT_UP: Final = 0x00
HEARTBEAT_STOPPED: Final = 0x04
HEARTBEAT_OPERATIONAL: Final = 0x05
HEARTBEAT_PRE_OPERATIONAL: Final = 0x7F
