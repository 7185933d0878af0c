"""Zenoh key expressions, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one robot: `<namespace>/<robot>/<leaf>`."""

    namespace: str
    robot: str

    @property
    def root(self) -> str:
        """`<namespace>/<robot>`."""
        return f"{self.namespace}/{self.robot}"

    @property
    def state(self) -> str:
        """RobotState, written by the HAL."""
        return f"{self.root}/state"

    @property
    def command(self) -> str:
        """JointCommand, written by the controller."""
        return f"{self.root}/command"

    @property
    def trace(self) -> str:
        """ControllerTrace, written by the controller."""
        return f"{self.root}/trace"

    @property
    def truth(self) -> str:
        """PlantTruth, written by the plant."""
        return f"{self.root}/truth"

    @property
    def event(self) -> str:
        """Event, written by any service."""
        return f"{self.root}/event"

    @property
    def health(self) -> str:
        """CycleStatistics, written by any service."""
        return f"{self.root}/health"

    @property
    def operator(self) -> str:
        """OperatorRequest (stop, reset), written by `cosim stop`."""
        return f"{self.root}/operator"

    @property
    def everything(self) -> str:
        """All messages of the robot."""
        return f"{self.root}/**"

    def bus(self, name: str) -> str:
        """BusFrames of one bus, written by the HAL."""
        return f"{self.root}/bus/{name}"

    def load(self, name: str) -> str:
        """BusStatistics of one bus, written by the plant."""
        return f"{self.root}/load/{name}"

    def alive(self, service: str) -> str:
        """Liveliness token: the service runs and has declared its subscriptions."""
        return f"{self.root}/alive/{service}"

    def ready(self, service: str) -> str:
        """Liveliness token: the service sees all the peers it expects."""
        return f"{self.root}/ready/{service}"
