"""SocketCAN: what a packet of frames costs through python-can's messages and through the raw socket."""

from __future__ import annotations

import sys
from collections.abc import Callable

import can

from benchmarks.measure import Timing, measure
from hal.bus.errors import BusUnavailableError
from hal.bus.ports import FramePort, PythonCanPort
from hal.bus.socketcan import open_socketcan
from hal.profile.frames import FRAME_BYTES, pack
from schemas.robot import Bus

FRAMES = b"".join(pack(0x181 + node, bytes(8)) for node in range(9))
"""As many frames as arm9 has drives."""
WAIT_S = 10.0


def kernel_ports(channel: str, n: int) -> list[Timing]:
    """Send and receive packets on a kernel interface within this process; nothing where there is no such interface."""
    bus = Bus(name="bench", interface="socketcan", channel=channel)
    count = len(FRAMES) // FRAME_BYTES
    kinds: dict[str, Callable[[], FramePort]] = {
        "python-can's messages": lambda: PythonCanPort("bench", can.Bus(interface="socketcan", channel=channel)),
        "the raw socket": lambda: open_socketcan(bus),
    }
    try:
        open_socketcan(bus).close()
    except BusUnavailableError:
        return []
    return [
        _timing(f"SocketCAN by {kind}, {count} frames out and in", (make(), make()), n) for kind, make in kinds.items()
    ]


def _timing(name: str, ports: tuple[FramePort, FramePort], n: int) -> Timing:
    near, far = ports

    def call() -> None:
        near.send(FRAMES)
        got = 0
        while got < len(FRAMES):
            got += len(far.receive(WAIT_S))

    try:
        return measure(name, call, n)
    finally:
        near.close()
        far.close()


def main() -> int:
    """Measure the interface named on the command line, or vcan0; 1 where there is none."""
    timings = kernel_ports(sys.argv[1] if len(sys.argv) > 1 else "vcan0", 500)
    for timing in timings:
        print(timing.figures())
    return 0 if timings else 1


if __name__ == "__main__":
    sys.exit(main())
