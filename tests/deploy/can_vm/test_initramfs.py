from __future__ import annotations

from deploy.can_vm.initramfs import archive, character_device, file

EMPTY_TRAILER = (
    b"070701" + b"00000000" * 4 + b"00000001" + b"00000000" * 6 + b"0000000B" + b"00000000" + b"TRAILER!!!\0" + bytes(3)
)


def test_an_empty_archive_is_the_trailer() -> None:
    assert archive([]) == EMPTY_TRAILER


def test_a_file_is_laid_out_as_newc_says() -> None:
    packed = archive([file("ab", b"xyz", executable=True)])
    header = b"070701" + b"00000001" + b"000081ED" + b"00000000" * 2 + b"00000001" + b"00000000" + b"00000003"
    header += b"00000000" * 4 + b"00000003" + b"00000000"
    assert packed == header + b"ab\0" + bytes(3) + b"xyz\0" + EMPTY_TRAILER


def test_members_begin_at_multiples_of_four() -> None:
    names = ["a", "bc", "def", "ghij"]
    packed = archive([file(name, b"z" * length) for length, name in enumerate(names)])
    starts = [index for index in range(len(packed)) if packed.startswith(b"070701", index)]
    assert len(starts) == len(names) + 1
    assert all(start % 4 == 0 for start in starts)


def test_a_device_carries_its_numbers() -> None:
    packed = archive([character_device("dev/console", 5, 1)])
    assert packed[6 + 8 * 9 : 6 + 8 * 11] == b"00000005" + b"00000001"
