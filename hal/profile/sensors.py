"""Frames of the sensors, encoder and decoder side by side: Robotous RFT force/torque, Xsens MTi-600 inertial unit.

All integers are big-endian. Encoders saturate; decoders raise on a wrong length or mark.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

from hal.errors import ProfileError
from schemas.base import Quaternion, Vector3

FORCE_TORQUE_START: Final = 0x0B
"""Command byte "start output", and first byte of every reply."""
FORCE_TORQUE_STOP: Final = 0x0C

GYRO_ID: Final = 0x032
ACCELERATION_ID: Final = 0x034
QUATERNION_ID: Final = 0x021

GYRO_RESOLUTION: Final = 2.0**-9
"""[rad/s] a count."""
ACCELERATION_RESOLUTION: Final = 2.0**-8
"""[m/s²] a count."""
QUATERNION_RESOLUTION: Final = 1.0 / 32767.0

_FORCE_TORQUE: Final = struct.Struct(">B6h3x")
_TRIPLE: Final = struct.Struct(">3h")
_QUADRUPLE: Final = struct.Struct(">4h")
_INT16_MAX: Final = 32767


def force_torque_command(start: bool) -> bytes:
    """Build the data of the frame that starts or stops a force/torque sensor's output: command byte and 7 zeros."""
    return bytes((FORCE_TORQUE_START if start else FORCE_TORQUE_STOP, 0, 0, 0, 0, 0, 0, 0))


def encode_force_torque(
    force: Vector3, torque: Vector3, force_resolution: float, torque_resolution: float
) -> tuple[bytes, bytes]:
    """Encode the two data fields, at `can_id` and `can_id + 1`: 0x0B, Fx Fy Fz Tx Ty Tz, overload flag, two zeros.

    Args:
        force: [N] in the sensor's frame.
        torque: [N·m] in the sensor's frame.
        force_resolution: [N] a count.
        torque_resolution: [N·m] a count.
    """
    counts = _counts(force, force_resolution), _counts(torque, torque_resolution)
    data = _FORCE_TORQUE.pack(FORCE_TORQUE_START, *counts[0], *counts[1])
    return data[:8], data[8:]


def decode_force_torque(
    first: bytes, second: bytes, force_resolution: float, torque_resolution: float
) -> tuple[Vector3, Vector3]:
    """Force [N] and torque [N·m] of a sensor's two data fields.

    Raises:
        ProfileError: a field is not 8 bytes long, or the first does not begin with 0x0B.
    """
    if len(first) != 8 or len(second) != 8 or first[0] != FORCE_TORQUE_START:
        raise ProfileError(
            f"force/torque frames {first.hex(' ')} | {second.hex(' ')}: must be 8 + 8 bytes that begin with 0b"
        )
    _, fx, fy, fz, tx, ty, tz = _FORCE_TORQUE.unpack(first + second)
    f, t = force_resolution, torque_resolution
    return (fx * f, fy * f, fz * f), (tx * t, ty * t, tz * t)


def encode_gyro(angular_velocity: Vector3) -> bytes:
    """Encode the gyro frame, [rad/s] in the sensor's frame."""
    return _TRIPLE.pack(*_counts(angular_velocity, GYRO_RESOLUTION))


def decode_gyro(data: bytes) -> Vector3:
    """Angular velocity [rad/s] in the sensor's frame.

    Raises:
        ProfileError: not 6 bytes.
    """
    return _triple(data, GYRO_RESOLUTION, "gyro")


def encode_acceleration(acceleration: Vector3) -> bytes:
    """Encode the acceleration frame: specific force [m/s²] in the sensor's frame."""
    return _TRIPLE.pack(*_counts(acceleration, ACCELERATION_RESOLUTION))


def decode_acceleration(data: bytes) -> Vector3:
    """Specific force [m/s²] in the sensor's frame.

    Raises:
        ProfileError: not 6 bytes.
    """
    return _triple(data, ACCELERATION_RESOLUTION, "acceleration")


def encode_quaternion(orientation: Quaternion) -> bytes:
    """Encode the orientation frame, sensor to world, scalar first."""
    return _QUADRUPLE.pack(*_counts(orientation, QUATERNION_RESOLUTION))


def decode_quaternion(data: bytes) -> Quaternion:
    """Orientation sensor to world, scalar first, normalised: the bus's 16 bits leave a norm off by up to 3e-5.

    Raises:
        ProfileError: not 8 bytes, or all zero.
    """
    if len(data) != 8:
        raise ProfileError(f"orientation frame {data.hex(' ')}: must be 8 bytes")
    w, x, y, z = _QUADRUPLE.unpack(data)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm == 0.0:
        raise ProfileError("orientation frame is all zero, which is no rotation")
    return w / norm, x / norm, y / norm, z / norm


def _triple(data: bytes, resolution: float, what: str) -> Vector3:
    if len(data) != 6:
        raise ProfileError(f"{what} frame {data.hex(' ')}: must be 6 bytes")
    x, y, z = _TRIPLE.unpack(data)
    return x * resolution, y * resolution, z * resolution


def _counts(values: Sequence[float], resolution: float) -> list[int]:
    counts = [round(value / resolution) for value in values]
    if max(counts) > _INT16_MAX or min(counts) < -_INT16_MAX:
        return [max(-_INT16_MAX, min(_INT16_MAX, count)) for count in counts]
    return counts
