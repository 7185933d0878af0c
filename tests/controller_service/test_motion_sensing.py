"""Algorithm 1 in every cycle: gravity at rest, late by the window, sensors that come late, seldom or no more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from controller_service.model import Array, RobotModel
from controller_service.motion_sensing import LONGEST_HOLD, MotionSensing
from controller_service.position_torque import Motors
from schemas.base import ControlMode
from schemas.control_law import PositionTorque
from schemas.load import Robot
from schemas.messages import AppliedCommand, DriveState, HalStatus, ImuSample, RobotState, WrenchSample
from schemas.robot import RobotDescription

POSTURE = np.array([0.1, -0.1, -0.5, -0.3, 0.2, -1.2, 0.1, 0.2, 0.1])
SENSORS = {
    "force_torque_sensors": [{"name": "wrist", "frame": "hand", "bus": "b2", "can_id": 0x100, "command_id": 0x110}],
    "imus": [{"name": "base", "frame": "base", "bus": "b0", "base_id": 0x400}],
}
WINDOW = 20
UPRIGHT = (0.0, 0.0, 9.81)


@pytest.fixture(scope="module")
def robot(arm: Robot) -> Robot:
    return Robot(RobotDescription.model_validate(arm.description.model_dump() | SENSORS), arm.urdf)


@pytest.fixture(scope="module")
def model(robot: Robot) -> RobotModel:
    return RobotModel(robot, ("hand",))


def sensing(robot: Robot, **fields: Any) -> MotionSensing:
    joints = robot.description.joints
    motors = {
        joint.name: {
            "torque_gain": 1.0 / joint.drive.position_gain,
            "velocity_gain": joint.drive.velocity_gain / joint.drive.position_gain,
        }
        for joint in joints
    }
    values = {"motors": motors, "savitzky_golay": {"window": WINDOW}} | fields
    config = PositionTorque.model_validate(values)
    return MotionSensing(robot, RobotModel(robot), config, Motors.of(config, robot.description.joint_names))


def state(
    sequence: int,
    position: Array = POSTURE,
    wrench: tuple[float, ...] | None = None,
    wrench_age: int = 0,
    specific_force: tuple[float, float, float] | None = None,
    imu_age: int = 0,
) -> RobotState:
    wrenches: tuple[WrenchSample, ...] = ()
    if wrench is not None:
        force, torque = tuple(wrench[:3]), tuple(wrench[3:])
        wrenches = (
            WrenchSample(name="other", force_in_sensor=(9.0, 9.0, 9.0), torque_in_sensor=(9.0, 9.0, 9.0)),
            WrenchSample(name="wrist", force_in_sensor=force, torque_in_sensor=torque, age_cycles=wrench_age),
        )
    imus: tuple[ImuSample, ...] = ()
    if specific_force is not None:
        imus = (
            ImuSample(
                name="base",
                angular_velocity_in_imu=(0.0, 0.0, 0.0),
                acceleration_in_imu=specific_force,
                orientation_imu_to_world=(1.0, 0.0, 0.0, 0.0),
                age_cycles=imu_age,
            ),
        )
    return RobotState(
        sequence=sequence,
        time_ns=2_000_000 * sequence,
        status=HalStatus.ACTIVE,
        position_measured=tuple(position.tolist()),
        motor_torque_measured=None,
        drive_state=(DriveState.OPERATION_ENABLED,) * 9,
        mode=(ControlMode.POSITION,) * 9,
        error_code=(0,) * 9,
        applied=AppliedCommand(sequence=-1, mode=ControlMode.POSITION, position=tuple(position.tolist())),
        wrenches=wrenches,
        imus=imus,
    )


def feed(one: MotionSensing, cycles: int = 1, **fields: Any) -> Any:
    at = state(0, **fields)
    return one.update(at, np.array(at.position_measured), cycles)


ESTIMATORS = ["savitzky_golay", "kalman"]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_at_rest_the_torque_is_that_of_gravity(robot: Robot, model: RobotModel, estimator: str) -> None:
    one = sensing(robot, estimator=estimator)
    gravity = model.configure(POSTURE, np.zeros(9)).gravity
    for _ in range(3 * WINDOW):
        motion = feed(one)
    assert motion.torque.torque == pytest.approx(gravity, abs=1e-6)
    assert motion.torque.link_torque == pytest.approx(gravity, abs=1e-6)
    assert motion.position == pytest.approx(POSTURE, abs=1e-9)
    assert np.abs(motion.velocity).max() < 1e-9
    assert one.delay_s == pytest.approx(0.5 * (WINDOW - 1) * 0.002 if estimator == "savitzky_golay" else 0.0)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_wrench_on_the_hand_is_felt_by_the_joints(robot: Robot, model: RobotModel, estimator: str) -> None:
    """τ̂ = g − Jᵀ f, the weight beyond the sensor taken from the reading: once it is in f, once in the links."""
    one = sensing(robot, estimator=estimator, sensor="wrist")
    now = model.configure(POSTURE, np.zeros(9))
    hand = now.frames["hand"]
    carried = 0.1 * hand.rotation.T @ [0.0, 0.0, 9.81]  # what holds the finger of 0.1 kg, its centre at the hand
    applied = np.array([5.0, -3.0, 8.0, 0.4, 0.2, -0.1])  # of the environment, in the sensor's frame
    reading = np.concatenate((carried, np.zeros(3))) - applied
    for _ in range(400):
        motion = feed(one, wrench=tuple(reading.tolist()))
    assert motion.torque.external_wrenches[0] == pytest.approx(applied, abs=1e-6)
    in_world = np.concatenate((hand.rotation @ applied[:3], hand.rotation @ applied[3:]))
    assert motion.torque.torque == pytest.approx(now.gravity - hand.jacobian.T @ in_world, abs=1e-6)


def test_a_calibrated_payload_and_its_offsets_replace_the_urdf_s(robot: Robot, model: RobotModel) -> None:
    payload = {
        "mass": 2.0,
        "centre_in_sensor": [0.0, 0.0, -0.1],
        "force_offset": [1.0, -2.0, 3.0],
        "torque_offset": [0.1, 0.2, -0.3],
    }
    one = sensing(robot, sensor="wrist", payload=payload)
    rotation = model.configure(POSTURE, np.zeros(9)).frames["hand"].rotation
    force = 2.0 * rotation.T @ [0.0, 0.0, 9.81]
    offsets = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    reading = np.concatenate((force, np.cross([0.0, 0.0, -0.1], force))) + offsets
    for _ in range(2 * WINDOW):
        motion = feed(one, wrench=tuple(reading.tolist()))
    assert motion.torque.external_wrenches[0] == pytest.approx(np.zeros(6), abs=1e-9)


def test_the_inertial_unit_says_how_the_base_is_carried(robot: Robot, model: RobotModel) -> None:
    """Twice the specific force, twice the torques; without the unit the base stands still."""
    with_unit, without = sensing(robot, imu="base"), sensing(robot)
    for _ in range(2 * WINDOW):
        doubled = feed(with_unit, specific_force=(0.0, 0.0, 2.0 * 9.81))
        fixed = feed(without, specific_force=(0.0, 0.0, 2.0 * 9.81))
    assert doubled.torque.torque == pytest.approx(2.0 * fixed.torque.torque, abs=1e-6)


def test_all_that_the_window_says_is_of_its_centre(robot: Robot) -> None:
    """On a parabola positions, velocities and accelerations are exact, `delay_s` late; missed cycles of a line too."""
    one, draw = sensing(robot), np.random.default_rng(0).standard_normal
    start, velocity, acceleration = draw(9), draw(9), draw(9)

    def at(time: float) -> Array:
        return np.asarray(start + velocity * time + 0.5 * acceleration * time**2)

    for k in range(3 * WINDOW):
        motion = feed(one, position=at(0.002 * k))
    then = 0.002 * (3 * WINDOW - 1) - one.delay_s
    assert motion.position == pytest.approx(at(then), abs=1e-9)
    assert motion.velocity == pytest.approx(velocity + acceleration * then, abs=1e-7)
    assert motion.acceleration == pytest.approx(acceleration, abs=1e-4)

    sparse, k = sensing(robot), 0
    feed(sparse, position=start)
    for gap in (1, 2, 5, 1, 3) * 4:
        k += gap
        line = feed(sparse, gap, position=start + 0.002 * k * velocity)
    assert line.position == pytest.approx(start + (0.002 * k - sparse.delay_s) * velocity, abs=1e-9)
    assert line.velocity == pytest.approx(velocity, abs=1e-7)


def test_it_is_ready_when_every_sensor_has_filled_its_window(robot: Robot) -> None:
    """And not before the first reading of the last one, however long that takes: nothing is refused meanwhile."""
    one, seen = sensing(robot, sensor="wrist", imu="base", savitzky_golay={"window": 4}), []
    for k in range(40):
        feed(one, wrench=(0.0,) * 6, specific_force=UPRIGHT if k >= 30 else None)
        seen.append(one.ready)
    assert seen == [False] * 33 + [True] * 7
    plain, seen = sensing(robot), []
    for _ in range(WINDOW + 1):
        feed(plain)
        seen.append(plain.ready)
    assert seen == [False] * (WINDOW - 1) + [True, True]
    kalman = sensing(robot, estimator="kalman", sensor="wrist")
    feed(kalman)
    assert not kalman.ready
    feed(kalman, wrench=(0.0,) * 6)
    assert kalman.ready


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(("used", "name"), [({"sensor": "wrist"}, "wrist"), ({"imu": "base"}, "base")])
@pytest.mark.parametrize("repeats", [False, True])
def test_a_sensor_that_is_silent_for_long_is_told_and_its_window_filled_anew(
    robot: Robot, estimator: str, used: dict[str, str], name: str, repeats: bool
) -> None:
    """Whether its last reading is repeated or missing from the state."""
    one, reading = sensing(robot, estimator=estimator, **used), {"wrench": (0.0,) * 6, "specific_force": UPRIGHT}

    def silent(age: int) -> dict[str, Any]:
        return reading | {"wrench_age": age, "imu_age": age} if repeats else {}

    for _ in range(200):
        feed(one, **reading)
    assert one.ready
    for age in range(1, LONGEST_HOLD + 1):
        feed(one, **silent(age))
        assert one.silent is None
        assert one.ready
    feed(one, **silent(LONGEST_HOLD + 1))
    assert one.silent == (name, LONGEST_HOLD + 1)
    assert not one.ready
    feed(one, **reading)
    assert one.silent is None
    assert one.ready is (estimator == "kalman")
    for _ in range(200):
        feed(one, **reading)
    assert one.ready


@pytest.mark.parametrize("used", [{"sensor": "wrist"}, {"imu": "base"}])
def test_a_sensor_that_speaks_again_in_time_is_believed_again(robot: Robot, used: dict[str, str]) -> None:
    one, reading = sensing(robot, **used), {"wrench": (0.0,) * 6, "specific_force": UPRIGHT}
    for _ in range(4):
        feed(one, **reading)
        for _ in range(LONGEST_HOLD):
            feed(one)
            assert one.silent is None
    feed(one, LONGEST_HOLD + 5, **reading)
    assert one.silent is None
    feed(one, LONGEST_HOLD + 1)
    assert one.silent is not None


def test_a_reading_that_came_with_a_missed_state_counts(robot: Robot) -> None:
    """A sensor at half the rate, and a controller that misses just the states with the new readings."""
    one = sensing(robot, sensor="wrist")
    for k in range(40):
        motion = feed(one, 2, wrench=(float(k), 0.0, 0.0, 0.0, 0.0, 0.0), wrench_age=1)
    assert one.ready
    late = (2 * 39 - 0.5 * (WINDOW - 1)) / 2.0
    still = feed(sensing(robot, sensor="wrist"), wrench=(0.0,) * 6).torque.external_wrenches[0]
    assert motion.torque.external_wrenches[0][0] == pytest.approx(still[0] - late, abs=0.5)


def test_the_kalman_filter_follows_the_drives(robot: Robot, model: RobotModel) -> None:
    """Told what the drives go to, it knows accelerations that positions alone show later."""
    now, joints = model.configure(POSTURE, np.zeros(9)), robot.description.joints
    stiffness = np.array([joint.drive.position_gain for joint in joints])
    damping = np.array([joint.drive.velocity_gain for joint in joints])
    hold = POSTURE + now.gravity / stiffness

    def error(told: bool) -> float:
        one, squares = sensing(robot, estimator="kalman"), []
        position, velocity, before = POSTURE.copy(), np.zeros(9), hold
        for k in range(90):
            target = hold + (0.02 * np.sin(0.2 * (k - 50)) ** 2 if k >= 50 else 0.0)
            acceleration = np.linalg.solve(now.mass, stiffness * (before - position) - damping * velocity - now.gravity)
            motion = feed(one, position=position)
            if k > 50:
                squares.append(np.square(motion.acceleration - acceleration).mean())
            if told:
                at = state(k)
                applied = at.applied.model_copy(update={"position": tuple(target.tolist())})
                one.remember(now, motion, at.model_copy(update={"applied": applied}), np.zeros(9))
            for substep in range(20):  # the drives go to a target within the period
                between = before + (substep + 0.5) / 20 * (target - before)
                torque = stiffness * (between - position) - damping * velocity
                velocity = velocity + 1e-4 * np.linalg.solve(now.mass, torque - now.gravity)
                position = position + 1e-4 * velocity
            before = target
        return float(np.sqrt(np.mean(squares)))

    assert error(told=True) < 0.5 * error(told=False)
