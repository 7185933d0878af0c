"""CAN error frames of the Linux kernel, `linux/can/error.h`: what a controller says of itself and of its bus.

They carry `CAN_ERR_FLAG`, never were on the wire, and are no part of any protocol above.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

from hal.errors import ProfileError
from hal.profile.frames import CAN_ERR_FLAG, FRAME_BYTES

TX_TIMEOUT: Final = 0x001
LOST_ARBITRATION: Final = 0x002
CONTROLLER: Final = 0x004
PROTOCOL: Final = 0x008
TRANSCEIVER: Final = 0x010
NO_ACK: Final = 0x020
BUS_OFF: Final = 0x040
BUS_ERROR: Final = 0x080
RESTARTED: Final = 0x100
COUNTERS: Final = 0x200
"""`CAN_ERR_CNT`: data[6] and data[7] hold the counters."""

RX_OVERFLOW: Final = 0x01
TX_OVERFLOW: Final = 0x02
RX_WARNING: Final = 0x04
TX_WARNING: Final = 0x08
RX_PASSIVE: Final = 0x10
TX_PASSIVE: Final = 0x20
ACTIVE: Final = 0x40

_STRUCT: Final = struct.Struct("<IB3x8B")


class Trouble(Enum):
    """What an error frame tells, in words for an event."""

    BUS_OFF = "bus-off"
    RESTARTED = "controller restarted"
    ERROR_PASSIVE = "error-passive"
    ERROR_WARNING = "error warning level (96) reached"
    ERROR_ACTIVE = "error-active again"
    RECEIVE_OVERFLOW = "receive buffer overflow"
    TRANSMIT_OVERFLOW = "transmit buffer overflow"
    NO_ACKNOWLEDGE = "no node acknowledges"
    PROTOCOL = "protocol error"
    TRANSCEIVER = "transceiver error"
    TRANSMIT_TIMEOUT = "transmission timed out"
    BUS_ERROR = "bus error"
    CONTROLLER = "controller problem"
    LOST_ARBITRATION = "lost arbitration"
    """No fault: another node's frame went first."""


_CLASSES: Final = (
    (BUS_OFF, Trouble.BUS_OFF),
    (RESTARTED, Trouble.RESTARTED),
    (NO_ACK, Trouble.NO_ACKNOWLEDGE),
    (PROTOCOL, Trouble.PROTOCOL),
    (TRANSCEIVER, Trouble.TRANSCEIVER),
    (TX_TIMEOUT, Trouble.TRANSMIT_TIMEOUT),
    (BUS_ERROR, Trouble.BUS_ERROR),
    (LOST_ARBITRATION, Trouble.LOST_ARBITRATION),
)
_CONTROLLER_STATES: Final = (
    (RX_PASSIVE | TX_PASSIVE, Trouble.ERROR_PASSIVE),
    (RX_WARNING | TX_WARNING, Trouble.ERROR_WARNING),
    (ACTIVE, Trouble.ERROR_ACTIVE),
    (RX_OVERFLOW, Trouble.RECEIVE_OVERFLOW),
    (TX_OVERFLOW, Trouble.TRANSMIT_OVERFLOW),
)
_VIOLATIONS: Final = (
    (0x01, "single bit"),
    (0x02, "frame format"),
    (0x04, "bit stuffing"),
    (0x08, "unable to send a dominant bit"),
    (0x10, "unable to send a recessive bit"),
    (0x20, "overload"),
    (0x40, "active error announcement"),
    (0x80, "on transmission"),
)
_LOCATIONS: Final = {
    0x02: "identifier bits 28-21",
    0x03: "start of frame",
    0x04: "substitute RTR",
    0x05: "identifier extension",
    0x06: "identifier bits 20-18",
    0x07: "identifier bits 17-13",
    0x08: "CRC sequence",
    0x09: "reserved bit 0",
    0x0A: "data",
    0x0B: "data length code",
    0x0C: "RTR",
    0x0D: "reserved bit 1",
    0x0E: "identifier bits 4-0",
    0x0F: "identifier bits 12-5",
    0x12: "intermission",
    0x18: "CRC delimiter",
    0x19: "ACK slot",
    0x1A: "end of frame",
    0x1B: "ACK delimiter",
}
_WIRES: Final = {
    0x04: "CANH not connected",
    0x05: "CANH shorted to battery",
    0x06: "CANH shorted to supply",
    0x07: "CANH shorted to ground",
    0x40: "CANL not connected",
    0x50: "CANL shorted to battery",
    0x60: "CANL shorted to supply",
    0x70: "CANL shorted to ground",
    0x80: "CANL shorted to CANH",
}


@dataclass(frozen=True, slots=True)
class ErrorReport:
    """One error frame in words; `transmit_errors` (TEC) and `receive_errors` (REC) are None where it does not say."""

    troubles: tuple[Trouble, ...]
    detail: str = ""
    transmit_errors: int | None = None
    receive_errors: int | None = None

    def __str__(self) -> str:
        parts = [trouble.value for trouble in self.troubles]
        if self.detail:
            parts.append(self.detail)
        if self.transmit_errors is not None:
            parts.append(f"TEC {self.transmit_errors}, REC {self.receive_errors}")
        return ", ".join(parts)


def decode_error(frame: bytes) -> ErrorReport:
    """Read an error frame of 16 bytes.

    Raises:
        ProfileError: not one frame, or it does not carry `CAN_ERR_FLAG`.
    """
    if len(frame) != FRAME_BYTES:
        raise ProfileError(f"an error frame of {len(frame)} bytes; it has {FRAME_BYTES}")
    head, _, _, controller, violation, location, wire, _, transmit, receive = _STRUCT.unpack(frame)
    if not head & CAN_ERR_FLAG:
        raise ProfileError(f"frame {head:#x} is no error frame: it has no CAN_ERR_FLAG")
    troubles = [trouble for bit, trouble in _CLASSES if head & bit]
    details = []
    if head & CONTROLLER:
        found = [trouble for bits, trouble in _CONTROLLER_STATES if controller & bits]
        troubles += found or [Trouble.CONTROLLER]
    if head & PROTOCOL:
        details += [text for bit, text in _VIOLATIONS if violation & bit]
        if location in _LOCATIONS:
            details.append(f"in {_LOCATIONS[location]}")
    if head & TRANSCEIVER and wire in _WIRES:
        details.append(_WIRES[wire])
    # Drivers older than CAN_ERR_CNT fill the counters without saying so.
    counted = bool(head & COUNTERS or transmit or receive)
    return ErrorReport(tuple(troubles), ", ".join(details), transmit if counted else None, receive if counted else None)


def split_errors(packet: bytes) -> tuple[bytes, bytes]:
    """Frames of the wire, and error frames, of a packet; each in its order."""
    if not any(_heads(packet)):
        return packet, b""
    wire, errors = bytearray(), bytearray()
    for start, is_error in zip(range(0, len(packet), FRAME_BYTES), _heads(packet), strict=True):
        (errors if is_error else wire).extend(packet[start : start + FRAME_BYTES])
    return bytes(wire), bytes(errors)


def _heads(packet: bytes) -> Iterator[int]:
    """Whether each frame is an error frame: the flag lies in the fourth byte of the little-endian identifier."""
    return (byte & (CAN_ERR_FLAG >> 24) for byte in packet[3::FRAME_BYTES])
