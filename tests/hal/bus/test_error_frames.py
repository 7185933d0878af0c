"""Error frames as `linux/can/error.h` lays them out: golden bytes."""

from __future__ import annotations

import pytest

from hal.bus.error_frames import ErrorReport, Trouble, decode_error, split_errors
from hal.errors import ProfileError
from hal.profile.frames import pack

GOLDEN = [
    # class bits, the 8 data bytes, what they mean
    (0x20000040, "0000000000000000", ErrorReport((Trouble.BUS_OFF,))),
    (0x20000100, "0000000000000000", ErrorReport((Trouble.RESTARTED,))),
    (0x20000204, "0008000000006000", ErrorReport((Trouble.ERROR_WARNING,), "", 96, 0)),
    (0x20000204, "0010000000000380", ErrorReport((Trouble.ERROR_PASSIVE,), "", 3, 128)),
    (0x20000004, "0020000000008000", ErrorReport((Trouble.ERROR_PASSIVE,), "", 128, 0)),
    (0x20000204, "0040000000000000", ErrorReport((Trouble.ERROR_ACTIVE,), "", 0, 0)),
    (0x20000004, "0001000000000000", ErrorReport((Trouble.RECEIVE_OVERFLOW,))),
    (0x20000004, "0002000000000000", ErrorReport((Trouble.TRANSMIT_OVERFLOW,))),
    (0x20000004, "0000000000000000", ErrorReport((Trouble.CONTROLLER,))),
    (0x20000020, "0000000000000000", ErrorReport((Trouble.NO_ACKNOWLEDGE,))),
    (0x20000001, "0000000000000000", ErrorReport((Trouble.TRANSMIT_TIMEOUT,))),
    (0x20000002, "0500000000000000", ErrorReport((Trouble.LOST_ARBITRATION,))),
    (
        0x20000088,
        "0000848A00000000",
        ErrorReport((Trouble.PROTOCOL, Trouble.BUS_ERROR), "bit stuffing, on transmission"),
    ),
    (0x20000008, "0000020800000000", ErrorReport((Trouble.PROTOCOL,), "frame format, in CRC sequence")),
    (0x20000010, "0000000004000000", ErrorReport((Trouble.TRANSCEIVER,), "CANH not connected")),
]


@pytest.mark.parametrize(("head", "data", "report"), GOLDEN)
def test_golden_frames(head: int, data: str, report: ErrorReport) -> None:
    assert decode_error(pack(head, bytes.fromhex(data))) == report


def test_several_troubles_in_one_frame_are_all_told() -> None:
    report = decode_error(pack(0x200000EC, bytes.fromhex("0020801900008003")))
    assert report.troubles == (
        Trouble.BUS_OFF,
        Trouble.NO_ACKNOWLEDGE,
        Trouble.PROTOCOL,
        Trouble.BUS_ERROR,
        Trouble.ERROR_PASSIVE,
    )
    assert str(report) == (
        "bus-off, no node acknowledges, protocol error, bus error, error-passive, on transmission, in ACK slot,"
        " TEC 128, REC 3"
    )


def test_only_error_frames_are_read() -> None:
    with pytest.raises(ProfileError, match="no error frame"):
        decode_error(pack(0x40, bytes(8)))
    with pytest.raises(ProfileError, match="32 bytes"):
        decode_error(bytes(32))


def test_a_packet_is_split_in_order() -> None:
    wire = [pack(0x181, b"\1"), pack(0x80000123, b""), pack(0x40000181, b"")]
    errors = [pack(0x20000040, bytes(8)), pack(0x20000100, bytes(8))]
    packet = wire[0] + errors[0] + wire[1] + wire[2] + errors[1]
    assert split_errors(packet) == (b"".join(wire), b"".join(errors))
    assert split_errors(wire[0]) == (wire[0], b"")
    assert split_errors(b"") == (b"", b"")
