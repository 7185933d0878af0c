"""The controller as a process: a state in, a command and its trace out."""

from __future__ import annotations

import time

from controller_service.controller import Controller
from schemas.base import Clock
from schemas.lifecycle import Lifecycle
from schemas.load import Run
from schemas.messages import RobotState
from schemas.service import ServiceOptions
from schemas.statistics import CycleMeter
from schemas.topics import decode
from schemas.transport import open_service

LOOK_UP_S = 0.1
"""How often signals and peers are looked at while no state comes."""


def run_controller(run: Run, options: ServiceOptions) -> int:
    """Answer every state until the HAL leaves or a signal comes; returns the exit code.

    Raises:
        PeerLostError: the HAL vanished.
        CosimError: what the controller refuses; the HAL then stops the robot by itself.

    """
    controller = Controller(run, options.session)
    meter = CycleMeter("controller", run.robot.description.period_s)
    transport = open_service("controller", run, options)
    keys = transport.keys
    with Lifecycle(transport, needed=("hal",)) as life:
        states = transport.subscribe(keys.state, newest=run.scenario.clock is Clock.REALTIME)
        for key in (keys.command, keys.trace):
            transport.declare_publisher(key)
        life.join(options.peers)
        while life.signalled is None and not life.finished("hal"):
            data = states.receive(LOOK_UP_S)
            life.check_peers()
            while data is not None:
                begun = time.perf_counter()
                state = decode(RobotState, data)
                life.stamp(state.sequence, state.time_ns)
                command, trace = controller.step(state)
                transport.publish(keys.command, command)
                transport.publish(keys.trace, trace)
                for event in controller.drain_events():
                    life.publish(keys.event, event)
                ended = time.perf_counter()
                meter.cycle(ended - begun)
                if (summary := meter.report(state.sequence, state.time_ns, ended)) is not None:
                    transport.publish(keys.health, summary)
                data = None if life.signalled is not None else states.receive(LOOK_UP_S)
    return 0
