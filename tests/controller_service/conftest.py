"""An arm in text, a small rigid-body plant with friction, and the loop of both with the controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from controller_service.controller import Controller
from controller_service.model import Array, RobotModel
from schemas.base import ControlMode
from schemas.load import Robot, Run
from schemas.messages import (
    AppliedCommand,
    ControllerTrace,
    DriveState,
    HalStatus,
    JointCommand,
    RobotState,
    WrenchSample,
)
from schemas.robot import RobotDescription
from schemas.scenario import Scenario

AXES = ("0 0 1", "1 0 0", "0 1 0", "1 0 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "1 0 0")
OFFSETS = (
    "0 0 1.1",
    "0 -0.08 0",
    "0 -0.15 0",
    "0 -0.05 0",
    "0 0 -0.12",
    "0 0 -0.2",
    "0 0 -0.12",
    "0 0 -0.15",
    "0 0 -0.03",
)
MASSES = (2.5, 3.0, 3.5, 2.5, 3.5, 2.5, 2.0, 0.8, 1.2)
NAMES = tuple(f"joint{i}" for i in range(9))
START = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])


def arm_urdf() -> str:
    """Nine joints in a chain, a hand, and a finger and a continuous tool joint that nothing drives."""
    parts = ['<robot name="arm"><link name="base"/>']
    parent = "base"
    for i, (name, axis, offset, mass) in enumerate(zip(NAMES, AXES, OFFSETS, MASSES, strict=True)):
        link = f"link{i}"
        parts.append(
            f'<link name="{link}"><inertial><origin xyz="0.01 -0.01 -0.07"/><mass value="{mass}"/><inertia'
            f' ixx="{0.006 * mass}" iyy="{0.007 * mass}" izz="{0.003 * mass}" ixy="0.0005" ixz="0" iyz="0"/></inertial>'
            "</link>"
            f'<joint name="{name}" type="{"continuous" if i == 4 else "revolute"}"><parent link="{parent}"/><child'
            f' link="{link}"/><origin xyz="{offset}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="300"'
            ' velocity="4"/></joint>'
        )
        parent = link
    parts.append(
        '<link name="hand"/><joint name="hand_mount" type="fixed"><parent link="link8"/><child link="hand"/>'
        '<origin xyz="0 0 -0.12"/></joint><link name="finger"><inertial><mass value="0.1"/><inertia ixx="1e-4"'
        ' iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="a_finger" type="continuous"><parent link="hand"/><child link="finger"/>'
        '<axis xyz="1 0 0"/></joint></robot>'
    )
    return "".join(parts)


def arm_description(**changes: Any) -> RobotDescription:
    joints = [
        {
            "name": name,
            "gear_ratio": 250 if i < 6 else 200,
            "rotor_inertia": (4e-5 if i < 6 else 1.5e-5),
            "torque_limit": 250 if i < 6 else 80,
            "torque_rate_limit": 12500,
            "velocity_limit": 3.0,
            "position_min": -2.5,
            "position_max": 2.5,
            "encoder_counts": 4096,
            "drive": {
                "kind": "torque",
                "bus": f"b{i // 3}",
                "node_id": i + 1,
                "rated_motor_torque": 0.5,
                "position_gain": 30000 if i < 6 else 8000,
                "velocity_gain": 600 if i < 6 else 120,
            },
        }
        for i, name in enumerate(NAMES)
    ]
    data: dict[str, Any] = {
        "name": "arm",
        "urdf": "arm.urdf",
        "rate_hz": 500,
        "compute_budget_s": 6e-4,
        "hand_frame": "hand",
        "buses": [{"name": f"b{i}", "channel": f"b{i}"} for i in range(3)],
        "joints": joints,
    }
    return RobotDescription.model_validate(data | changes)


def make_run(controller: dict[str, Any], description: RobotDescription | None = None, urdf: str | None = None) -> Run:
    robot = Robot(description or arm_description(), urdf or arm_urdf())
    scenario = Scenario.model_validate({"name": "test", "robot": "arm", "duration_s": 60, "controller": controller})
    return Run(robot, scenario)


@dataclass
class Plant:
    """Rigid bodies, Coulomb friction by impulses (no chatter at rest), motors with a wrong scale, firmware PD."""

    run: Run
    position: Array
    coulomb: float = 0.0
    """At the motor [N·m]."""
    viscous: float = 0.0
    torque_scale: float = 1.0
    mass_scale: Array | None = None
    substeps: int = 4
    velocity: Array = field(init=False)
    motor_torque: Array = field(init=False)
    external: Array = field(init=False)
    """Torque of the environment at the joints (n,) [N·m], held from one `advance` to the next; zero until set."""

    def __post_init__(self) -> None:
        description = self.run.robot.description
        self.rigid = RobotModel(self.run.robot)
        if self.mass_scale is not None:
            for i, scale in enumerate(self.mass_scale, start=1):
                body = self.rigid.model.inertias[i]
                self.rigid.model.inertias[i] = pin.Inertia(scale * body.mass, body.lever, scale * body.inertia)
        self.rigid.data = self.rigid.model.createData()
        self.gear = np.array([joint.gear_ratio for joint in description.joints])
        self.kp = np.array([joint.drive.position_gain for joint in description.joints])
        self.kd = np.array([joint.drive.velocity_gain for joint in description.joints])
        self.limit = np.array([joint.torque_limit for joint in description.joints])
        self.velocity = np.zeros_like(self.position)
        self.motor_torque = np.zeros_like(self.position)
        self.external = np.zeros_like(self.position)

    def advance(self, period: float, position: Array | None, torque: Array | None) -> None:
        model, data, dt = self.rigid.model, self.rigid.data, period / self.substeps
        loss = self.gear * self.coulomb * dt
        inverse = pin.computeMinverse(model, data, self.position)
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        if position is not None:  # the stiff firmware damping, implicitly
            inverse = np.linalg.inv(np.linalg.inv(inverse) + np.diag(dt * self.kd + dt * dt * self.kp))
        for _ in range(self.substeps):
            if position is not None:
                commanded = self.kp * (position - self.position) - self.kd * self.velocity
            else:
                assert torque is not None
                commanded = torque
            self.motor_torque = np.clip(commanded, -self.limit, self.limit)
            drag = self.gear**2 * self.viscous * self.velocity
            bias = pin.nonLinearEffects(model, data, self.position, self.velocity)
            stiffness = dt * self.kp * self.velocity if position is not None else 0.0
            driving = self.torque_scale * self.motor_torque + self.external
            free = self.velocity + dt * inverse @ (driving - drag - bias - stiffness)
            impulse = np.zeros_like(free)
            if self.coulomb > 0.0:
                for _ in range(6):
                    for j in range(len(free)):
                        velocity = free[j] - inverse[j] @ impulse
                        impulse[j] = min(max(impulse[j] + velocity / inverse[j, j], -loss[j]), loss[j])
            self.velocity = free - inverse @ impulse
            self.position = self.position + dt * self.velocity


@dataclass
class Loop:
    """Controller and plant with a cycle of delay, as the HAL would apply commands (holding offset included)."""

    run: Run
    plant: Plant
    counts: bool = True
    report_torque: bool = True
    commands: list[JointCommand] = field(default_factory=list)
    traces: list[ControllerTrace] = field(default_factory=list)
    torques: list[Array] = field(default_factory=list)
    positions: list[Array] = field(default_factory=list)
    status: Callable[[int], HalStatus] = lambda _: HalStatus.ACTIVE
    wrenches: Callable[[int], tuple[WrenchSample, ...]] = lambda _: ()
    """Readings of the force/torque sensors at a sequence."""

    def __post_init__(self) -> None:
        self.controller = Controller(self.run, "session")
        self.sequence = 0
        self.applied = AppliedCommand(sequence=-1, mode=ControlMode.POSITION, position=tuple(self.plant.position))
        self.offset = np.zeros_like(self.plant.position)
        joints = self.run.robot.description.joints
        self.count = np.array([2 * math.pi / (joint.encoder_counts * joint.gear_ratio) for joint in joints])

    def state(self) -> RobotState:
        n = len(self.plant.position)
        measured = np.round(self.plant.position / self.count) * self.count if self.counts else self.plant.position
        return RobotState(
            sequence=self.sequence,
            time_ns=self.sequence * self.run.robot.description.period_ns,
            status=self.status(self.sequence),
            position_measured=tuple(measured.tolist()),
            motor_torque_measured=tuple(self.plant.motor_torque.tolist()) if self.report_torque else None,
            drive_state=(DriveState.OPERATION_ENABLED,) * n,
            mode=(self.applied.mode,) * n,
            error_code=(0,) * n,
            applied=self.applied,
            wrenches=self.wrenches(self.sequence),
        )

    def cycle(self) -> None:
        state = self.state()
        period = self.run.robot.description.period_s
        command, trace = self.controller.step(state)
        self.commands.append(command)
        self.traces.append(trace)
        applied = self.applied
        if applied.position is not None:
            self.plant.advance(period, np.array(applied.position), None)
        else:
            self.plant.advance(period, None, np.array(applied.torque))
        self.torques.append(self.plant.motor_torque.copy())
        self.positions.append(self.plant.position.copy())
        position = command.position
        if position is not None:
            if applied.torque is not None:
                self.offset = (
                    self.plant.position
                    - np.array(position)
                    + (np.array(applied.torque) + self.plant.kd * self.plant.velocity) / self.plant.kp
                )
            self.offset *= math.exp(-period / 0.05)
            position = tuple((np.array(position) + self.offset).tolist())
        else:
            self.offset[:] = 0.0
        self.applied = AppliedCommand(
            sequence=command.sequence, mode=command.mode, position=position, torque=command.torque
        )
        self.sequence += 1

    def go(self, cycles: int) -> Loop:
        for _ in range(cycles):
            self.cycle()
        return self


@pytest.fixture(scope="session")
def arm() -> Robot:
    return Robot(arm_description(), arm_urdf())


@pytest.fixture(scope="session")
def run_of() -> Callable[..., Run]:
    return make_run


@pytest.fixture(scope="session")
def loop_of() -> Callable[..., Loop]:
    """loop_of(controller configuration, **plant) at `START`."""

    def build(
        controller: dict[str, Any],
        *,
        description: RobotDescription | None = None,
        urdf: str | None = None,
        **plant: Any,
    ) -> Loop:
        run = make_run(controller, description, urdf)
        counts, report = plant.pop("counts", True), plant.pop("report_torque", True)
        return Loop(run, Plant(run, START.copy(), **plant), counts=counts, report_torque=report)

    return build
