"""The messages of a running robot: one writer each, any number of readers.

Units are SI: rad, rad/s, N·m (at the joint, after the gear), s, m, N; times are integer nanoseconds of the run's clock
(simulated in lockstep). `sequence` counts SYNCs from 0: a message with sequence k belongs to the SYNC at k periods.
Names say where a number comes from: *measured* (decoded from the bus), *estimated* (computed by the controller),
*commanded* (asked by the controller), *applied* (put on the bus by the HAL after its limits), *true* (plant only).
"""

from __future__ import annotations

from enum import IntEnum, StrEnum
from typing import Literal

from pydantic import ConfigDict, Field

from schemas.base import ControlMode, Model, Quaternion, Vector, Vector3


class DriveState(IntEnum):
    """The states of the CiA 402 power state machine."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class HalStatus(StrEnum):
    """Who decides what the drives do."""

    ACTIVE = "active"
    """Commands of the controller are applied, within the HAL's limits."""
    SAFE_STOP = "safe_stop"
    """The HAL holds the robot by itself; commands are refused until the run ends."""
    EMERGENCY_STOP = "emergency_stop"
    """As `safe_stop`, latched by an operator or a signal; only an explicit reset clears it."""


class WrenchSample(Model):
    """A force/torque sensor's reading, as measured: force and moment in the sensor's frame at its origin."""

    name: str
    force_in_sensor: Vector3
    torque_in_sensor: Vector3
    age_cycles: int = 0
    """How many cycles ago the frames arrived; 0 is this cycle."""


class ImuSample(Model):
    """An inertial unit's reading, as measured: angular velocity [rad/s] and specific force [m/s²] in its frame."""

    name: str
    angular_velocity_in_imu: Vector3
    acceleration_in_imu: Vector3
    orientation_imu_to_world: Quaternion
    age_cycles: int = 0


class AppliedCommand(Model):
    """What the HAL put on the bus and the drives latched at this state's SYNC.

    `position` [rad] is the firmware's target in the position modes, `torque` [N·m] the motor torque in torque mode,
    `torque_limit` [N·m] the limit in servo mode; what a mode does not use is absent.
    """

    sequence: int
    """The state this command answered; −1 for what the HAL decided by itself."""
    mode: ControlMode
    position: Vector | None = None
    torque: Vector | None = None
    torque_limit: Vector | None = None


class RobotState(Model):
    """What the robot reported at one SYNC; written by the HAL on `…/state`."""

    sequence: int
    time_ns: int
    status: HalStatus
    position_measured: Vector
    motor_torque_measured: Vector | None
    """From the motor current, at the drive's nominal torque constant and times the gear; None: drives report none."""
    drive_state: tuple[DriveState, ...]
    mode: tuple[ControlMode, ...]
    """The mode each drive reported last."""
    error_code: tuple[int, ...]
    """CiA 402 object 0x603F of each drive, 0 is none."""
    applied: AppliedCommand
    wrenches: tuple[WrenchSample, ...] = ()
    imus: tuple[ImuSample, ...] = ()


class JointCommand(Model):
    """The controller's answer to one state; on `…/command`. Refused by the HAL unless complete for its mode.

    position: `position` [rad]; torque: `torque` [N·m motor torque at the joint]; servo: `position` and `torque_limit`.
    """

    session: str
    """Identity of the controller process: the HAL obeys one session only."""
    sequence: int
    time_ns: int
    mode: ControlMode
    position: Vector | None = None
    torque: Vector | None = None
    torque_limit: Vector | None = None


class PoseSample(Model):
    """Position [m] and orientation of a frame in the world."""

    position_in_world: Vector3
    orientation_to_world: Quaternion


class MotionTrace(Model):
    """What Algorithm 1 of [Del Prete 2016] makes of encoders, inertial unit and force/torque sensor."""

    delay_s: float
    """All of it is of this long ago."""
    position: Vector
    """q̂ [rad]."""
    velocity: Vector
    """q̇̂ [rad/s]."""
    acceleration: Vector
    """q̈̂ [rad/s²]."""
    torque: Vector
    """τ̂ [N·m]: motor torque less friction, with the rotors' reflected inertia, as in (6)."""
    link_torque: Vector
    """[N·m] what a sensor behind the gear would measure: without the rotors' inertia."""
    base_wrench: Vector
    """[N, N·m] what the mount of the base exerts, in its axes at its origin."""


