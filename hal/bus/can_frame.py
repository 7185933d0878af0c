"""Between python-can's messages and the kernel's `struct can_frame`."""

from __future__ import annotations

from collections.abc import Iterator

import can

from hal.profile.frames import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK, FRAME_BYTES

_FLAGS_END = 4
_LENGTH = 4
_DATA = 8


def encode(message: can.Message) -> bytes:
    """Pack a classic CAN message as one frame of 16 bytes; remote frames keep their requested length.

    Raises:
        ValueError: a CAN FD message, or data longer than 8 bytes.

    """
    if message.is_fd or message.dlc > 8:
        raise ValueError(f"frame 0x{message.arbitration_id:X}: classic CAN carries at most 8 bytes and no CAN FD")
    identifier = message.arbitration_id
    if message.is_extended_id:
        identifier |= CAN_EFF_FLAG
    if message.is_remote_frame:
        identifier |= CAN_RTR_FLAG
    if message.is_error_frame:
        identifier |= CAN_ERR_FLAG
    head = identifier.to_bytes(_FLAGS_END, "little") + bytes((message.dlc, 0, 0, 0))
    return head + bytes(message.data).ljust(FRAME_BYTES - _DATA, b"\0")


def decode(frame: bytes, timestamp: float = 0.0, channel: str | None = None) -> can.Message:
    """Unpack one frame of 16 bytes, stamped with `timestamp` [s]."""
    identifier = int.from_bytes(frame[:_FLAGS_END], "little")
    length = frame[_LENGTH]
    extended = bool(identifier & CAN_EFF_FLAG)
    remote = bool(identifier & CAN_RTR_FLAG)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=identifier & (CAN_EFF_MASK if extended else CAN_SFF_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(identifier & CAN_ERR_FLAG),
        channel=channel,
        dlc=length,
        data=None if remote else frame[_DATA : _DATA + length],
    )


def split(frames: bytes) -> Iterator[bytes]:
    """Cut a packet into its frames of 16 bytes."""
    return (frames[start : start + FRAME_BYTES] for start in range(0, len(frames), FRAME_BYTES))
