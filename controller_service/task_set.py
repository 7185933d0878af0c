"""The tasks of a tick: the schedule's targets with the configuration's gains, changed by what was sensed."""

from __future__ import annotations

from controller_service.force_tasks import HybridGains, HybridPoseTask
from controller_service.hand_control import HandForces
from controller_service.model import Configuration
from controller_service.null_space import TaskJacobian
from controller_service.schedule import Targets
from controller_service.tasks import FRAME_TASKS, InertialPostureTask, PostureTask, Task
from schemas.controller import ControllerConfig, TaskGains


class TaskSet:
    """Makes the tasks of the posture and of the hand.

    Args:
        frame: of the hand.
        config: gains, and what of the hand is controlled.

    """

    def __init__(self, frame: str | None, config: ControllerConfig) -> None:
        self._frame = frame
        inertial = config.null_space is not None and config.null_space.posture_metric == "inertia"
        self._posture_task = InertialPostureTask if inertial else PostureTask
        self._hand_task = FRAME_TASKS[config.hand_task]
        self._gains = config.posture, config.hand
        self._soft = _without_stiffness(config.posture), _without_stiffness(config.hand)
        force = config.hand_force
        self._hybrid, self._soft_hybrid = (
            None if force is None else HybridGains.of(gains, force.admittance)
            for gains in (config.hand, _without_stiffness(config.hand))
        )

    @property
    def hand_rows(self) -> int:
        """Directions that the hand task asks for."""
        return len(range(6)[self._hand_task.rows])

    def make(
        self, now: Configuration, targets: Targets, *, yielding: bool = False, forces: HandForces | None = None
    ) -> tuple[Task, ...]:
        """Make the tasks at a configuration.

        Args:
            now: configuration.
            targets: of the posture, and of the hand where it has a task.
            yielding: all tasks keep their damping alone, against any motion.
            forces: what the hand feels and is to give way to.

        """
        posture_gains, hand_gains = self._soft if yielding else self._gains
        hybrid = self._soft_hybrid if yielding else self._hybrid
        if yielding:
            targets = targets.at_rest()
        posture = self._posture_task(now, targets.posture, posture_gains)
        if self._frame is None or targets.hand is None:
            return (posture,)
        if forces is not None and forces.compliance.active and hybrid is not None:
            rows, hand = self._hand_task.rows, targets.hand
            return posture, HybridPoseTask(now, self._frame, hand, hybrid, forces.reference, forces.measured, rows)
        return posture, self._hand_task(now, self._frame, targets.hand, hand_gains)

    def jacobian(self, now: Configuration, targets: Targets) -> TaskJacobian | None:
        """J and J̇ of the hand task; None while it does not run."""
        if self._frame is None or targets.hand is None:
            return None
        frame, rows = now.frames[self._frame], self._hand_task.rows
        return TaskJacobian(frame.jacobian[rows], frame.jacobian_rate[rows])


def _without_stiffness(gains: TaskGains) -> TaskGains:
    return gains.model_copy(update={"stiffness": 0.0})
