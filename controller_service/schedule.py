"""Phases by time, and the desired motions of the phase that runs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from controller_service.model import Array, Configuration
from controller_service.reference import (
    HandHold,
    HandMotion,
    JointReference,
    JointSineMotion,
    JointSpline,
    PostureMotion,
    hand_motion,
)
from controller_service.tasks import PoseTarget, PostureTarget
from schemas.base import ControlMode
from schemas.controller import Phase
from schemas.errors import ConfigurationError
from schemas.robot import RobotDescription

SHORTEST_SHARE = 0.5
"""A posture motion entered late is done in the time left if that is at least this share of the phase."""


@dataclass(frozen=True, slots=True)
class PhaseTime:
    """A phase and where in it a time lies; times count on beyond the end of the last phase."""

    index: int
    phase: Phase
    since_start_s: float

    @property
    def left_s(self) -> float:
        """Time until the phase ends."""
        return self.phase.duration_s - self.since_start_s


class Schedule:
    """The phases one after the other from sequence 0; the last is held for ever.

    Raises:
        ConfigurationError: a mode that a drive lacks, a path longer than its phase.

    """

    def __init__(self, description: RobotDescription, phases: tuple[Phase, ...]) -> None:
        self._period = description.period_s
        self._phases = phases
        ends = np.cumsum([phase.duration_s for phase in phases])
        self._starts = [0, *(round(float(end) / self._period) for end in ends[:-1])]
        """Sequence at which each phase starts."""
        needs = {ControlMode.TORQUE: "torque", ControlMode.SERVO: "servo"}
        for index, phase in enumerate(phases):
            for joint in description.joints:
                if phase.mode in needs and joint.drive.kind != needs[phase.mode]:
                    raise ConfigurationError(
                        f"controller.phases.{index}.mode: {phase.mode.value} is not possible on joint {joint.name}: its"
                        f" drive is of kind {joint.drive.kind}, {needs[phase.mode]!r} is needed"
                    )
            if phase.hand_path is not None:
                path_s = phase.hand_path.lap_s * phase.hand_path.laps
                if path_s > phase.duration_s * (1.0 + 1e-9):
                    raise ConfigurationError(
                        f"controller.phases.{index}: hand_path takes {path_s:g} s (lap_s × laps), longer than the"
                        f" phase's duration_s {phase.duration_s:g}"
                    )
            if phase.joint_path is not None and (end_s := phase.joint_path.points[-1].time_s) > phase.duration_s + 1e-9:
                raise ConfigurationError(
                    f"controller.phases.{index}.joint_path: its last point is at {end_s:g} s, after the phase's"
                    f" duration_s {phase.duration_s:g}"
                )
            if phase.joint_sines is not None and 2.0 * phase.joint_sines.fade_s > phase.duration_s + 1e-9:
                raise ConfigurationError(
                    f"controller.phases.{index}.joint_sines: two ramps of fade_s {phase.joint_sines.fade_s:g} s do not"
                    f" fit into the phase's duration_s {phase.duration_s:g}"
                )
            if phase.wrench is not None and 2.0 * phase.wrench.ramp_s > phase.duration_s + 1e-9:
                raise ConfigurationError(
                    f"controller.phases.{index}.wrench: two ramps of ramp_s {phase.wrench.ramp_s:g} s do not fit into"
                    f" the phase's duration_s {phase.duration_s:g}"
                )

    def at(self, sequence: int) -> PhaseTime:
        """Find the phase of a sequence number."""
        index = len(self._starts) - 1
        while self._starts[index] > sequence:
            index -= 1
        return PhaseTime(index, self._phases[index], (sequence - self._starts[index]) * self._period)


@dataclass(frozen=True, slots=True)
class Targets:
    """What the tasks of a tick are to reach."""

    posture: PostureTarget
    hand: PoseTarget | None
    """None while the hand task does not run."""

    def at_rest(self) -> Targets:
        """Give the same places without velocity and acceleration."""
        posture, hand = self.posture, self.hand
        still = np.zeros_like(posture.position)
        return Targets(
            replace(posture, velocity=still, acceleration=still),
            None if hand is None else replace(hand, velocity=np.zeros(6), acceleration=np.zeros(6)),
        )


class References:
    """Desired posture and hand pose, kept without a jump from phase to phase.

    The posture task always runs. The hand task runs in phases with a path and in phases that ask for nothing (which
    hold posture and hand); a phase that only moves the joints leaves the hand free, as does torque control through the
    position interface.
    """

    def __init__(self, description: RobotDescription) -> None:
        self._names = description.joint_names
        self._frame = description.hand_frame
        self._index = -1
        self._origin = 0.0
        self._end = 0.0
        """When, after the origin, the entered phase is over and its motions have ended."""
        self._posture: JointReference | None = None
        self._hand: HandMotion | None = None
        self._dropped: str | None = None
        self.posture_target: PostureTarget | None = None
        self.hand_target: PoseTarget | None = None
        """None while the hand task does not run."""

    def forget(self) -> None:
        """Start from the configuration of the next call, as after a mode change."""
        self._index = -1
        self.posture_target = None
        self.hand_target = None

    def take_dropped_path(self) -> str | None:
        """Name the phase whose path was left out, for want of time after a hold or a contact; once."""
        dropped, self._dropped = self._dropped, None
        return dropped

    def advance(self, time: PhaseTime, now: Configuration) -> Targets:
        """Give the targets of a tick at a configuration."""
        if time.index != self._index or self._posture is None:
            self._enter(time, now)
        elapsed = time.since_start_s - self._origin
        assert self._posture is not None
        self.posture_target = self._posture.at(elapsed)
        self.hand_target = None if self._hand is None else self._hand.at(elapsed)
        return Targets(self.posture_target, self.hand_target)

    def follow_hand(self, now: Configuration, directions: tuple[bool, ...]) -> None:
        """Take the hand's present place for the one to hold, until a phase with another motion of it begins.

        Args:
            now: configuration.
            directions: (6,) which of the position's world directions follow; the orientation follows if all three do.

        """
        if self._hand is None or self._frame is None or self.hand_target is None:
            return
        frame, target = now.frames[self._frame], self.hand_target
        position = np.where(directions[:3], frame.position, target.position)
        self._hand = HandHold(position, frame.rotation if all(directions[3:]) else target.rotation)

    def _enter(self, time: PhaseTime, now: Configuration) -> None:
        phase = time.phase
        start = now.position
        if self._posture is not None and self.posture_target is not None:
            start = self._posture.at(self._end).position
        self._posture = self._joint_motion(time, start)
        before = None if self._hand is None or self.hand_target is None else self._hand.at(self._end)
        self._hand = self.hand_target = None
        moves_joints = phase.posture or phase.joint_path or phase.joint_sines or phase.torque_control
        if self._frame is not None and (phase.hand_path is not None or not moves_joints):
            path = phase.hand_path
            if path is not None and path.lap_s * path.laps > time.left_s * (1.0 + 1e-9):
                self._dropped, path = time.phase.name, None
            frame = now.frames[self._frame]
            pose = (frame.position, frame.rotation) if before is None else (before.position, before.rotation)
            self._hand = hand_motion(*pose, path)
        self._index, self._origin, self._end = time.index, time.since_start_s, time.left_s

    def _joint_motion(self, time: PhaseTime, start: Array) -> JointReference:
        """Make the joints' motion of a phase; one that is entered late keeps its place where there is no time left."""
        phase = time.phase
        late = time.left_s < (1.0 - 1e-9) * phase.duration_s
        if phase.joint_path is not None or phase.joint_sines is not None:
            if late:
                self._dropped = phase.name
                return PostureMotion(start, start, phase.duration_s)
            if phase.joint_path is not None:
                return JointSpline(start, phase.joint_path, self._names)
            assert phase.joint_sines is not None
            return JointSineMotion(start, phase.joint_sines, self._names, phase.duration_s)
        end, duration = start.copy(), phase.duration_s
        if time.left_s >= SHORTEST_SHARE * phase.duration_s:
            end[[self._names.index(name) for name in phase.posture]] = list(phase.posture.values())
            duration = time.left_s
        return PostureMotion(start, end, duration)
