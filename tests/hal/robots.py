"""Small robots and hand-made reports for the tests of the HAL's core."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from schemas.robot import Bus, Drive, ForceTorqueSensor, Imu, Joint, RobotDescription, Safety

ENABLED = 0x0627
FAULT = 0x0208


def robot(*kinds: str, joint: dict[str, Any] | None = None, drive: dict[str, Any] | None = None, **fields: Any) -> Any:
    """A robot with one joint of each kind given, alternating over two buses `a` and `b`; node ids 1, 2, …"""
    joints = []
    for index, kind in enumerate(kinds):
        drive_fields: dict[str, Any] = {
            "kind": kind,
            "bus": "ab"[index % 2],
            "node_id": index + 1,
            "rated_motor_torque": 0.5,
            "position_gain": 4000.0,
            "velocity_gain": 40.0,
            "dead_zone": 2.0,
        } | (drive or {})
        joint_fields: dict[str, Any] = {
            "name": f"j{index}",
            "gear_ratio": 100.0,
            "rotor_inertia": 1e-5,
            "torque_limit": 100.0,
            "torque_rate_limit": 20000.0,
            "velocity_limit": 5.0,
            "position_min": -2.0,
            "position_max": 2.0,
            "encoder_counts": 4096,
            "direction": -1 if index % 2 else 1,
            "zero_offset": 0.1 * index,
        } | (joint or {})
        joints.append(Joint(drive=Drive(**drive_fields), **joint_fields))
    options: dict[str, Any] = {
        "name": "test",
        "urdf": "none",
        "rate_hz": 500.0,
        "compute_budget_s": 0.001,
        "buses": (Bus(name="a", channel="a"), Bus(name="b", channel="b")),
        "joints": tuple(joints),
        "safety": Safety(missed_commands=3, hold_ramp_s=0.02),
    } | fields
    return RobotDescription(**options)


def wrist() -> ForceTorqueSensor:
    return ForceTorqueSensor(name="wrist", frame="hand", bus="b", can_id=0x50, command_id=0x52)


def imu() -> Imu:
    return Imu(name="imu", frame="base", bus="a", base_id=0x400)


def frame(can_id: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data), data)


def report(node: int, counts: int = 0, per_mille: int = 0, statusword: int = ENABLED) -> bytes:
    return frame(0x180 + node, struct.pack("<Hih", statusword, counts, per_mille))


def mode_report(node: int, mode: int, error: int = 0) -> bytes:
    return frame(0x280 + node, struct.pack("<bH", mode, error))


def by_bus(description: RobotDescription, frames: Sequence[bytes]) -> list[bytes]:
    """One frame a joint, in the order of the joints, sorted into the buses."""
    buses = [b"", b""]
    for joint, part in zip(description.joints, frames, strict=True):
        buses[description.bus_index(joint.drive.bus)] += part
    return buses