class OffsetTrace(Model):
    """The parts of Δq in (13) and (14) of [Del Prete 2016] [rad], and what they follow."""

    position_desired: Vector
    """q^d [rad]."""
    velocity_desired: Vector
    acceleration_desired: Vector
    torque_desired: Vector
    """M q̈^d + ĥ − Jᵀ f^d [N·m], or the QP's."""
    torque: Vector
    """Feed-forward torque."""
    friction: Vector
    """Feed-forward friction."""
    position: Vector
    """K₆ e_q."""
    velocity: Vector
    """K₇ ė_q."""
    acceleration: Vector
    """K₈ ë_q, or K_τ K_p e_τ with the QP's τ^d."""
    force: Vector
    """K₉ e_f."""
    integral: Vector
    limited: tuple[str, ...] = ()
    """Limits that act, by joint."""


class ControllerTrace(Model):
    """Every term of the control law at one tick; on `…/trace`. Symbols of [Benallegue 2021] in brackets."""

    sequence: int
    time_ns: int
    phase: str
    mode: ControlMode
    position_estimated: Vector
    velocity_estimated: Vector
    acceleration_reference: Vector
    """q̈ʳ, the QP's solution [rad/s²]."""
    velocity_reference: Vector
    """q̇ʳ, its integral [rad/s]."""
    velocity_error: Vector
    """s = q̇ʳ − q̇ [rad/s]."""
    torque_reference: Vector
    """uʳ of (2) [N·m]."""
    torque_integral: Vector
    """All that the law adds to uʳ for the velocity error [N·m]: L s of (3), or the terms after uʳ in (21), limited."""
    torque_windup: Vector = ()
    """u_K before the anti-windup's limit [N·m]; this and the next seven are empty outside torque mode."""
    torque_limited: Vector = ()
    """ũ_K of (11) [N·m], part of `torque_integral`."""
    windup_bound: Vector = ()
    """Bound of ũ_K in effect [N·m]: τ_m, or more after a change of mode."""
    torque_friction: Vector = ()
    """Friction compensation [N·m]; empty without."""
    null_space_share: float = 0.0
    """σ: 0 is the law (3), 1 the null-space compliant law (21)."""
    torque_external_estimated: Vector = ()
    """Of the momentum observer, as Jᵀ F of the environment on the robot [N·m]; empty without."""
    contact: bool = False
    """The observer's estimate is over its thresholds."""
    wrench_estimated: Vector = ()
    """Of the environment on the hand: force [N], moment [N·m] at the hand frame's origin, world axes; empty without."""
    wrench_reference: Vector = ()
    """Fʳ, as the above."""
    admittance: bool = False
    """The hand follows the wrench."""
    relaxed: tuple[str, ...] = ()
    """Limits that could not be kept this tick, by name."""
    torque_commanded: Vector
    """u of (3), or the computed torque while in position mode [N·m]."""
    position_reference: Vector
    """State of the open-loop double integration of q̈ʳ in position mode; the measured position in torque mode."""
    hand_desired: PoseSample | None
    hand_estimated: PoseSample | None
    qp_iterations: int
    qp_primal_residual: float
    qp_dual_residual: float
    qp_status: str
    estimated: MotionTrace | None = None
    """With `controller.position_torque`: Algorithm 1 of [Del Prete 2016]."""
    offset: OffsetTrace | None = None
    """Under torque control through the position interface."""


class ContactSample(Model):
    """All contacts of a link with an obstacle or with another link, the one nearer the base, summed."""

    link: str
    other: str
    force_in_world: Vector3
    """[N] on `link`."""
    position_in_world: Vector3
    """[m] mean of the points, weighted by the norms of their forces."""


