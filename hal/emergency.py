"""EMCY error codes in words."""

from __future__ import annotations

from typing import Final

from hal.profile.cia402 import EmergencyCode

_NAMES: Final = {int(code): code.name for code in EmergencyCode}
_CLASSES: Final = {
    0x00: "error reset or no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, input side",
    0x22: "current inside the device",
    0x23: "current, output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "of the maker",
}
"""Error code classes, CiA 301 section 7.2.7.1, table 26: the code's high byte."""


def emergency_text(code: int) -> str:
    """Name a code that the profile knows; of any other its class, or the class of its first digit."""
    if code in _NAMES:
        return _NAMES[code]
    high = code >> 8
    return _CLASSES.get(high) or _CLASSES.get(high & 0xF0) or "of no class of CiA 301"
