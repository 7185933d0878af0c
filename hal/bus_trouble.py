"""All buses of a robot through their troubles: whose frames are not expected, and which drives must be asked again."""

from __future__ import annotations

from typing import Final

import numpy as np

from hal.bus_watch import BusState, BusWatch
from hal.decode import Measured, Notice, upload_request
from hal.profile.frames import split
from hal.profile.objects import ERROR_CODE, MODE_DISPLAY
from hal.supervision import Mask
from schemas.robot import ForceTorqueSensor, Imu, RobotDescription

ASK_CYCLES: Final = 50
"""A round of questions to the drives of a bus that works again, for what they say on change alone."""
QUESTIONS: Final = {0: ERROR_CODE, 10: MODE_DISPLAY}
"""Cycle of a round: object asked for. A server takes one transfer at a time (CiA 301 section 7.2.4.2)."""


class BusTrouble:
    """Follows every bus; a cycle without errors and without trouble need not ask it anything."""

    def __init__(self, robot: RobotDescription) -> None:
        self.active = False
        """Some bus is in trouble, or recovering from one."""
        self.joints: Mask = np.zeros(len(robot.joints), dtype=bool)
        """Joints on such buses."""
        self.silent_buses: frozenset[int] = frozenset()
        """Buses of which no frames are to be expected."""
        self._robot = robot
        self._watches = tuple(BusWatch(bus.name, robot.safety.sync_timeout_cycles) for bus in robot.buses)
        self._down: list[str | None] = [None] * len(robot.buses)
        """Why each interface is down, as the master says."""
        self._was_down: list[str | None] = [None] * len(robot.buses)
        """The same of those that went down since the last review, though they may be back: frames were lost."""
        self._troubled: frozenset[int] = frozenset()
        self._bus_of_joint = np.array([robot.bus_index(joint.drive.bus) for joint in robot.joints])
        sensors: list[ForceTorqueSensor | Imu] = [*robot.force_torque_sensors, *robot.imus]
        self._bus_of_sensor = {sensor.name: robot.bus_index(sensor.bus) for sensor in sensors}
        self._unanswered: set[int] = set()
        """Joints on buses that were silent, whose modes are not known again."""
        self._cycles_asked = 0

    @property
    def buses(self) -> tuple[str, ...]:
        """Names of the buses in trouble, and of those whose drives have not yet been found to hold after one."""
        return tuple(self._watches[index].name for index in sorted(self._troubled))

    def set_down(self, index: int, reason: str | None) -> None:
        """Say that a bus takes and gives no frames now, and why, or that it does again; `review` acts on it."""
        self._down[index] = reason
        if reason is not None:
            self._was_down[index] = reason
            self._update()

    def review(self, measured: Measured, enabled: Mask) -> list[Notice]:
        """List the findings of one cycle; a bus has recovered when its drives report, in a known mode, and hold."""
        notices: list[Notice] = []
        self._unanswered -= measured.answered
        for index, watch in enumerate(self._watches):
            down, self._was_down[index] = self._was_down[index] or self._down[index], None
            was_silent = watch.silent
            errors = [report for bus, report in measured.errors if bus == index]
            notices += watch.review(errors, measured.heard[index], down)
            joints = np.flatnonzero(self._bus_of_joint == index).tolist()
            if watch.silent:
                self._unanswered.difference_update(joints)
            elif was_silent:
                self._unanswered.update(joints)
                self._cycles_asked = 0
            if watch.recovering and watch.state is BusState.ACTIVE:
                holds = (measured.silent_cycles == 0) & enabled
                if holds[joints].all() and self._unanswered.isdisjoint(joints):
                    notices.append(watch.recovered())
        self._update()
        return notices

    def expected_ages(self, ages: dict[str, int]) -> dict[str, int]:
        """Cycles since each sensor's last reading, none where its bus is in trouble."""
        return {name: 0 if self._bus_of_sensor[name] in self._troubled else age for name, age in ages.items()}

    def passing(self, packets: tuple[bytes, ...], measured: Measured) -> tuple[bytes, ...]:
        """Take the commands of a cycle (each bus's in the order of its joints) that may be sent, and add questions.

        A drive that has not reported on a bus in trouble gets no command: it would be one from before it was lost.
        Drives whose bus works again are asked for their modes: they may have changed them unheard.
        """
        passed = list(packets)
        for index in self._troubled:
            silent = measured.silent_cycles[self._bus_of_joint == index] > 0
            if silent.any():
                frames = zip(split(packets[index]), silent.tolist(), strict=True)
                passed[index] = b"".join(frame for frame, unheard in frames if not unheard)
        if self._unanswered:
            if (asked := QUESTIONS.get(self._cycles_asked % ASK_CYCLES)) is not None:
                for joint in sorted(self._unanswered):
                    passed[self._bus_of_joint[joint]] += upload_request(self._robot.joints[joint].drive.node_id, asked)
            self._cycles_asked += 1
        return tuple(passed)

    def _update(self) -> None:
        pairs = list(enumerate(zip(self._watches, self._down, strict=True)))
        self._troubled = frozenset(index for index, (watch, down) in pairs if watch.troubled or down is not None)
        self.silent_buses = frozenset(index for index, (watch, down) in pairs if watch.silent or down is not None)
        self.active = bool(self._troubled)
        self.joints = np.isin(self._bus_of_joint, list(self._troubled))
