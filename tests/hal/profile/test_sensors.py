from __future__ import annotations

import pytest

from hal.errors import ProfileError
from hal.profile import sensors


def test_force_torque_golden_bytes() -> None:
    # Fx 1 N = 50 counts, Fy −1 N, Fz 10 N, Tx 0.5 N·m = 1000 counts, Ty −0.5 N·m, Tz 0.
    first, second = sensors.encode_force_torque((1.0, -1.0, 10.0), (0.5, -0.5, 0.0), 1 / 50, 1 / 2000)
    assert first == bytes.fromhex("0b 00 32 ff ce 01 f4 03")
    assert second == bytes.fromhex("e8 fc 18 00 00 00 00 00")
    force, torque = sensors.decode_force_torque(first, second, 1 / 50, 1 / 2000)
    assert force == pytest.approx((1.0, -1.0, 10.0))
    assert torque == pytest.approx((0.5, -0.5, 0.0))


def test_force_torque_saturates() -> None:
    first, _ = sensors.encode_force_torque((1e6, -1e6, 0.0), (0.0, 0.0, 0.0), 1 / 50, 1 / 2000)
    assert first == bytes.fromhex("0b 7f ff 80 01 00 00 00")


def test_force_torque_commands() -> None:
    assert sensors.force_torque_command(True) == bytes.fromhex("0b00000000000000")
    assert sensors.force_torque_command(False) == bytes.fromhex("0c00000000000000")


@pytest.mark.parametrize(("first", "second"), [(b"\x0b" * 7, b"\0" * 8), (b"\x0c" * 8, b"\0" * 8), (b"\x0b" * 8, b"")])
def test_other_data_is_no_wrench(first: bytes, second: bytes) -> None:
    with pytest.raises(ProfileError, match="force/torque"):
        sensors.decode_force_torque(first, second, 0.02, 0.0005)


def test_inertial_golden_bytes() -> None:
    assert sensors.encode_gyro((1.0, -1.0, 0.5)) == bytes.fromhex("02 00 fe 00 01 00")
    assert sensors.encode_acceleration((0.0, 0.0, 9.8125)) == bytes.fromhex("00 00 00 00 09 d0")
    assert sensors.encode_quaternion((1.0, 0.0, 0.0, -1.0)) == bytes.fromhex("7f ff 00 00 00 00 80 01")
    assert sensors.decode_gyro(bytes.fromhex("0200fe000100")) == (1.0, -1.0, 0.5)
    assert sensors.decode_acceleration(bytes.fromhex("0000000009d0")) == (0.0, 0.0, 9.8125)


def test_quaternions_come_back_normalised() -> None:
    orientation = (0.5, -0.5, 0.5, 0.5)
    decoded = sensors.decode_quaternion(sensors.encode_quaternion(orientation))
    assert decoded == pytest.approx(orientation, abs=3e-5)
    assert sum(part * part for part in decoded) == pytest.approx(1.0, abs=1e-12)


def test_wrong_inertial_data_is_refused() -> None:
    with pytest.raises(ProfileError, match="gyro"):
        sensors.decode_gyro(b"\0" * 5)
    with pytest.raises(ProfileError, match="acceleration"):
        sensors.decode_acceleration(b"\0" * 8)
    with pytest.raises(ProfileError, match="8 bytes"):
        sensors.decode_quaternion(b"\0" * 7)
    with pytest.raises(ProfileError, match="no rotation"):
        sensors.decode_quaternion(b"\0" * 8)
