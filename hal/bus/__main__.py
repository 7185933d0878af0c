"""Host bare virtual buses: `python -m hal.bus CHANNEL...`, until Ctrl-C or SIGTERM."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence

from hal.bus.hub import HubGroup, open_hubs
from schemas.errors import CosimError


def main(arguments: Sequence[str] | None = None) -> int:
    """Host the channels named on the command line; 0 when stopped by a signal, 1 when one cannot be hosted."""
    parser = argparse.ArgumentParser(
        prog="python -m hal.bus",
        description="Host virtual CAN buses without a plant.",
        epilog="example: python -m hal.bus bus0 /tmp/bus1 & python -m can.viewer -i cosim -c bus0",
    )
    parser.add_argument("channel", nargs="+", help="socket path, or a bare name in the run directory")
    channels = parser.parse_args(arguments).channel
    try:
        group = HubGroup(open_hubs(channels))
    except CosimError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True
        group.interrupt()

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with group:
            for hub in group.hubs:
                print(f"bus {hub.path}", flush=True)
            while not stopped:
                group.wait(None)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return 0


if __name__ == "__main__":
    sys.exit(main())
