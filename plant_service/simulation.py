"""The simulated robot: firmware, motors, friction and rigid bodies, advanced one bus period at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from plant_service.axis import Axis
from plant_service.errors import DivergedError
from plant_service.firmware import Firmware
from plant_service.friction import DryFriction
from plant_service.joint_axis import JointAxis
from plant_service.joint_entries import JointEntries
from plant_service.model import PlantModel, build
from plant_service.obstacles import Contacts
from plant_service.sensors import Sensors
from plant_service.world import WorldLoads
from schemas.load import Robot
from schemas.messages import DriveState, PlantTruth, PoseSample
from schemas.scenario import PlantConfig

Array = NDArray[np.float64]

# Warnings are counted in the data and end the run; MuJoCo would also write them to a file in the working directory.
mujoco.set_mju_user_warning(lambda _: None)


class Simulation:
    """One robot from its start at time 0. The same robot, configuration, seed and calls give the same bits.

    Between two calls of `advance` the state is that of a SYNC: the simulated drives read and command `axes`, the
    simulated sensors read `sensors`. At the start every drive is off and its brake holds.
    """

    def __init__(self, robot: Robot, config: PlantConfig, seed: int) -> None:
        description = robot.description
        self._description = description
        self._config = config
        self._plant: PlantModel = build(robot, config, seed)
        self._model = self._plant.model
        self._data = mujoco.MjData(self._model)
        self._warnings = self._data.warning.number
        self._torque_scale = np.array(config.torque_scale)  # numpy takes a Python number at twice the cost
        self._substeps = round(description.period_s / config.substep_s)
        joints = description.joints
        gear = np.array([joint.gear_ratio for joint in joints])
        torque_limit = np.array([joint.torque_limit for joint in joints])
        self._friction = DryFriction(config.friction, gear, torque_limit, self._plant.friction_factors)
        self._firmware = Firmware(description, config, seed)
        self.axes: tuple[Axis, ...] = tuple(JointAxis(self._firmware, index) for index in range(len(joints)))
        """One axis a joint, for the simulated drives."""
        self.sensors = Sensors(description, self._model, config.noise, seed)
        """Readings of the last sample."""
        body_of = self._plant.frame_bodies
        self._frames = {
            name: (self._data.xpos[body_of[name]], self._data.xquat[body_of[name]]) for name in self._truth_frames()
        }

        self._position = np.array(self._plant.initial_position)
        self._velocity = np.zeros(len(joints))
        self._acceleration = np.zeros(len(joints))
        self._motor_torque = np.zeros((0, len(joints)))
        self._friction_torque = np.zeros(len(joints))
        self._mode = self._firmware.mode.copy()
        self._contacts = Contacts(self._model)
        self._periods = 0

        model, data, dofs = self._model, self._data, self._plant.dof_address
        self._joint_position = JointEntries(data.qpos, self._plant.qpos_address)
        self._joint_velocity = JointEntries(data.qvel, dofs)
        self._joint_applied = JointEntries(data.qfrc_applied, dofs)
        self._joint_constraint = JointEntries(data.qfrc_constraint, dofs)
        self._joint_friction = JointEntries(model.dof_frictionloss, dofs)
        self._joint_damping = JointEntries(model.dof_damping, dofs)
        self._joint_position.write(self._position)
        self._options = model.opt
        self._sensordata = data.sensordata
        self._sensors_on = model.opt.disableflags
        self._sensors_off = self._sensors_on | mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._apply_brakes()
        mujoco.mj_forward(self._model, self._data)
        self._loads = WorldLoads(self._model, self._data, config.world, body_of, config.substep_s)
        self._sample_constraints(self._velocity)
        self._firmware.sample(self._position, self._velocity)
        self.sensors.sample(self._sensordata)

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]: periods × the description's `period_ns`."""
        return self._periods * self._description.period_ns

    @property
    def plant(self) -> PlantModel:
        """The compiled model and its maps."""
        return self._plant

    @property
    def kinetic_energy(self) -> float:
        """½ q̇ᵀ M q̇ [J], rotors included."""
        mujoco.mj_energyVel(self._model, self._data)
        return float(self._data.energy[1])

    def count_events_from(self, time_ns: int | None) -> None:
        """Tell the simulated time [ns] of sequence 0, from which the times of the world's events count.

        It is 0 until told otherwise. None: not yet known, so that no event acts. A time that moves back lets the events
        come sooner, as after periods that were left out; none begins twice.
        """
        self._loads.origin_ns = time_ns

    def apply_wrench(
        self, link: str, point_in_link: Sequence[float] | None = None, force_in_world: Sequence[float] | None = None
    ) -> None:
        """Push a point of a link [m, in the link's frame] with a force [N, in the world] until told otherwise.

        The force follows the point from substep to substep and adds to those of the scenario's events. Without force
        the link is released.

        Raises:
            PlantError: the robot has no such link.

        """
        if force_in_world is None:
            self._loads.release(link)
        else:
            self._loads.set_load(link, point_in_link or (0.0, 0.0, 0.0), force_in_world)

    def advance(self) -> None:
        """Integrate one period: for each substep the firmware's law, then the bodies; then sample for the next SYNC.

        Raises:
            DivergedError: MuJoCo warns: numbers are not finite or huge, or a buffer is full.

        """
        model, data, firmware = self._model, self._data, self._firmware
        step1, step2 = mujoco.mj_step1, mujoco.mj_step2
        scale = self._torque_scale
        self._mode[:] = firmware.mode
        loads = self._loads if self._loads.begin_period(self.time_ns, self._substeps) else None
        if firmware.brakes_changed:
            self._apply_brakes()
            step1(model, data)
        firmware.begin_period()
        torques = np.empty((self._substeps, len(self.axes)))
        if firmware.constant:
            torques[:] = firmware.torque * scale
            self._joint_applied.write(torques[0])
        position, velocity = self._position, self._velocity
        last = self._substeps - 1
        self._options.disableflags = self._sensors_off
        for index, torque in enumerate(torques):
            if not firmware.constant:
                torque[:] = firmware.step(index, position, velocity) * scale
                self._joint_applied.write(torque)
            if index == last:
                self._options.disableflags = self._sensors_on
                previous = velocity.copy()
            if loads is not None:
                loads.apply(index)
            step2(model, data)
            position, velocity = self._joint_position.read(), self._joint_velocity.read()
            if index == last:
                self._sample_constraints(velocity)  # implicitfast: viscous friction acts at the end of the step
            self._joint_friction.write(self._friction.bound(velocity))
            step1(model, data)
        self._acceleration = (velocity - previous) / self._config.substep_s
        self._position, self._velocity, self._motor_torque = position, velocity, torques
        self._periods += 1
        if np.count_nonzero(self._warnings):
            self._raise_diverged()
        firmware.end_period(position, velocity)
        self.sensors.sample(self._sensordata)

    def truth(self, sequence: int, drive_states: Sequence[DriveState]) -> PlantTruth:
        """Tell what is true at this SYNC.

        Accelerations, friction, contacts and the world's forces are those of the substep that ended here. Friction is
        signed as it acts: M q̈ + h = motor_torque + friction_torque + Σ Jᵀ F (+ limits), F the forces of contacts and
        world at their points.
        """
        torques = self._motor_torque
        now = torques[-1] if len(torques) else np.zeros(len(self._position))
        return PlantTruth(
            sequence=sequence,
            time_ns=self.time_ns,
            position=tuple(self._position.tolist()),
            velocity=tuple(self._velocity.tolist()),
            acceleration=tuple(self._acceleration.tolist()),
            mode=tuple(self._mode.tolist()),
            drive_state=tuple(drive_states),
            motor_torque=tuple(now.tolist()),
            motor_torque_substeps=tuple(map(tuple, torques.tolist())),
            friction_torque=tuple(self._friction_torque.tolist()),
            frames={name: _pose(*views) for name, views in self._frames.items()},
            sensor_wrenches=dict(self.sensors.true_wrenches),
            contact_force=self._contacts.force,
            contacts=self._contacts.samples,
            world_forces=dict(self._loads.forces),
            kinetic_energy=self.kinetic_energy,
        )

    def pose(self, link: str) -> PoseSample:
        """Tell the true pose of a URDF link's frame in the world."""
        body = self._plant.frame_bodies[link]
        return _pose(self._data.xpos[body], self._data.xquat[body])

    def _truth_frames(self) -> tuple[str, ...]:
        hand = self._description.hand_frame
        return tuple(dict.fromkeys([*([hand] if hand else []), *self._config.truth_frames]))

    def _apply_brakes(self) -> None:
        self._friction.set_brakes(self._firmware.braked)
        self._joint_friction.write(self._friction.bound(self._velocity))
        self._firmware.brakes_changed = False

    def _raise_diverged(self) -> NoReturn:
        kind = mujoco.mjtWarning(int(np.flatnonzero(self._warnings)[0])).name.removeprefix("mjWARN_")
        fastest = int(np.argmax(np.abs(np.nan_to_num(self._velocity, nan=np.inf))))
        raise DivergedError(
            f"{self._description.joint_names[fastest]}: velocity {self._velocity[fastest]:g} rad/s at"
            f" {self.time_ns * 1e-9:g} s, MuJoCo reports {kind}. Lower plant.substep_s or the drives' gains."
        )

    def _sample_constraints(self, velocity: Array) -> None:
        """Take friction and contact forces while the constraint solution still stands."""
        data, model = self._data, self._model
        if data.nefc == data.nf:
            dry = self._joint_constraint.read()
        else:
            rows = slice(data.ne, data.ne + data.nf)
            every = np.zeros(model.nv)
            every[data.efc_id[rows]] = data.efc_force[rows]
            dry = every[self._plant.dof_address]
        self._friction_torque = dry - self._joint_damping.read() * velocity
        self._contacts.sample(data)


def _pose(position: Array, quaternion: Array) -> PoseSample:
    return PoseSample(position_in_world=tuple(position.tolist()), orientation_to_world=tuple(quaternion.tolist()))
