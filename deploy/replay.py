"""Feed a log through fresh objects and compare: the controller, the HAL's core, the plant.

In lockstep with the arithmetic that the log names (versions, kind of CPU, BLAS) every number must come out the same;
elsewhere each field has a tolerance (`deploy.compare`).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from deploy.compare import CONTROLLER, Difference, Tolerances, compare
from deploy.errors import DeployError, UsageError
from schemas.base import Clock
from schemas.fingerprint import differences, fingerprint
from schemas.log import LogReader
from schemas.messages import JointCommand, RobotState

PARTS: Final = ("controller", "hal", "plant")


class ReplayError(DeployError):
    """A log holds too little to replay."""


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """What came of a replay."""

    log: str
    part: str
    exact: bool
    """Equal bits were asked for; False: tolerances."""
    reasons: tuple[str, ...]
    """Why not exact."""
    compared: int
    """Messages that agreed."""
    difference: Difference | None

    @property
    def passed(self) -> bool:
        """No difference."""
        return self.difference is None

    def as_json(self) -> dict[str, Any]:
        """All fields and `passed`."""
        return {**asdict(self), "passed": self.passed}

    def describe(self) -> str:
        """Say in a line or two how it went."""
        how = "exactly" if self.exact else f"within tolerances ({'; '.join(self.reasons)})"
        if self.difference is None:
            return f"{self.log}: {self.part}: {self.compared} messages come out {'the same' if self.exact else how}"
        return f"{self.log}: {self.part}: {self.difference} (compared {how}; {self.compared} agreed before)"


def replay_log(log: Path, part: str) -> ReplayResult:
    """Replay one part of `PARTS` of a log.

    Raises:
        LogError: the file is no log.
        ReplayError: it holds nothing to replay.
        CosimError: the part refuses its input, which it did not when the log was written.

    """
    from deploy import replay_bus

    parts = {"controller": replay_controller, "hal": replay_bus.replay_hal, "plant": replay_bus.replay_plant}
    if part not in parts:
        raise UsageError(f"no part {part!r} to replay: expected one of {', '.join(PARTS)}")
    reader = LogReader(log)
    reasons = list(differences(reader.fingerprint, fingerprint(reader.run)))
    if reader.run.scenario.clock is not Clock.LOCKSTEP:
        reasons.append("clock: realtime")
    compared, difference = parts[part](reader, not reasons)
    if compared == 0 and difference is None:
        raise ReplayError(f"{log}: nothing to replay for the {part}: no states with their answers and frames")
    return ReplayResult(str(log), part, not reasons, tuple(reasons), compared, difference)


def replay_controller(reader: LogReader, exact: bool) -> tuple[int, Difference | None]:
    """Feed logged states to a fresh controller; returns the number of equal commands and the first difference."""
    from controller_service.controller import Controller

    commands: dict[int, JointCommand] = {}
    for command in reader.messages(JointCommand):
        commands.setdefault(command.sequence, command)
    if not commands:
        return 0, None
    last = max(commands)
    controller = Controller(reader.run, next(iter(commands.values())).session)
    tolerances: Tolerances | None = None if exact else CONTROLLER
    compared = 0
    for state in reader.messages(RobotState):
        logged = commands.get(state.sequence)
        if logged is None:
            if state.sequence > last:
                break
            if reader.run.scenario.clock is Clock.REALTIME:
                continue  # the controller saw newer states only
            return compared, Difference(state.sequence, "command", "none", "one")
        replayed, _ = controller.step(state)
        if (difference := compare(state.sequence, "command", logged, replayed, tolerances)) is not None:
            return compared, difference
        compared += 1
    return compared, None
