"""The robot description: joints, drives, buses, sensors and safety limits, read from one YAML file beside a URDF."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from schemas.base import Model, Quaternion, Vector3
from schemas.world import UNIT_TOLERANCE

NodeId = Annotated[int, Field(ge=1, le=127)]
RESERVED_IDENTIFIERS = (0x000, 0x080, 0x77F)
"""NMT, SYNC and the heartbeat of the HAL, node 127."""
NODE_IDENTIFIERS = (0x080, 0x180, 0x280, 0x200, 0x300, 0x580, 0x600, 0x700)
"""Bases of a drive's EMCY, PDOs, SDOs and heartbeat."""
IMU_IDENTIFIERS = (0x21, 0x32, 0x34)
"""The maker's, of quaternion, gyro and acceleration."""

VIRTUAL_INTERFACE = "cosim"
"""The project's own python-can interface: a bus in user space."""
BUS_LINES = frozenset({"interface", "channel", "plant_channel", "bitrate"})
"""Fields of `Bus` that name the wire."""

NonNegative = Annotated[float, Field(ge=0.0)]


class Bus(Model):
    """One CAN bus, opened by python-can as `can.Bus(interface=…, channel=…, bitrate=…)`.

    All but the name are the bus lines: they say which wire a run is made on and change none of its messages.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    """Part of a Zenoh key and of a log's topic."""
    interface: Annotated[str, Field(min_length=1)] = VIRTUAL_INTERFACE
    channel: Annotated[str, Field(min_length=1)]
    """For `cosim` a socket path; a bare name lies in the run directory. For `socketcan` the interface's name."""
    plant_channel: Annotated[str, Field(min_length=1)] | None = None
    """The simulated robot's own channel where the HAL's is not its, e.g. the other one of two CAN cards on one wire."""
    bitrate: PositiveInt = 1_000_000

    def of_plant(self) -> Bus:
        """Give the bus as the simulated robot opens it."""
        if self.plant_channel is None:
            return self
        return self.model_copy(update={"channel": self.plant_channel, "plant_channel": None})

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.plant_channel is not None and self.interface == VIRTUAL_INTERFACE:
            raise ValueError(
                f"plant_channel {self.plant_channel!r}: a virtual bus ({VIRTUAL_INTERFACE}) has one channel for all;"
                " name the interface, e.g. socketcan, or leave plant_channel out"
            )
        return self


class Drive(Model):
    """A CiA 402 drive of one of the three HRP-style kinds, and its firmware as the maker states it.

    Firmware in the position modes: τ = D(k_p (q_t − q) + k_d (q̇_t − q̇)), clipped to the torque limit, where D is the
    current's dead zone D(x) = sign(x) max(|x| − d, 0); in torque mode τ = D(τ_t). All at the joint, in N·m and rad.
    Between two set-points the target q_t moves linearly; q̇_t is its slope, or zero (`velocity_reference`).
    """

    kind: Literal["position_pd", "torque", "servo"]
    bus: str
    node_id: NodeId
    rated_motor_torque: PositiveFloat
    """Of the motor, before the gear [N·m]; object 0x6076 holds it in mN·m and torques on the bus are ‰ of it."""
    position_gain: PositiveFloat
    """k_p [N·m/rad] at the joint."""
    velocity_gain: NonNegative
    """k_d [N·m·s/rad] at the joint."""
    dead_zone: NonNegative = 0.0
    """d [N·m] at the joint, as known to the HAL, which commands its inverse; the plant's may differ."""
    velocity_reference: Literal["interpolated", "zero"] = "interpolated"
    """q̇_t: the slope of the interpolated target, or zero, as HRP-2's drives have it: i = K₄ (q^d − q) − K₅ q̇, (5) of
    [Del Prete 2016]."""
    vendor_id: int = 0x00000402
    product_code: int = 0x00000001


