"""Robot descriptions for drives of other makers, and a loop that runs the HAL's cycle with them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hal.boot import BootReport, boot_network
from hal.bus.ports import DirectPort
from hal.master import Master
from hal.profile.frames import pack, unpack
from schemas.base import ControlMode
from schemas.messages import JointCommand, RobotState
from schemas.robot import Bus, Drive, Joint, RobotDescription
from tests.hal.foreign_device import ForeignSlave
from tests.hal.foreign_objects import Habits

NODES = (1, 2, 3)


def foreign_robot(
    nodes: Sequence[int],
    kind: str = "torque",
    *,
    buses: tuple[Bus, ...] = (Bus(name="right", channel="right"),),
    vendor_id: int = 0x1234,
    product_code: int = 7,
    **changes: Any,
) -> RobotDescription:
    """A robot with a joint for each node, dealt over the buses in turn."""
    joints = [
        Joint(
            name=f"joint{node}",
            gear_ratio=100.0,
            rotor_inertia=1e-5,
            torque_limit=60.0,
            torque_rate_limit=20000.0,
            velocity_limit=3.0,
            position_min=-1.0,
            position_max=2.0,
            encoder_counts=4096,
            drive=Drive(
                kind=kind,
                bus=buses[index % len(buses)].name,
                node_id=node,
                rated_motor_torque=0.5,
                position_gain=2000.0,
                velocity_gain=20.0,
                vendor_id=vendor_id,
                product_code=product_code,
            ),
        )
        for index, node in enumerate(nodes)
    ]
    fields: dict[str, Any] = {"rate_hz": 200.0, "compute_budget_s": 0.001} | changes
    return RobotDescription(name="foreign", urdf="none", buses=buses, joints=tuple(joints), **fields)


class Wire(DirectPort):
    """Slaves wired to a port without a bus. Their time passes while somebody waits, so a slow machine does no harm."""

    STEP_S = 0.001
    """Time that passes when somebody looks."""
    IDLE_S = 0.01
    """Time that passes whenever nothing has come."""

    def __init__(self, slaves: Sequence[ForeignSlave], name: str = "right") -> None:
        super().__init__(name, self.answer)
        self.slaves = list(slaves)
        self.now = 0.0
        """The slaves' time [s]."""
        self.unplugged: set[int] = set()
        self.sent: list[tuple[int, bytes]] = []
        """What the HAL sent."""

    def receive(self, timeout_s: float) -> bytes:
        """All that waits; while nothing does, time passes."""
        deadline = time.monotonic() + timeout_s
        self.now += self.STEP_S
        while True:
            self._waiting += _packed(slave.tick(self.now) for slave in self._powered())
            if self._waiting or time.monotonic() >= deadline:
                return super().receive(timeout_s)
            time.sleep(0.0005)
            self.now += self.IDLE_S

    def answer(self, frames: bytes) -> bytes:
        """What the slaves say to frames of the HAL."""
        answers = []
        for can_id, data in unpack(frames):
            self.sent.append((can_id, data))
            answers += [slave.receive(can_id, data, self.now) for slave in self._powered()]
        return _packed(answers)

    def intercept(self, deliver: Callable[[bytes], bytes]) -> None:
        """Put something between the HAL and the slaves."""
        self._deliver = deliver

    def _powered(self) -> list[ForeignSlave]:
        return [slave for slave in self.slaves if slave.node not in self.unplugged]


def _packed(answers: Any) -> bytes:
    return b"".join(pack(can_id, data) for frames in answers for can_id, data in frames)


def wire(*habits: Habits) -> Wire:
    """Slaves 1, 2, … with these habits."""
    return Wire([ForeignSlave(node, each) for node, each in enumerate(habits, 1)])


def boot(bus: Wire, kind: str = "torque", timeout_s: float = 2.0, **identity: int) -> BootReport:
    """Boot the slaves of a wire as drives of one kind."""
    robot = foreign_robot([slave.node for slave in bus.slaves], kind, **identity)  # type: ignore[arg-type]  # by name
    return boot_network(robot, [bus], timeout_s)


class Cycle:
    """The HAL's cycle with a controller that asks for one position, or one torque, of all joints."""

    def __init__(self, master: Master, robot: RobotDescription, timeout_s: float = 0.5) -> None:
        self.master, self.robot = master, robot
        self.timeout_s = timeout_s
        self.sequence = 0
        self.events: list[Any] = []

    def run(
        self,
        cycles: int,
        *,
        position: Sequence[float] | None = None,
        torque: Sequence[float] | None = None,
        until: Callable[[RobotState], bool] = lambda state: False,
    ) -> RobotState:
        """Run cycles until one fulfils a condition; the last state."""
        for _ in range(cycles):
            self.master.sync(self.sequence)
            state = self.master.gather(self.sequence, self.timeout_s)
            self.master.apply(self._command(position, torque))
            self.events += self.master.core.drain_events()
            self.sequence += 1
            if until(state):
                break
        return state

    def hold(self, cycles: int) -> RobotState:
        """Run cycles without commands."""
        return self.run(cycles)

    def kinds(self, severity: str = "error") -> list[str]:
        """Kinds of the events so far."""
        return [event.kind for event in self.events if event.severity == severity]

    def text(self) -> str:
        """Texts of all events so far."""
        return "\n".join(event.text for event in self.events)

    def _command(self, position: Sequence[float] | None, torque: Sequence[float] | None) -> JointCommand | None:
        if position is None and torque is None:
            return None
        return JointCommand(
            sequence=self.sequence,
            time_ns=self.sequence * self.robot.period_ns,
            session="test",
            mode=ControlMode.POSITION if torque is None else ControlMode.TORQUE,
            position=None if position is None else tuple(np.asarray(position, dtype=float).tolist()),
            torque=None if torque is None else tuple(np.asarray(torque, dtype=float).tolist()),
        )
