"""An identification of motors that never were: drives with dead zone, stiction and gains that depend on the sign."""

from __future__ import annotations

import numpy as np

from deploy.identify import Identification, IdentifyOptions, JointIdentification, fit_joint
from deploy.motor_data import MotorData
from schemas.load import load_run

RUN = load_run("leg6-high-velocity")
HALF = 6000
"""Samples of each collection."""


def made_up_data() -> MotorData:
    """Slow large torques, then fast motion, of all joints."""
    phase = np.linspace(0.0, 60.0, HALF)[:, np.newaxis]
    joints = RUN.robot.description.joints
    limit = np.array([joint.torque_limit for joint in joints])
    speed = np.array([joint.velocity_limit for joint in joints])
    spread = np.arange(len(joints))
    torque = np.vstack((0.6 * limit * np.sin(phase + spread), 0.1 * limit * np.sin(2.3 * phase + spread)))
    creep = 0.01 * np.cos(phase + spread) + 0.0 * limit
    velocity = np.vstack((creep, 0.7 * speed * np.cos(1.7 * phase + spread)))
    stiffness = np.array([joint.drive.position_gain for joint in joints])
    damping = np.array([joint.drive.velocity_gain for joint in joints])
    sign = np.tanh(velocity / 0.02)
    effort = (torque + 6.0 * np.tanh(velocity / 0.005) + 12.8 * velocity) / 0.9
    effort += 3.0 * np.sign(effort)
    offset = (effort + damping * (1.0 + 0.1 * sign) * velocity) / (stiffness * (1.0 + 0.1 * sign))
    limited = np.zeros(offset.shape, dtype=np.bool_)
    return MotorData(RUN.robot.description.joint_names, offset, torque, velocity, limited, 2 * HALF, {})


def made_up_identification(options: IdentifyOptions | None = None) -> Identification:
    """Identify the made-up motors."""
    options, data = options or IdentifyOptions(), made_up_data()
    joints = tuple(
        JointIdentification(joint.name, fit_joint(joint, data.of(index), options), 0.6, 0.7, 0)
        for index, joint in enumerate(RUN.robot.description.joints)
    )
    return Identification(RUN.robot.description, options, joints, data)
