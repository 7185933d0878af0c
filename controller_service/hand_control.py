"""Force control of the hand over a run: estimate the wrench, decide whether to give way, remember Fʳ."""

from __future__ import annotations

from dataclasses import dataclass

from controller_service.dual_compliance import Compliance, DualComplianceSwitch
from controller_service.force_tasks import WrenchReference, WrenchVariables
from controller_service.model import Array, Configuration
from controller_service.wrench import HandWrench, HandWrenchEstimator
from schemas.control_law import HandForce
from schemas.load import Robot
from schemas.messages import RobotState

ALWAYS = Compliance(active=True, engaged=False, released=False)


@dataclass(frozen=True, slots=True)
class HandForces:
    """What the hand feels at a tick, and what it is to do about it."""

    measured: HandWrench
    reference: WrenchReference
    """Fʳ of the QP of the tick before: the one step of delay of section III-E."""
    compliance: Compliance
    led: bool
    """Dual compliance is, or was until now, active: where the hand is now is where it is to stay."""


class HandControl:
    """State of the hand's force control.

    Args:
        robot: description and URDF.
        config: sensor, gains, switch.

    Raises:
        ConfigurationError: see `HandWrenchEstimator`; a wrench out of its bounds.

    """

    def __init__(self, robot: Robot, config: HandForce) -> None:
        description = robot.description
        self._estimator = HandWrenchEstimator(robot, config)
        dual = config.dual_compliance
        self._switch = None if dual is None else DualComplianceSwitch(dual, description.period_s)
        task = config.wrench_task
        self.variables = (
            None if task is None else WrenchVariables.of(self._estimator.hand_frame, len(description.joints), task)
        )
        """Of the QP; None without a wrench task."""
        self._reference = WrenchReference.zero()
        self._period = description.period_s

    def start(self, wrench: Array | None = None) -> None:
        """Begin anew, as after a change of mode, with the first Fʳ (6,) of the QP; None without a wrench task."""
        self._estimator.restart()
        self._reference = WrenchReference.zero()
        if wrench is not None:
            self._reference = WrenchReference(wrench, self._reference.rate)
        if self._switch is not None:
            self._switch.reset()

    def update(self, now: Configuration, state: RobotState, elapsed_s: float) -> HandForces:
        """Estimate and decide at a state, `elapsed_s` after the last.

        Raises:
            StateError: the sensor is silent.

        """
        cycles = max(1, round(elapsed_s / self._period))
        measured = self._estimator.update(self._estimator.sample(state), now, cycles)
        compliance = ALWAYS if self._switch is None else self._switch.update(measured.force_norm, elapsed_s)
        led = self._switch is not None and (compliance.active or compliance.released)
        return HandForces(measured, self._reference, compliance, led)

    def remember(self, wrench: Array | None, elapsed_s: float) -> None:
        """Take Fʳ (6,) that the QP found, for the next tick; None without a wrench task."""
        if wrench is not None:
            self._reference = self._reference.after(wrench, elapsed_s)
