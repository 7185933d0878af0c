"""Exact frame lengths: against a bit-by-bit encoder written from ISO 11898-1, a frame worked out by hand, bounds."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from hal.profile.bits import frame_bits
from hal.profile.frames import CAN_EFF_FLAG, CAN_RTR_FLAG, pack
from schemas.bus_load import worst_case_bits

standard = st.integers(0, 0x7FF)
payload = st.binary(max_size=8)


def reference(identifier: int, data: bytes, extended: bool, remote: bool) -> int:
    """Write all bits out, append the CRC by long division, stuff, count."""
    length = len(data)
    if extended:
        text = f"0{identifier >> 18:011b}11{identifier & 0x3FFFF:018b}{remote:d}00{length:04b}"
    else:
        text = f"0{identifier:011b}{remote:d}00{length:04b}"
    if not remote:
        text += "".join(f"{byte:08b}" for byte in data)
    number = int(text + 15 * "0", 2)
    divisor = 0b1100010110011001
    for shift in reversed(range(len(text))):
        if number >> (shift + 15) & 1:
            number ^= divisor << shift
    text += f"{number:015b}"
    stuffed = ""
    for bit in text:
        stuffed += bit
        if stuffed.endswith(("00000", "11111")) and run_of(stuffed) == 5:
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + 1 + 2 + 7 + 3


def run_of(text: str) -> int:
    return len(text) - len(text.rstrip(text[-1]))


@settings(max_examples=500)
@given(standard, payload, st.booleans())
def test_standard_frames(identifier: int, data: bytes, remote: bool) -> None:
    flags = CAN_RTR_FLAG if remote else 0
    assert frame_bits(pack(identifier | flags, data)) == reference(identifier, data, False, remote)


@given(st.integers(0, 0x1FFFFFFF), payload, st.booleans())
def test_extended_frames(identifier: int, data: bytes, remote: bool) -> None:
    flags = CAN_EFF_FLAG | (CAN_RTR_FLAG if remote else 0)
    assert frame_bits(pack(identifier | flags, data)) == reference(identifier, data, True, remote)


@given(standard, payload)
def test_between_the_bounds_of_davis_and_burns(identifier: int, data: bytes) -> None:
    assert 47 + 8 * len(data) <= frame_bits(pack(identifier, data)) <= worst_case_bits(len(data))


def test_a_frame_worked_out_by_hand() -> None:
    # An NMT frame without data is all zeros, its CRC too: every fifth of the 34 zeros is followed by a stuff bit.
    assert frame_bits(pack(0x000, b"")) == 47 + 34 // 5


def test_bytes_behind_the_length_do_not_count() -> None:
    frame = bytearray(pack(0x181, b"\x27\x06"))
    frame[12:] = b"\xff\x00\xff\x00"
    assert frame_bits(bytes(frame)) == frame_bits(pack(0x181, b"\x27\x06"))
