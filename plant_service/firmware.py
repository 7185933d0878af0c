"""Drive firmware and motors of all joints, at the plant's substep rate.

    x = k_p (q_t − q) + k_d (q̇_t − q̇)  (mode 8),   x = τ_t  (mode 10),   x = 0  (power off)
    τ = clip(D(x), ± limit),   D(x) = sign(x) max(|x| − d, 0)

τ is what the drive believes it gives and reports as current; the motor gives `torque_scale` times as much. One law
serves all modes: gains of zero make torque mode, everything zero is power off. Between two SYNCs the target moves
linearly to the one latched last (CSP interpolation) and q̇_t is its slope, or zero for drives whose law has none
(`Drive.velocity_reference`).

With a `DriveAsymmetry` the gains of the position modes are k_p (1 + α_p σ) and k_d (1 + α_d σ), σ = tanh(q̇/v₀) of the
true velocity at each step: section 3.2.1 of [Del Prete 2016] found such drives.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from hal.profile.cia402 import OperationMode
from hal.profile.firmware import FirmwareGains, holding_offset, ramp_share
from hal.profile.units import DriveUnits
from plant_service.axis import AxisGains
from plant_service.errors import PlantError
from schemas.robot import RobotDescription
from schemas.scenario import PlantConfig

Array = NDArray[np.float64]

MOTOR_NOISE_STREAM = 2
OFF = int(OperationMode.NONE)
POSITION = int(OperationMode.CSP)
TORQUE = int(OperationMode.CST)
UNKNOWN = -1


class Firmware:
    """State of n drives. Arrays are in the order of the description; SI at the joint.

    The position loop sees the encoder's counts. Its velocity is exact: drives time the encoder's edges (M/T method),
    which is far finer than a difference of counts over half a millisecond.
    """

    def __init__(self, description: RobotDescription, config: PlantConfig, seed: int) -> None:
        gains = FirmwareGains.of(description)
        n = len(description.joints)
        self._period_s = description.period_s
        substeps = round(description.period_s / config.substep_s)
        self._units = DriveUnits.of(description)
        self._names = description.joint_names
        self._gear = np.array([joint.gear_ratio for joint in description.joints])
        self._position_gain = gains.position_gain.copy()
        self._velocity_gain = gains.velocity_gain.copy()
        self._dead_zone = gains.dead_zone * config.dead_zone_scale
        self._own_limit = gains.torque_limit.copy()
        self._hold_ramp_s = np.full(n, description.safety.hold_ramp_s)
        references = [joint.drive.velocity_reference for joint in description.joints]
        self._slope_time_s = [math.inf if each == "zero" else self._period_s for each in references]
        asymmetry = config.drive_asymmetry
        self._asymmetry = asymmetry if asymmetry.position_gain or asymmetry.velocity_gain else None
        self._noise = config.noise.motor_torque
        self._generator = np.random.default_rng([seed, MOTOR_NOISE_STREAM])

        self.mode = np.zeros(n, dtype=np.int64)
        """Mode in effect: 0 off, 8 position, 10 torque."""
        self.braked = np.ones(n, dtype=bool)
        """Holding brake engaged."""
        self.brakes_changed = True
        """Set when a brake engages or releases; cleared by whoever has taken note."""
        self.torque = np.zeros(n)
        """τ of the last step: nominal motor torque at the joint, after dead zone and limit."""
        self.constant = False
        """No joint has a position loop in this period: `torque` holds for all its substeps."""
        self._limit = self._own_limit.copy()
        self._minus_limit = -self._limit
        self._minus_dead_zone = -self._dead_zone
        self._stiffness = np.zeros(n)
        self._damping = np.zeros(n)
        self._feedforward = np.zeros(n)
        self._target = np.zeros(n)
        self._goal = np.zeros(n)
        self._target_velocity = np.zeros(n)
        self._held: set[int] = set()
        self._hold_offset = np.zeros(n)
        self._hold_final = np.zeros(n)
        self._hold_elapsed = np.zeros(n)
        self._velocity = np.zeros(n)
        self._fractions = np.arange(substeps)[:, np.newaxis] / substeps
        self._bias = np.zeros((substeps, n))
        self._targets = np.zeros((substeps, n))
        self._count_stiffness = np.zeros(n)
        self.counts: list[int] = [0] * n
        self.per_mille: list[int] = [0] * n

        # Each drive sets its own joint at every SYNC: single numbers cost half as much in a memory view or a list.
        self._mode_of = self.mode.data
        self._target_of = _numbers(self._target)
        self._goal_of = _numbers(self._goal)
        self._target_velocity_of = _numbers(self._target_velocity)
        self._feedforward_of = _numbers(self._feedforward)
        self._zero_of: list[float] = self._units.zero_offset.tolist()
        self._radian_of: list[float] = self._units.radian_per_count.tolist()
        self._newton_metre_of: list[float] = self._units.newton_metre_per_mille.tolist()
        self._followed = [OFF] * n
        """Mode in which a joint follows set-points, its law set and its brake released; 0 while it does not."""
        self._limited_to = [UNKNOWN] * n
        """Limit of the last set-point [‰]."""

    def begin_period(self) -> None:
        """Lay out the coming period: what of x does not depend on the measurement, for every substep at once."""
        self.constant = POSITION not in self.mode.tolist()
        if self.constant:
            self.torque = self._torque_of(self._feedforward)
            return
        zero, resolution = self._units.zero_offset, self._units.radian_per_count
        targets = self._target + self._fractions * (self._goal - self._target)
        if self._asymmetry is not None:
            self._targets = targets - zero
            return
        self._bias = self._stiffness * (targets - zero) + self._damping * self._target_velocity + self._feedforward
        self._count_stiffness = self._stiffness * resolution

    def step(self, substep: int, position: Array, velocity: Array) -> Array:
        """Motor torques [N·m] in one substep of the period, at true joint positions and velocities, shape (n,)."""
        if not self.constant:
            # Counts as the drive reads them; k_p (zero + counts · resolution) is split between here and the bias.
            counts = np.rint((position - self._units.zero_offset) / self._units.radian_per_count)
            if self._asymmetry is None:
                effort = self._bias[substep] - counts * self._count_stiffness - velocity * self._damping
            else:
                stiffness, damping = self._gains_at(velocity, self._stiffness, self._damping)
                effort = stiffness * (self._targets[substep] - counts * self._units.radian_per_count)
                effort += damping * (self._target_velocity - velocity) + self._feedforward
            self.torque = self._torque_of(effort)
        return self.torque

    def _gains_at(self, velocity: Array, stiffness: Array, damping: Array) -> tuple[Array, Array]:
        """k_p (1 + α_p σ) and k_d (1 + α_d σ), σ = tanh(q̇/v₀)."""
        asymmetry = self._asymmetry
        if asymmetry is None:
            return stiffness, damping
        sigma = np.tanh(velocity / asymmetry.smoothing_velocity)
        return stiffness * (1.0 + asymmetry.position_gain * sigma), damping * (1.0 + asymmetry.velocity_gain * sigma)

    def _torque_of(self, effort: Array) -> Array:
        """τ of x: dead zone and limit."""
        torque = effort - np.maximum(np.minimum(effort, self._dead_zone), self._minus_dead_zone)
        limited: Array = np.maximum(np.minimum(torque, self._limit), self._minus_limit)
        return limited

    def end_period(self, position: Array, velocity: Array) -> None:
        """Close the interpolation at SYNC and sample encoder, velocity and current at the true state, shape (n,)."""
        self._target[:] = self._goal
        self._target_velocity.fill(0.0)
        if self._held:
            self._advance_holding()
        self.sample(position, velocity)

    def sample(self, position: Array, velocity: Array) -> None:
        """Sample encoder, velocity and current at the true state, shape (n,)."""
        self.counts = self._units.counts_from_position(position).tolist()
        self._velocity[:] = velocity
        reported = self.torque
        if self._noise > 0.0:
            reported = reported + self._noise * self._generator.standard_normal(len(reported))
        self.per_mille = self._units.per_mille_from_torque(reported).tolist()

    def power_off(self, joint: int) -> None:
        """Take the torque away and engage the brake."""
        self._set_law(joint, OFF, 0.0, 0.0, 0.0)
        self.torque[joint] = 0.0
        if not self.braked[joint]:
            self.braked[joint] = self.brakes_changed = True

    def follow_position(self, joint: int, counts: int, max_per_mille: int) -> None:
        """Mode 8: move to a target [counts] over one period; on entry into the mode jump there."""
        goal = self._zero_of[joint] + counts * self._radian_of[joint]
        if self._followed[joint] == POSITION:
            start = self._target_of[joint]
        else:
            start = self._target_of[joint] if self._mode_of[joint] == POSITION else goal
            self._target_of[joint] = start
            self._set_law(joint, POSITION, self._position_gain[joint], self._velocity_gain[joint], 0.0)
            self._follow(joint, POSITION)
        self._goal_of[joint] = goal
        self._target_velocity_of[joint] = (goal - start) / self._slope_time_s[joint]
        if max_per_mille != self._limited_to[joint]:
            self._limit_to(joint, max_per_mille)

    def follow_torque(self, joint: int, per_mille: int, max_per_mille: int) -> None:
        """Mode 10: give a torque [‰ of rated] from now on."""
        if self._followed[joint] != TORQUE:
            self._set_law(joint, TORQUE, 0.0, 0.0, 0.0)
            self._follow(joint, TORQUE)
        self._feedforward_of[joint] = per_mille * self._newton_metre_of[joint]
        if max_per_mille != self._limited_to[joint]:
            self._limit_to(joint, max_per_mille)

    def hold(self, joint: int) -> None:
        """Hold: take the target at which the position loop gives the torque now acting, then ramp its offset to zero.

        q_t = q + (D⁻¹(τ) + k_d q̇) / k_p with q̇_t = 0. From torque mode or power off the ramp ends at q; a drive that
        was following positions keeps its last target, and the ramp ends there. k_p and k_d are those of the drive's own
        law at q̇, asymmetric or not.
        """
        if joint in self._held:
            return
        one = slice(joint, joint + 1)
        stiffness, damping = self._gains_at(self._velocity[one], self._position_gain[one], self._velocity_gain[one])
        gains = FirmwareGains(stiffness, damping, self._dead_zone[one], self._limit[one])
        encoder = self._zero_of[joint] + self.counts[joint] * self._radian_of[joint]
        start = encoder + holding_offset(self.torque[one], self._velocity[one], gains).item()
        was_off = self.mode[joint] == OFF
        final = float(self._target[joint]) if self.mode[joint] == POSITION else encoder
        self._set_law(joint, POSITION, self._position_gain[joint], self._velocity_gain[joint], 0.0)
        if was_off:
            self._set_limit(joint, float(self._own_limit[joint]))
        self._held.add(joint)
        self._hold_offset[joint] = start - final
        self._hold_final[joint] = final
        self._hold_elapsed[joint] = 0.0
        self._move_target(joint, start, self._ramped(joint), 0.0)
        self._release(joint)

    def configure(self, joint: int, gains: AxisGains) -> None:
        """Set firmware parameters; they act at once.

        Raises:
            PlantError: a gain, a time or the rated torque is not positive (k_d: negative).

        """
        for field in dataclasses.fields(gains):
            value = getattr(gains, field.name)
            if value is not None and (value < 0.0 or (value == 0.0 and field.name != "velocity_gain")):
                raise PlantError(f"{self._names[joint]}: {field.name}: {value:g} is not above zero")
        if gains.position_gain is not None:
            self._position_gain[joint] = gains.position_gain
        if gains.velocity_gain is not None:
            self._velocity_gain[joint] = gains.velocity_gain
        if gains.torque_limit is not None:
            self._own_limit[joint] = gains.torque_limit
            self._set_limit(joint, float(self._limit[joint]) if self.mode[joint] != OFF else gains.torque_limit)
        if gains.hold_ramp_s is not None:
            self._hold_ramp_s[joint] = gains.hold_ramp_s
        if gains.rated_motor_torque is not None:
            scale = self._units.newton_metre_per_mille.copy()
            scale[joint] = np.copysign(gains.rated_motor_torque * self._gear[joint] / 1000.0, scale[joint])
            self._units = dataclasses.replace(self._units, newton_metre_per_mille=scale)
            self._newton_metre_of = scale.tolist()
            self._limited_to[joint] = UNKNOWN
        if self.mode[joint] == POSITION:
            self._stiffness[joint] = self._position_gain[joint]
            self._damping[joint] = self._velocity_gain[joint]

    def _set_law(self, joint: int, mode: int, stiffness: float, damping: float, feedforward: float) -> None:
        self.mode[joint] = mode
        self._stiffness[joint] = stiffness
        self._damping[joint] = damping
        self._feedforward[joint] = feedforward
        self._held.discard(joint)
        self._followed[joint] = OFF

    def _follow(self, joint: int, mode: int) -> None:
        self._followed[joint] = mode
        self._release(joint)

    def _move_target(self, joint: int, start: float, goal: float, velocity: float) -> None:
        self._target[joint] = start
        self._goal[joint] = goal
        self._target_velocity[joint] = velocity

    def _set_limit(self, joint: int, limit: float) -> None:
        limit = min(float(self._own_limit[joint]), limit)
        self._limit[joint] = limit
        self._minus_limit[joint] = -limit
        self._limited_to[joint] = UNKNOWN

    def _limit_to(self, joint: int, per_mille: int) -> None:
        self._set_limit(joint, per_mille * abs(self._newton_metre_of[joint]))
        self._limited_to[joint] = per_mille

    def _release(self, joint: int) -> None:
        if self.braked[joint]:
            self.braked[joint] = False
            self.brakes_changed = True

    def _ramped(self, joint: int) -> float:
        """Target one period from now."""
        remaining = 1.0 - (float(self._hold_elapsed[joint]) + self._period_s) / float(self._hold_ramp_s[joint])
        return float(self._hold_final[joint]) + float(self._hold_offset[joint]) * ramp_share(remaining)

    def _advance_holding(self) -> None:
        for joint in self._held:
            self._hold_elapsed[joint] += self._period_s
            self._move_target(joint, float(self._target[joint]), self._ramped(joint), 0.0)


def _numbers(array: Array) -> memoryview[float]:
    return array.data.cast("B").cast("d")
