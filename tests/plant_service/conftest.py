"""A bench for one simulated drive: a rigid axis with a real integrator, and the words of a master."""

from __future__ import annotations

import struct

import pytest

from hal.profile.frames import unpack
from plant_service.axis import AxisGains
from plant_service.device import DriveDevice

MS = 1_000_000
NODE = 5


class RigidAxis:
    """One rigid body of inertia J under a motor: counts'' = torque / J, semi-implicit Euler. A brake stops it."""

    COUNTS_PER_MILLE = 2.0e4
    """Acceleration [counts/s²] of 1 ‰."""
    STIFFNESS, DAMPING = 1.0e4, 200.0
    """Of the position loop, [1/s²], [1/s]."""

    def __init__(self) -> None:
        self.position, self.velocity = 0.0, 0.0
        self.motion = "off"
        self.target, self.limit = 0.0, 0
        self.gains: list[AxisGains] = []
        self._torque = 0.0

    def position_counts(self) -> int:
        return round(self.position)

    def torque_per_mille(self) -> int:
        return round(self._torque)

    def power_off(self) -> None:
        self.motion = "off"

    def follow_position(self, target_counts: int, max_torque_per_mille: int) -> None:
        self.motion, self.target, self.limit = "position", target_counts, max_torque_per_mille

    def follow_torque(self, per_mille: int, max_torque_per_mille: int) -> None:
        self.motion, self.target, self.limit = "torque", per_mille, max_torque_per_mille

    def hold(self) -> None:
        self.motion, self.target, self.limit = "hold", self.position, 1000

    def configure(self, gains: AxisGains) -> None:
        self.gains.append(gains)

    def integrate(self, seconds: float) -> None:
        if self.motion == "off":
            self.velocity = self._torque = 0.0
            return
        if self.motion == "torque":
            wanted = float(self.target)
        else:
            acceleration = self.STIFFNESS * (self.target - self.position) - self.DAMPING * self.velocity
            wanted = acceleration / self.COUNTS_PER_MILLE
        self._torque = max(-self.limit, min(self.limit, wanted))
        self.velocity += self._torque * self.COUNTS_PER_MILLE * seconds
        self.position += self.velocity * seconds


class Bench:
    """The drive of node 5, its axis and a clock in ms."""

    def __init__(self) -> None:
        self.axis = RigidAxis()
        self.device = DriveDevice(NODE, self.axis)
        self.now_ns = 0
        self.said: list[tuple[int, bytes]] = []
        """Everything the device sent, in order."""
        self.send(0x7E5, b"")  # a frame that is not for it: the boot-up message comes out

    def send(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        return self._heard(self.device.receive(can_id, data, self.now_ns))

    def sync(self) -> list[tuple[int, bytes]]:
        return self.send(0x080, b"")

    def wait(self, ms: int) -> list[tuple[int, bytes]]:
        heard = []
        for _ in range(ms):
            self.axis.integrate(1e-3)
            self.now_ns += MS
            heard += self._heard(self.device.tick(self.now_ns))
        return heard

    def sdo(self, request: str) -> str:
        """Answer to a request, both in hexadecimal with spaces."""
        answers = [data for can_id, data in self.send(0x605, bytes.fromhex(request)) if can_id == 0x585]
        assert len(answers) <= 1
        return answers[0].hex(" ") if answers else ""

    def write(self, index: int, subindex: int, value: int, size: int) -> int:
        """Expedited download. Returns the abort code, 0 when accepted."""
        command = 0x23 | (4 - size) << 2
        request = struct.pack("<BHB", command, index, subindex) + value.to_bytes(4, "little", signed=value < 0)
        answer = bytes.fromhex(self.sdo(request.hex()))
        return 0 if answer[0] == 0x60 else int.from_bytes(answer[4:], "little")

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        answer = bytes.fromhex(self.sdo(struct.pack("<BHBI", 0x40, index, subindex, 0).hex()))
        assert answer[0] & 0xE3 == 0x43, answer.hex(" ")
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    def enable(self, mode: int = 8) -> None:
        """NMT start, both RPDOs valid, mode and Operation Enabled by SDO."""
        assert self.write(0x1401, 1, 0x305, 4) == 0
        assert self.write(0x1006, 0, 1000, 4) == 0
        self.send(0x000, bytes([0x01, NODE]))
        assert self.write(0x6060, 0, mode, 1) == 0
        for word in (0x06, 0x07, 0x0F):
            assert self.write(0x6040, 0, word, 2) == 0
        assert self.status & 0x6F == 0x27

    def command_position(self, counts: int, word: int = 0x0F, mode: int = 8) -> None:
        self.send(0x205, struct.pack("<Hbi", word, mode, counts))

    def command_torque(self, per_mille: int, word: int = 0x0F, mode: int = 10) -> None:
        self.send(0x305, struct.pack("<Hbh", word, mode, per_mille))

    @property
    def status(self) -> int:
        return self.read(0x6041)

    def _heard(self, packed: list[bytes]) -> list[tuple[int, bytes]]:
        heard = list(unpack(b"".join(packed)))
        self.said += heard
        return heard


@pytest.fixture
def bench() -> Bench:
    return Bench()
