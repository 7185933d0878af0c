"""The kernel's `struct can_frame` as bytes: the unit of every buffer that crosses a `FramePort`."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import ProfileError

FRAME_BYTES: Final = 16
FRAME_DATA: Final = 8
"""Data bytes at most."""
CAN_EFF_FLAG: Final = 0x80000000
"""29-bit identifier."""
CAN_RTR_FLAG: Final = 0x40000000
"""Remote request."""
CAN_ERR_FLAG: Final = 0x20000000
"""Error message of the controller, not a frame of the wire."""
CAN_SFF_MASK: Final = 0x7FF
CAN_EFF_MASK: Final = 0x1FFFFFFF

FRAME: Final = np.dtype(
    {
        "names": ["can_id", "length", "data"],
        "formats": ["<u4", "u1", ("u1", (8,))],
        "offsets": [0, 4, 8],
        "itemsize": FRAME_BYTES,
    }
)
"""`np.frombuffer(frames, FRAME)` views a buffer of frames: identifier with flags, data length, 8 data bytes."""

_WORD = np.dtype("<u4")
_STRUCT = struct.Struct("<IB3x8s")


def pack(can_id: int, data: bytes) -> bytes:
    """One frame of 16 bytes.

    Args:
        can_id: identifier with its flags (`CAN_EFF_FLAG`, …).
        data: at most 8 bytes.

    Raises:
        ProfileError: more than 8 data bytes.
    """
    if len(data) > 8:
        raise ProfileError(f"frame {can_id:#x}: {len(data)} data bytes, a CAN frame holds at most 8")
    return _STRUCT.pack(can_id, len(data), data)


def unpack(buffer: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield identifier (with flags) and data of each frame in a buffer, in order.

    Raises:
        ProfileError: the buffer is not a whole number of frames, or a frame claims more than 8 bytes.
    """
    if len(buffer) % FRAME_BYTES:
        raise ProfileError(f"a buffer of {len(buffer)} bytes is not a whole number of {FRAME_BYTES}-byte frames")
    for can_id, length, data in _STRUCT.iter_unpack(buffer):
        if length > 8:
            raise ProfileError(f"frame {can_id:#x}: length {length}, a CAN frame holds at most 8 bytes")
        yield can_id, data[:length]


def split(buffer: bytes) -> list[bytes]:
    """Cut a buffer into its frames.

    Raises:
        ProfileError: the buffer is not a whole number of frames, or a frame claims more than 8 bytes.
    """
    if len(buffer) % FRAME_BYTES:
        raise ProfileError(f"a buffer of {len(buffer)} bytes is not a whole number of {FRAME_BYTES}-byte frames")
    if buffer and max(buffer[4::FRAME_BYTES]) > FRAME_DATA:
        raise ProfileError(
            f"a frame claims {max(buffer[4::FRAME_BYTES])} bytes, a CAN frame holds at most {FRAME_DATA}"
        )
    return [buffer[start : start + FRAME_BYTES] for start in range(0, len(buffer), FRAME_BYTES)]


def can_ids(buffer: bytes) -> list[int]:
    """List the identifiers (with flags) of the frames in a buffer, in order.

    Raises:
        ProfileError: the buffer is not a whole number of frames.
    """
    if len(buffer) % FRAME_BYTES:
        raise ProfileError(f"a buffer of {len(buffer)} bytes is not a whole number of {FRAME_BYTES}-byte frames")
    ids: list[int] = np.frombuffer(buffer, _WORD)[:: FRAME_BYTES // 4].tolist()
    return ids


def view(buffer: bytes) -> npt.NDArray[np.void]:
    """Frames of a buffer as a read-only structured array of `FRAME`.

    Raises:
        ProfileError: the buffer is not a whole number of frames.
    """
    if len(buffer) % FRAME_BYTES:
        raise ProfileError(f"a buffer of {len(buffer)} bytes is not a whole number of {FRAME_BYTES}-byte frames")
    return np.frombuffer(buffer, FRAME)
