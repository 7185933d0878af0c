"""Frames as they are written in the standards: hexadecimal, the identifier first, then the data bytes."""

from __future__ import annotations

import pytest


class Wire:
    """A simulated drive, node 5, on a wire. "605 40 00 10 00 00 00 00 00" is a frame with identifier 605h."""

    def __init__(self, bench) -> None:
        self.bench = bench
        self.axis = bench.axis

    def send(self, *frames: str) -> list[str]:
        """Give the drive frames, in order; what it says."""
        heard = []
        for frame in frames:
            can_id, _, data = frame.partition(" ")
            heard += self.bench.send(int(can_id, 16), bytes.fromhex(data))
        return _written(heard)

    def sync(self) -> list[str]:
        return self.send("080")

    def wait(self, ms: int) -> list[str]:
        return _written(self.bench.wait(ms))

    def sdo(self, request: str) -> str:
        """Answer to a request of the client, "" for none; nothing else may be said."""
        heard = self.send(f"605 {request}")
        if not heard:
            return ""
        (answer,) = (frame for frame in heard if frame.startswith("585 "))
        return answer[4:]

    def set(self, *requests: str) -> None:
        """Download; all must be accepted."""
        for request in requests:
            assert self.sdo(request) == f"60 {request[3:11]} 00 00 00 00", request

    def statusword(self) -> int:
        answer = bytes.fromhex(self.sdo("40 41 60 00 00 00 00 00"))
        assert answer[:4] == bytes.fromhex("4b 41 60 00")
        return answer[4] | answer[5] << 8

    def control(self, *words: int) -> None:
        """Write the controlword by SDO."""
        for word in words:
            self.set(f"2b 40 60 00 {word & 0xFF:02x} {word >> 8:02x} 00 00")

    def enable(self, mode: int = 8) -> None:
        """NMT start, RPDO2 valid, mode 8 or 10, Operation Enabled."""
        self.set("23 01 14 01 05 03 00 00")
        self.send("000 01 05")
        self.set(f"2f 60 60 00 {mode:02x} 00 00 00")
        self.control(0x06, 0x07, 0x0F)
        assert self.statusword() & 0x6F == 0x27

    def move(self) -> None:
        """Have the axis at a speed from which it does not stop within two ticks."""
        self.axis.velocity = 5.0e4
        self.wait(2)


def _written(frames: list[tuple[int, bytes]]) -> list[str]:
    return [f"{can_id:03x} {data.hex(' ')}".rstrip() for can_id, data in frames]


@pytest.fixture
def wire(bench) -> Wire:
    return Wire(bench)