class Joint(Model):
    """One actuated joint: its URDF joint's name, the gear and motor, limits, encoder and drive."""

    name: str
    gear_ratio: PositiveFloat
    rotor_inertia: NonNegative
    """[kg·m²] at the motor; the joint feels it times the square of the gear ratio."""
    torque_limit: PositiveFloat
    """[N·m] at the joint; enforced by the HAL and the drive."""
    torque_rate_limit: PositiveFloat
    """[N·m/s] at the joint; enforced by the HAL."""
    velocity_limit: PositiveFloat
    """[rad/s]; enforced by the HAL on commanded positions, a constraint for the controller."""
    position_min: float
    position_max: float
    encoder_counts: PositiveInt
    """Counts per turn of the motor."""
    direction: Literal[-1, 1] = 1
    """Sign of the drive's counts and torques against the URDF's axis."""
    zero_offset: float = 0.0
    """Joint angle [rad] at zero counts."""
    drive: Drive

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.position_min < self.position_max:
            raise ValueError(f"position_min {self.position_min} must lie below position_max {self.position_max}")
        counts = max(abs(self.position_min - self.zero_offset), abs(self.position_max - self.zero_offset))
        counts *= self.gear_ratio * self.encoder_counts / 6.283185307179586
        if counts >= 2**31:
            raise ValueError(f"the position range needs {counts:.3g} encoder counts, more than the bus's 32 bits hold")
        millinewtons = 1000.0 * self.drive.rated_motor_torque
        if abs(millinewtons - round(millinewtons)) > 1e-6:
            raise ValueError(
                f"rated_motor_torque {self.drive.rated_motor_torque} must be whole mN·m, as the bus holds it"
            )
        per_mille = 1000.0 * self.torque_limit / (self.drive.rated_motor_torque * self.gear_ratio)
        if per_mille > 32767:
            raise ValueError(f"torque_limit is {per_mille:.0f} ‰ of the rated torque, more than the bus's 16 bits hold")
        return self


class ForceTorqueSensor(Model):
    """A six-axis sensor with the Robotous RFT frame layout: two 8-byte frames a cycle, at `can_id` and `can_id + 1`."""

    name: str
    frame: str
    """URDF link whose frame is the sensor's; it measures the wrench that the parent side exerts on what lies beyond."""
    bus: str
    can_id: Annotated[int, Field(ge=1, le=0x7FE)]
    command_id: Annotated[int, Field(ge=1, le=0x7FF)]
    """Identifier the sensor listens on for start and stop."""
    force_resolution: PositiveFloat = 1.0 / 50.0
    """[N] a count."""
    torque_resolution: PositiveFloat = 1.0 / 2000.0
    """[N·m] a count."""


class Imu(Model):
    """An inertial unit with the Xsens MTi-600 frame layout: gyro, acceleration and quaternion frames a cycle."""

    name: str
    frame: str
    bus: str
    base_id: Annotated[int, Field(ge=0, le=0x7C0)]
    """Added to the maker's identifiers 0x32 (gyro), 0x34 (acceleration), 0x21 (quaternion), which outrank SYNC."""


class Capsule(Model):
    """A link's shape for collision avoidance: all points within `radius` of a segment fixed in the link's frame."""

    name: str
    link: str
    """URDF link."""
    start_in_link: Vector3
    end_in_link: Vector3
    radius: PositiveFloat


class LinkBox(Model):
    """A box fixed to a link, for the simulated contact of links whose URDF has only meshes."""

    name: Annotated[str, Field(min_length=1)]
    link: str
    """URDF link."""
    position_in_link: Vector3
    """Of its centre [m]."""
    half_sizes: tuple[PositiveFloat, PositiveFloat, PositiveFloat]
    """Along its own axes [m]."""
    orientation_to_link: Quaternion = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        norm = sum(value * value for value in self.orientation_to_link) ** 0.5
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise ValueError(f"orientation_to_link has the norm {norm:g}, expected a unit quaternion (w, x, y, z)")
        return self


class Safety(Model):
    """What the HAL does by itself, whatever the controller says."""

    missed_commands: PositiveInt = 5
    """Cycles in a row without a valid command after which the HAL stops (realtime clock)."""
    command_timeout_s: PositiveFloat = 5.0
    """Wall-clock wait in lockstep for a controller that hangs, before the safe stop; one that died shows at once, so
    this is long enough for a machine that is busy with other things."""
    sync_timeout_cycles: PositiveInt = 5
    """Cycles without SYNC or RPDO after which a drive holds by its own means."""
    hold_ramp_s: PositiveFloat = 0.2
    """Time over which a held torque offset goes over into the position loop."""
    holding: Literal["rule", "none"] = "rule"
    """`none` sets a commanded change from torque to position to the bare commanded position: the naive switch, for
    comparison in simulation only; the robot jumps. A safe stop follows the rule all the same."""
    heartbeat_s: Annotated[float, Field(ge=0.001, le=21.0)] = 0.1
    """Producer heartbeat of every node and of the HAL; three missing are a loss. Objects 0x1016 and 0x1017 hold whole
    milliseconds in 16 bits, and the loss is three of these."""
    bus_recovery_s: PositiveFloat = 10.0
    """Wall-clock patience of a safe stop with a bus that is down: the HAL holds the other buses and waits for it."""


