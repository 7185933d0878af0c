import pytest

from hal.errors import ProfileError
from hal.profile.frames import CAN_EFF_FLAG, FRAME, pack, unpack, view

GOLDEN = bytes.fromhex("82 01 00 00 03 00 00 00 aa bb cc 00 00 00 00 00")


def test_pack_is_struct_can_frame() -> None:
    assert pack(0x182, b"\xaa\xbb\xcc") == GOLDEN


def test_unpack_yields_identifier_and_data() -> None:
    assert list(unpack(GOLDEN + pack(CAN_EFF_FLAG | 0x12345, b""))) == [(0x182, b"\xaa\xbb\xcc"), (0x80012345, b"")]


def test_view_reads_the_same_fields() -> None:
    frames = view(GOLDEN)
    assert FRAME.itemsize == 16
    assert (frames["can_id"][0], frames["length"][0], frames["data"][0].tobytes()) == (
        0x182,
        3,
        b"\xaa\xbb\xcc" + b"\0" * 5,
    )


def test_too_much_data_and_broken_buffers_are_refused() -> None:
    with pytest.raises(ProfileError, match="at most 8"):
        pack(1, b"123456789")
    with pytest.raises(ProfileError, match="whole number"):
        list(unpack(GOLDEN[:-1]))
    with pytest.raises(ProfileError, match="whole number"):
        view(GOLDEN[:-1])
    with pytest.raises(ProfileError, match="length 9"):
        list(unpack(GOLDEN[:4] + b"\x09" + GOLDEN[5:]))
