"""The other process of the transport tests: `python transport_peer.py ROLE BASE_PORT CLOCK`."""

from __future__ import annotations

import sys
import time

from schemas.base import Clock
from schemas.keys import Keys
from schemas.messages import Event
from schemas.topics import decode
from schemas.transport import TransportConfig, open_session

KEYS = Keys("test", "pendulum")
COUNT = 2000


def event(sequence: int) -> Event:
    return Event(
        sequence=sequence, time_ns=sequence, service="controller", kind="note", severity="info", text="x" * 1000
    )


def main(role: str, base_port: str, clock: str) -> None:
    with open_session("controller", KEYS, TransportConfig(base_port=int(base_port)), Clock(clock)) as transport:
        requests = transport.subscribe(KEYS.state)
        transport.join(["hal"], 20.0)
        if role == "burst":
            for k in range(COUNT):
                transport.publish(KEYS.command, event(k))
            transport.publish(KEYS.event, event(COUNT))
        elif role == "echo":
            while (data := requests.receive(10.0)) is not None:
                transport.publish(KEYS.command, decode(Event, data))
        elif role == "wait":
            time.sleep(30.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