class RobotDescription(Model):
    """Everything the HAL, the controller's model and the simulated plant need to know of a robot.

    The arrays of all messages follow the order of `joints`. Controller and plant read the same description; what
    differs in truth (masses, friction, torque scale) is perturbed in the plant by the scenario.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$")]
    urdf: str
    """Path relative to this file, absolute path, or `package://<Python package>/<path>`."""
    rate_hz: PositiveFloat
    command_delay_cycles: Literal[1, 2] = 1
    """The SYNC after the measured one at which a command takes effect."""
    compute_budget_s: PositiveFloat
    """Time from the last TPDO to the first RPDO that the cycle leaves for Zenoh and the controller."""
    hand_frame: str | None = None
    """URDF link that Cartesian tasks move."""
    buses: Annotated[tuple[Bus, ...], Field(min_length=1)]
    joints: Annotated[tuple[Joint, ...], Field(min_length=1)]
    force_torque_sensors: tuple[ForceTorqueSensor, ...] = ()
    imus: tuple[Imu, ...] = ()
    capsules: tuple[Capsule, ...] = ()
    """Shapes of links, for the controller's collision avoidance."""
    collision_pairs: tuple[tuple[str, str], ...] = ()
    """Names of capsules that are kept apart; every capsule is also kept from the obstacles that a scenario names."""
    contact_boxes: tuple[LinkBox, ...] = ()
    """Shapes that the simulated robot touches obstacles and itself with, beside the primitives of the URDF."""
    gravity_in_world: Vector3 = (0.0, 0.0, -9.81)
    safety: Safety = Safety()

    @property
    def period_s(self) -> float:
        """Length of a cycle [s]."""
        return 1.0 / self.rate_hz

    @property
    def period_ns(self) -> int:
        """Length of a cycle [ns], rounded once here: message k has time k times this."""
        return round(1e9 / self.rate_hz)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names in the order of all arrays."""
        return tuple(joint.name for joint in self.joints)

    def bus_index(self, name: str) -> int:
        """Index of a bus in `buses`."""
        return next(index for index, bus in enumerate(self.buses) if bus.name == name)

    @model_validator(mode="after")
    def _check(self) -> Self:
        _refuse_twice("bus", [bus.name for bus in self.buses])
        channels = [(bus.interface, {bus.channel, bus.of_plant().channel}) for bus in self.buses]
        _refuse_twice("bus channel", [f"{interface}:{name}" for interface, names in channels for name in sorted(names)])
        _refuse_twice("joint", [joint.name for joint in self.joints])
        sensors: tuple[ForceTorqueSensor | Imu, ...] = (*self.force_torque_sensors, *self.imus)
        _refuse_twice("sensor", [sensor.name for sensor in sensors])
        capsules = [capsule.name for capsule in self.capsules]
        _refuse_twice("capsule", capsules)
        _refuse_twice("contact box", [box.name for box in self.contact_boxes])
        for pair in self.collision_pairs:
            for capsule in pair:
                if capsule not in capsules:
                    raise ValueError(f"collision_pairs: unknown capsule {capsule!r}; there are {', '.join(capsules)}")
        names = {bus.name for bus in self.buses}
        users = [(joint.name, joint.drive.bus) for joint in self.joints]
        users += [(sensor.name, sensor.bus) for sensor in sensors]
        for user, channel in users:
            if channel not in names:
                raise ValueError(f"{user}: unknown bus {channel!r}; the buses are {', '.join(sorted(names))}")
        for bus in self.buses:
            self._check_identifiers(bus.name)
        return self

    def _check_identifiers(self, bus: str) -> None:
        """Refuse two users of one node id or CAN identifier: nobody could tell their frames apart."""
        nodes: dict[int, str] = {}
        identifiers = dict.fromkeys(RESERVED_IDENTIFIERS, "CANopen itself")
        for joint in self.joints:
            if joint.drive.bus == bus:
                _claim(nodes, joint.drive.node_id, joint.name, f"node id on bus {bus}")
                for base in NODE_IDENTIFIERS:
                    _claim(identifiers, base + joint.drive.node_id, joint.name, f"CAN identifier on bus {bus}")
        for sensor in self.force_torque_sensors:
            if sensor.bus == bus:
                for identifier in (sensor.can_id, sensor.can_id + 1, sensor.command_id):
                    _claim(identifiers, identifier, sensor.name, f"CAN identifier on bus {bus}")
        for imu in self.imus:
            if imu.bus == bus:
                for offset in IMU_IDENTIFIERS:
                    _claim(identifiers, imu.base_id + offset, imu.name, f"CAN identifier on bus {bus}")


def _refuse_twice(what: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{what} {name!r} is given twice")


def _claim(owners: dict[int, str], number: int, user: str, what: str) -> None:
    if number in owners:
        raise ValueError(f"{what}: {number} is used by {owners[number]} and by {user}")
    owners[number] = user