class PlantTruth(Model):
    """The simulated robot as it really is; on `…/truth`. For evaluation only: the controller never subscribes.

    Arrays per joint; `*_substeps` holds one row per firmware step of the period that ended at this SYNC, oldest first
    (empty at sequence 0).
    """

    sequence: int
    time_ns: int
    position: Vector
    velocity: Vector
    acceleration: Vector
    mode: tuple[int, ...]
    """CiA 402 mode in effect during the period that ended here (object 0x6061), 0 when the power stage is off."""
    drive_state: tuple[DriveState, ...]
    motor_torque: Vector
    """Motor torque acting now, at the joint after the gear, torque scale error included [N·m]."""
    motor_torque_substeps: tuple[Vector, ...]
    friction_torque: Vector
    """Torque of joint friction, opposing motion [N·m]."""
    frames: dict[str, PoseSample]
    """True poses of the frames named in the scenario."""
    sensor_wrenches: dict[str, tuple[Vector3, Vector3]] = Field(default_factory=dict)
    """Force and moment each F/T sensor would read without noise, offset and quantisation, in the sensor frame."""
    contact_force: float = 0.0
    """Sum of the norms of all contact forces [N]."""
    contacts: tuple[ContactSample, ...] = ()
    """One a pair that touches, in the order of MuJoCo's contacts."""
    world_forces: dict[str, Vector3] = Field(default_factory=dict)
    """Force [N] in the world of each of the scenario's events that acts, by its name."""
    kinetic_energy: float = 0.0
    """[J], rotors included."""


class BusFrames(Model):
    """All frames of one bus in one cycle, as `struct can_frame` (16 bytes each) in bus order; on `…/bus/<name>`."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    sequence: int
    """−1 for the frames of the boot."""
    time_ns: int
    bus: str
    sent: bytes
    received: bytes


class FrameStatistics(Model):
    """What became of the frames of one identifier."""

    can_id: int
    frames: int
    """Frames that were transmitted."""
    late: int = 0
    """Of these, commands that were on the bus only after the SYNC that was to latch them."""
    replaced: int = 0
    """Frames never transmitted: a newer one of the same sender and identifier took their place in the mailbox."""
    wait_mean_s: float = 0.0
    """From the moment a frame was ready to the start of its transmission."""
    wait_max_s: float = 0.0


class BusStatistics(Model):
    """Timing of one bus since the last message; on `…/load/<bus>`, by the plant, in the bus's own (simulated) time.

    A cycle begins at the time of its SYNC. Times of completion count from there and may exceed the period.
    """

    sequence: int
    time_ns: int
    bus: str
    cycles: int
    load_mean: float
    """Share of the time in which the bus was taken, interframe spaces included."""
    load_max: float
    """Of the busiest cycle."""
    report_end_max_s: float
    """Latest end of an answer to a SYNC."""
    command_end_max_s: float
    """Latest end of a command."""
    frames: tuple[FrameStatistics, ...]
    """In the order of the identifiers."""


class Event(Model):
    """Something that happened once: a mode change, a fault, a refusal, an operator's action; on `…/event`."""

    sequence: int
    time_ns: int
    service: str
    kind: str
    """A short constant name, e.g. `command_refused`, `mode_change`, `safe_stop`, `drive_fault`, `peer_lost`."""
    severity: Literal["info", "warning", "error"]
    text: str
    joint: str | None = None


class CycleStatistics(Model):
    """Wall-clock figures of one service's last second; on `…/health`. Not repeatable, unlike everything else."""

    service: str
    sequence: int
    time_ns: int
    cycles: int
    cycle_time_median_s: float
    cycle_time_p99_s: float
    cycle_time_max_s: float
    cycle_time_counts: tuple[tuple[int, int], ...] = ()
    """Histogram as pairs (bin, cycles) in the order of the bins: bin b holds durations from 10^(b/100) µs to
    10^((b+1)/100) µs, 2.3 % wide; the counts of several messages may be added (`schemas.statistics.percentile`)."""
    late_cycles: int = 0
    missed_commands: int = 0
    real_time_factor: float


class OperatorRequest(Model):
    """What a person asks of the HAL; on `…/operator`, written by `cosim stop`."""

    action: Literal["stop", "reset"]
    reason: str = ""
