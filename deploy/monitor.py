"""Talk with a running session from outside its services: hear statistics and events, ask for a stop."""

from __future__ import annotations

import os
import time

from deploy.errors import DeployError
from deploy.progress import Observation
from deploy.session import RunningSession
from schemas.base import Clock
from schemas.keys import Keys
from schemas.load import Run
from schemas.messages import CycleStatistics, Event, OperatorRequest
from schemas.service import ServiceOptions
from schemas.topics import decode
from schemas.transport import CONFIG_VARIABLE, TransportConfig, open_service, open_session

LAUNCHER = "launcher"
APPEAR_SECONDS = 2.0
ANSWER_SECONDS = 1.0


class RunMonitor:
    """The launcher's ear: subscribes to health and events only, so that it costs the cycle nothing."""

    def __init__(self, run: Run, options: ServiceOptions) -> None:
        self._keys = Keys(run.scenario.namespace, run.robot.description.name)
        self._period_ns = run.robot.description.period_ns
        self._transport = open_service(LAUNCHER, run, options)
        self._health = self._transport.subscribe(self._keys.health)
        self._events = self._transport.subscribe(self._keys.event)

    def poll(self) -> list[Observation]:
        """All that has arrived, oldest first; never waits."""
        heard: list[Observation] = []
        while (data := self._events.receive(0.0)) is not None:
            heard.append(decode(Event, data))
        while (data := self._health.receive(0.0)) is not None:
            heard.append(decode(CycleStatistics, data))
        return heard

    def warn(self, sequence: int, kind: str, text: str) -> None:
        """Publish a warning in the launcher's name."""
        event = Event(
            sequence=sequence,
            time_ns=sequence * self._period_ns,
            service=LAUNCHER,
            kind=kind,
            severity="warning",
            text=text,
        )
        self._transport.publish(self._keys.event, event)

    def close(self) -> None:
        """Leave the run."""
        self._transport.close()


def send_request(session: RunningSession, request: OperatorRequest) -> str:
    """Send an operator's request to the HAL and wait for its event; returns that in words.

    Raises:
        DeployError: the HAL is not there, or does not answer.

    """
    keys = Keys(session.namespace, session.robot)
    config = TransportConfig(base_port=session.base_port, zenoh_file=os.environ.get(CONFIG_VARIABLE))
    with open_session("operator", keys, config, Clock.LOCKSTEP) as transport:
        events = transport.subscribe(keys.event)
        transport.wait_for_peers(["hal"], APPEAR_SECONDS)
        transport.publish(keys.operator, request)
        deadline = time.monotonic() + ANSWER_SECONDS
        while (left := deadline - time.monotonic()) > 0.0:
            data = events.receive(left)
            if data is None:
                continue
            event = decode(Event, data)
            if event.service == "hal":
                return f"{event.kind}: {event.text}"
    raise DeployError(f"the HAL of {session.scenario} did not answer the {request.action} within {ANSWER_SECONDS:g} s")
