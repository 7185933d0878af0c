"""How long a frame occupies the bus: its bits with the stuff bits that its content asks for (ISO 11898-1).

From the start of frame to the end of the CRC a bit of the opposite value follows five equal ones. What is stuffed are
34 + 8n bits of an 11-bit-identifier frame with n data bytes (54 + 8n with 29 bits); 10 bits of delimiters,
acknowledgement and end of frame and 3 bits of interframe space come on top, unstuffed.
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

from hal.profile.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_RTR_FLAG, CAN_SFF_MASK

CRC_POLYNOMIAL: Final = 0x4599
"""x¹⁵ + x¹⁴ + x¹⁰ + x⁸ + x⁷ + x⁴ + x³ + 1, without its highest term."""
CRC_BITS: Final = 15
UNSTUFFED_BITS: Final = 13
LONGEST_RUN: Final = 5

_STATES: Final = 2 * (LONGEST_RUN - 1)
"""Last bit × 4 + its run − 1: a run of five is ended by its stuff bit at once."""
_STATE: Final = 0x7
_COUNT_SHIFT: Final = 3
_WORDS: Final = struct.Struct(">4H")


def frame_bits(frame: bytes) -> int:
    """Bits that a classic CAN frame (16 bytes, `struct can_frame`) takes on the wire, interframe space included."""
    length = frame[4]
    identifier = frame[0] | frame[1] << 8 | frame[2] << 16 | frame[3] << 24
    head = _HEADS.get(identifier << 4 | length)
    if head is None:
        head = _HEADS[identifier << 4 | length] = _head(identifier, length)
    bits, state, crc, size = head
    words = _WORDS.unpack_from(frame, 8)
    for word in words[: size >> 1]:
        entry = _OF_WORD[state << 16 | word]
        bits += entry >> _COUNT_SHIFT
        state = entry & _STATE
        crc = _CRC[crc << 1 ^ word]
    if size & 1:
        byte = frame[7 + size]
        entry = _OF_BYTE[state << 8 | byte]
        bits += entry >> _COUNT_SHIFT
        state = entry & _STATE
        crc = crc << 8 & 0x7F00 ^ _CRC[crc >> 7 ^ byte]
    entry = _OF_BYTE[state << 8 | crc >> 7]
    return bits + (entry >> _COUNT_SHIFT) + (_OF_SEVEN[(entry & _STATE) << 7 | crc & 0x7F] >> _COUNT_SHIFT)


def _head(identifier: int, length: int) -> tuple[int, int, int, int]:
    """Compute what all frames of an identifier and length share: bits known so far, state, CRC, data bytes."""
    remote = 1 if identifier & CAN_RTR_FLAG else 0
    if identifier & CAN_EFF_FLAG:
        number = identifier & CAN_EFF_MASK
        # start, 11 bits, SRR = 1, IDE = 1, 18 bits, RTR, two reserved bits, length
        head = ((((number >> 18) << 2 | 0b11) << 18 | number & 0x3FFFF) << 3 | remote << 2) << 4 | length
        size = 39
    else:
        head = ((identifier & CAN_SFF_MASK) << 1 | remote) << 6 | length  # start, 11 bits, RTR, IDE, reserved, length
        size = 19
    state, stuffed, crc = 0, 0, 0  # the start of frame: a 0 after the idle bus's 1
    for shift in reversed(range(size)):
        bit = head >> shift & 1
        crc = crc << 1 & 0x7FFF ^ (CRC_POLYNOMIAL if crc >> 14 ^ bit else 0)
        if shift < size - 1:
            state, added = _follow(state, bit)
            stuffed += added
    data_bytes = 0 if remote else length
    return size + 8 * data_bytes + CRC_BITS + UNSTUFFED_BITS + stuffed, state, crc, data_bytes


def _follow(state: int, bit: int) -> tuple[int, int]:
    """Next state, and the number of stuff bits, after one more bit."""
    last, run = divmod(state, LONGEST_RUN - 1)
    if bit != last:
        return bit * (LONGEST_RUN - 1), 0
    if run + 2 == LONGEST_RUN:
        return (1 - bit) * (LONGEST_RUN - 1), 1
    return state + 1, 0


def _table(width: int) -> bytes:
    """Stuff bits << 3 | next state, for state << width | the next `width` bits."""
    table = bytearray()
    for start in range(_STATES):
        for value in range(1 << width):
            state, stuffed = start, 0
            for shift in reversed(range(width)):
                state, added = _follow(state, value >> shift & 1)
                stuffed += added
            table.append(stuffed << _COUNT_SHIFT | state)
    return bytes(table)


def _word_table(of_byte: bytes) -> bytes:
    """As `_table(16)`, put together of two bytes."""
    single = np.frombuffer(of_byte, np.uint8).astype(np.int64)
    first = np.repeat(single, 256)
    second = single[(first & _STATE) << 8 | np.tile(np.arange(256), len(single))]
    return bytes(((first >> _COUNT_SHIFT << _COUNT_SHIFT) + second).astype(np.uint8))


def _crc_table() -> list[int]:
    """Compute v x¹⁵ mod the polynomial, for all v of 16 bits."""
    crc = np.zeros(1 << 16, np.int64)
    value = np.arange(1 << 16)
    for shift in reversed(range(16)):
        feedback = crc >> 14 ^ value >> shift & 1
        crc = crc << 1 & 0x7FFF ^ feedback * CRC_POLYNOMIAL
    return [int(each) for each in crc]


_HEADS: dict[int, tuple[int, int, int, int]] = {}
_OF_BYTE: Final = _table(8)
_OF_SEVEN: Final = _table(7)
_OF_WORD: Final = _word_table(_OF_BYTE)
_CRC: Final = _crc_table()
