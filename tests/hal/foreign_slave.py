"""A process that runs drives of another maker on a bus.

python -m tests.hal.foreign_slave --interface socketcan --channel vcan0 --nodes 1,2,3
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import yaml

from tests.hal.foreign_device import ForeignSlave, Frame
from tests.hal.foreign_objects import Habits, lely_like


class SlaveHost:
    """Runs slaves on a python-can bus until it is told to stop."""

    def __init__(self, bus: can.BusABC, slaves: Sequence[ForeignSlave]) -> None:
        self._bus = bus
        self._slaves = slaves
        self._stop = threading.Event()
        self.unplugged: set[int] = set()
        """Nodes without power."""

    def run(self) -> None:
        """Serve the slaves."""
        while not self._stop.is_set():
            message = self._bus.recv(0.002)
            while message is not None:
                data_frame = not (message.is_error_frame or message.is_remote_frame or message.is_extended_id)
                self._tell(message.arbitration_id, bytes(message.data)) if data_frame else None
                message = self._bus.recv(0.0)
            for slave in self._slaves:
                if slave.node not in self.unplugged:
                    self._send(slave.tick(time.monotonic()))

    @contextmanager
    def running(self) -> Iterator[SlaveHost]:
        """Serve the slaves in a thread."""
        thread = threading.Thread(target=self.run, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            thread.join()
            self._bus.shutdown()

    def _tell(self, can_id: int, data: bytes) -> None:
        for slave in self._slaves:
            if slave.node not in self.unplugged:
                self._send(slave.receive(can_id, data, time.monotonic()))

    def _send(self, frames: list[Frame]) -> None:
        for can_id, data in frames:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def slaves_of_robot(path: Path, channel: str, habits: Habits) -> list[ForeignSlave]:
    """Build the drives of a robot description that sit on one bus, by its channel or name, each as described."""
    robot: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    names = {bus["name"] for bus in robot["buses"] if channel in (bus["channel"], bus["name"])}
    slaves = []
    for joint in robot["joints"]:
        drive = joint["drive"]
        if drive["bus"] in names:
            identity = {key: drive.get(key, default) for key, default in (("vendor_id", 0x402), ("product_code", 1))}
            slaves.append(ForeignSlave(drive["node_id"], replace(habits, **identity), time.monotonic()))
    return slaves


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve slaves on a bus until the process is ended."""
    parser = argparse.ArgumentParser(prog="python -m tests.hal.foreign_slave", description=__doc__)
    parser.add_argument("--interface", default="socketcan", help="of python-can (default: %(default)s)")
    parser.add_argument("--channel", required=True, help="e.g. vcan0")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--nodes", help="node ids, e.g. 1,2,3")
    which.add_argument("--robot", type=Path, help="YAML file: all drives of the bus with this channel or name")
    parser.add_argument("--bus", help="the bus in the robot's file where the channel there is another")
    parser.add_argument(
        "--lely", action="store_true", help="have the habits of a generic stack instead of a friendly's"
    )
    options = parser.parse_args(arguments)
    habits = lely_like() if options.lely else Habits()
    if options.robot:
        slaves = slaves_of_robot(options.robot, options.bus or options.channel, habits)
    else:
        slaves = [ForeignSlave(int(node), habits, time.monotonic()) for node in options.nodes.split(",")]
    if not slaves:
        parser.error(f"no drive on bus {options.bus or options.channel} in {options.robot}")
    host = SlaveHost(can.Bus(interface=options.interface, channel=options.channel), slaves)
    print(f"nodes {', '.join(str(slave.node) for slave in slaves)} on {options.channel}", flush=True)
    host.run()


if __name__ == "__main__":
    main()
