"""Torques from motion and wrenches: against the equations of motion, whole and floating, for JVRC-1's right leg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

from controller_service.base_motion import BaseMotion
from controller_service.errors import StateError
from controller_service.ft_calibration import Payload
from controller_service.model import Array, RobotModel
from controller_service.torque_estimation import TorqueEstimator
from controller_service.wrench import HandWrenchEstimator
from schemas.control_law import HandForce
from schemas.errors import ConfigurationError
from schemas.load import Robot, load_robot
from schemas.messages import WrenchSample

JOINTS = ("R_HIP_P", "R_HIP_R", "R_HIP_Y", "R_KNEE", "R_ANKLE_R", "R_ANKLE_P")
FRAMES = {"ankle": "R_ANKLE_P_S", "toe": "rfsensor", "knee": "R_KNEE_S", "trunk": "PELVIS_S", "wrist": "r_wrist"}
"""Sensors by the link they are on: the foot, fixed to the foot, inside the chain, between base and leg, locked arm."""
GRAVITY = np.array([0.0, 0.0, -9.81])
REST = BaseMotion.at_rest(GRAVITY)
PUSH = np.array([11.0, -7.0, 230.0, 8.0, -5.0, 3.0])


def describe(order: tuple[str, ...] = JOINTS) -> dict[str, Any]:
    joints = [
        {
            "name": name,
            "gear_ratio": 100 + 10 * i,
            "rotor_inertia": 4e-5,
            "torque_limit": 150,
            "torque_rate_limit": 15000,
            "velocity_limit": 5,
            "position_min": -2,
            "position_max": 2,
            "encoder_counts": 4096,
            "drive": {
                "kind": "position_pd",
                "bus": "leg-0",
                "node_id": i + 1,
                "rated_motor_torque": 0.5,
                "position_gain": 8000,
                "velocity_gain": 100,
            },
        }
        for i, name in sorted(enumerate(JOINTS), key=lambda pair: order.index(pair[1]))
    ]
    sensors = [
        {"name": name, "frame": frame, "bus": "leg-0", "can_id": 0x1C0 + 2 * i, "command_id": 0x1D0 + i}
        for i, (name, frame) in enumerate({**FRAMES, "root": "base_link", "same": "R_ANKLE_P_S"}.items())
    ]
    return {
        "name": "leg",
        "urdf": "package://jvrc_description/urdf/jvrc1.urdf",
        "rate_hz": 1000,
        "command_delay_cycles": 2,
        "compute_budget_s": 0.0003,
        "buses": [{"name": "leg-0", "channel": "leg-0"}],
        "joints": joints,
        "force_torque_sensors": sensors,
    }


def load(path: Path, **changes: Any) -> Robot:
    path.write_text(yaml.safe_dump(describe(**changes)), encoding="utf-8")
    return load_robot(str(path), allow_overload=True)


@pytest.fixture(scope="module")
def leg(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load(tmp_path_factory.mktemp("leg") / "leg.yaml")


class World:
    """The leg on a free flyer at any pose and speed in a world with gravity."""

    def __init__(self, robot: Robot) -> None:
        model = pin.buildModelFromXML(robot.urdf, pin.JointModelFreeFlyer())
        locked = [i for i in range(2, model.njoints) if model.names[i] not in JOINTS]
        self.model = pin.buildReducedModel(model, locked, pin.neutral(model))
        armature = [joint.rotor_inertia * joint.gear_ratio**2 for joint in robot.description.joints]
        self.model.armature = np.concatenate((np.zeros(6), armature))
        self.model.gravity = pin.Motion(GRAVITY, np.zeros(3))
        self.data = self.model.createData()

    def motion(self, seed: int) -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(seed)
        turn = pin.Quaternion(pin.exp3(rng.normal(size=3))).coeffs()
        q = np.concatenate((rng.normal(size=3), turn, rng.uniform(-1.0, 1.0, 6)))
        return q, 2.0 * rng.normal(size=12), 5.0 * rng.normal(size=12)

    def fixed(self, seed: int) -> tuple[Array, Array, Array]:
        """At a motion of the joints alone."""
        q, v, a = self.motion(seed)
        q[:7], v[:6], a[:6] = [0, 0, 0, 0, 0, 0, 1], 0.0, 0.0
        return q, v, a

    def rows(self, q: Array, v: Array, a: Array, wrenches: dict[str, Array] | None = None) -> Array:
        """All twelve rows of the equations of motion; `wrenches`: environment on links, in their frames."""
        external = [pin.Force.Zero() for _ in self.model.joints]
        for link, wrench in (wrenches or {}).items():
            frame = self.model.frames[self.model.getFrameId(link, pin.FrameType.BODY)]
            external[frame.parentJoint] += frame.placement.act(pin.Force(wrench))
        rows: Array = pin.rnea(self.model, self.data, q, v, a, external).copy()
        return rows

    def reading(self, joint: str) -> Array:
        """What passes a joint, at the last `rows`, in the frame of the link beyond it."""
        reading: Array = self.data.f[self.model.getJointId(joint)].vector.copy()
        return reading

    def base(self, q: Array, v: Array, a: Array) -> BaseMotion:
        turn = pin.Quaternion(q[3:7]).matrix()
        return BaseMotion(v[3:6], a[3:6], a[:3] + np.cross(v[3:6], v[:3]) - turn.T @ GRAVITY)

    def jacobian(self, q: Array, link: str) -> Array:
        """J_u (6, 12) in the link's axes."""
        index = self.model.getFrameId(link, pin.FrameType.BODY)
        jacobian: Array = pin.computeFrameJacobian(self.model, self.data, q, index, pin.LOCAL)
        return jacobian

    def balanced(self, q: Array, v: Array, a: Array, wrenches: dict[str, Array]) -> Array:
        """v̇ with the base's part such that nothing but `wrenches` holds the robot."""
        mass = pin.crba(self.model, self.data, q)
        a = a.copy()
        a[:6] -= np.linalg.solve(mass[:6, :6], self.rows(q, v, a, wrenches)[:6])
        return a


@pytest.fixture(scope="module")
def world(leg: Robot) -> World:
    return World(leg)


@pytest.mark.parametrize("seed", range(6))
def test_a_fixed_base_s_torques_are_those_of_the_equation_of_motion(leg: Robot, world: World, seed: int) -> None:
    """τ = M q̈ + h − Jᵀ f of the controller's own model, f exerted on the foot, in world axes."""
    q, v, a = world.fixed(seed)
    world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    estimate = TorqueEstimator(leg, ("ankle",)).estimate(q[7:], v[6:], a[6:], REST, [world.reading("R_ANKLE_P")])
    rigid = RobotModel(leg, ("R_ANKLE_P_S",))
    now = rigid.configure(q[7:], v[6:])
    foot = now.frames["R_ANKLE_P_S"]
    force = PUSH.reshape(2, 3).dot(foot.rotation.T).ravel()
    expected = now.mass @ a[6:] + now.nonlinear - foot.jacobian.T @ force
    assert np.allclose(estimate.torque, expected, atol=1e-9)
    # Weight and inertia of the foot are taken out of the reading
    assert np.allclose(estimate.external_wrenches[0], PUSH, atol=1e-9)
    armature = np.array([joint.rotor_inertia * joint.gear_ratio**2 for joint in leg.description.joints])
    assert np.allclose(estimate.torque - estimate.link_torque, armature * a[6:], atol=1e-12)
    assert estimate.residual == 0.0
    # The mount carries what the base's six equations of motion lack
    assert np.allclose(estimate.base_wrench, world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})[:6], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_touches_the_foot_in_motion(leg: Robot, world: World, seed: int) -> None:
    q, v, a = world.motion(seed)
    rows = world.rows(q, v, a)
    readings = [world.reading("R_ANKLE_P")]
    estimate = TorqueEstimator(leg, ("ankle",)).estimate(q[7:], v[6:], a[6:], world.base(q, v, a), readings)
    assert np.abs(readings[0]).max() > 1.0
    assert np.allclose(estimate.external_wrenches[0], 0.0, atol=1e-9)
    assert np.allclose(estimate.torque, rows[6:], atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_a_base_that_moves_gives_the_whole_floating_equations(leg: Robot, world: World, seed: int) -> None:
    q, v, a = world.motion(seed)
    rows = world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    reading, base = world.reading("R_ANKLE_P"), world.base(q, v, a)
    floating = TorqueEstimator(leg, ("ankle",), base="floating")
    estimate = floating.estimate(q[7:], v[6:], a[6:], base, [reading])
    assert np.allclose(estimate.torque, rows[6:], atol=1e-9)
    assert np.allclose(estimate.base_wrench, rows[:6], atol=1e-9)
    # (2): without an unknown wrench the base's rows are the remainder
    assert estimate.residual == pytest.approx(np.linalg.norm(rows[:6]))
    # Neither pose nor speed of the base counts, only what a gyroscope and an accelerometer feel
    still = TorqueEstimator(leg, ("ankle",)).estimate(q[7:], v[6:], a[6:], REST, [reading])
    assert np.abs(still.torque - estimate.torque).max() > 0.1
    other, other_v, other_a = q.copy(), v.copy(), a.copy()
    other[:7], other_v[:3] = world.motion(seed + 50)[0][:7], [3.0, -1.0, 2.0]
    turn = pin.Quaternion(other[3:7]).matrix()
    other_a[:3] = base.acceleration + turn.T @ GRAVITY - np.cross(v[3:6], other_v[:3])
    assert np.allclose(world.rows(other, other_v, other_a, {"R_ANKLE_P_S": PUSH}), rows, atol=1e-8)


@pytest.mark.parametrize("link", ["WAIST_R_S", "PELVIS_S", "base_link", "R_KNEE_S", "r_wrist"])
def test_an_unknown_wrench_on_a_floating_robot_is_recovered(leg: Robot, world: World, link: str) -> None:
    hit = np.array([40.0, -60.0, 25.0, 3.0, 9.0, -4.0])
    for seed in range(3):
        q, v, a = world.motion(seed)
        forces = {"R_ANKLE_P_S": PUSH, link: hit}
        a = world.balanced(q, v, a, forces)
        rows = world.rows(q, v, a, forces)
        reading, base = world.reading("R_ANKLE_P"), world.base(q, v, a)
        estimator = TorqueEstimator(leg, ("ankle",), base="floating", unknown_link=link)
        estimate = estimator.estimate(q[7:], v[6:], a[6:], base, [reading])
        assert np.allclose(estimate.unknown_wrench, hit, atol=1e-7)
        assert np.allclose(estimate.torque, rows[6:], atol=1e-8)
        assert estimate.residual < 1e-8
        assert np.allclose(estimate.base_wrench, 0.0, atol=1e-8)
        # On a link that no joint carries it does not matter for the torques where it acts; on the shank it does
        blind = TorqueEstimator(leg, ("ankle",), base="floating").estimate(q[7:], v[6:], a[6:], base, [reading])
        assert (np.abs(blind.torque - rows[6:]).max() > 1.0) == (link == "R_KNEE_S")
        assert blind.residual > 1.0


@pytest.mark.parametrize("link", ["WAIST_R_S", "R_HIP_Y_S"])
def test_a_point_force_leaves_no_remainder_and_a_moment_does(leg: Robot, world: World, link: str) -> None:
    q, v, a = world.motion(7)
    estimator = TorqueEstimator(leg, ("ankle",), base="floating", unknown_link=link, unknown="force")
    for moment in (0.0, 5.0):
        forces = {"R_ANKLE_P_S": PUSH, link: np.array([40.0, -60.0, 25.0, 0.0, moment, 0.0])}
        balanced = world.balanced(q, v, a, forces)
        rows = world.rows(q, v, balanced, forces)
        base, reading = world.base(q, v, balanced), world.reading("R_ANKLE_P")
        estimate = estimator.estimate(q[7:], v[6:], balanced[6:], base, [reading])
        if moment:
            assert 0.5 < estimate.residual <= moment
            assert not np.allclose(estimate.unknown_wrench[:3], forces[link][:3], atol=0.1)
        else:
            assert np.allclose(estimate.unknown_wrench, forces[link], atol=1e-7)
            assert np.allclose(estimate.torque, rows[6:], atol=1e-8)
            assert estimate.residual < 1e-8


@pytest.mark.parametrize("unknown", ["wrench", "force", None])
@pytest.mark.parametrize("seed", range(3))
def test_the_estimate_is_the_least_squares_solution_of_all_equations(
    leg: Robot, world: World, seed: int, unknown: Any
) -> None:
    """min over [f_u; τ] of |[J_uᵀ Sᵀ] [f_u; τ] − rows|, all twelve rows at once, for rows that no force explains."""
    q, v, a = world.motion(seed)
    rows = world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    reading, base, count = world.reading("R_ANKLE_P"), world.base(q, v, a), {"wrench": 6, "force": 3, None: 0}[unknown]
    options = {} if unknown is None else {"unknown_link": "R_HIP_Y_S", "unknown": unknown}
    estimator = TorqueEstimator(leg, ("ankle",), base="floating", **options)
    estimate = estimator.estimate(q[7:], v[6:], a[6:], base, [reading])
    matrix = np.hstack((world.jacobian(q, "R_HIP_Y_S")[:count].T, np.eye(12)[:, 6:]))
    solution = np.linalg.lstsq(matrix, rows)[0]
    assert np.allclose(estimate.unknown_wrench[:count], solution[:count], atol=1e-7)
    assert not estimate.unknown_wrench[count:].any()
    assert np.allclose(estimate.torque, solution[count:], atol=1e-8)
    assert estimate.residual == pytest.approx(np.linalg.norm(matrix @ solution - rows), abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_inside_the_chain_frees_all_joints_from_a_wrench_on_the_last_link(
    leg: Robot, world: World, seed: int
) -> None:
    q, v, a = world.motion(seed)
    rows = world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    reading, base = world.reading("R_KNEE"), world.base(q, v, a)
    estimate = TorqueEstimator(leg, ("knee",)).estimate(q[7:], v[6:], a[6:], base, [reading])
    assert np.allclose(estimate.torque, rows[6:], atol=1e-8)
    pin.forwardKinematics(world.model, world.data, q)
    knee, foot = (world.data.oMi[world.model.getJointId(name)] for name in ("R_KNEE", "R_ANKLE_P"))
    assert np.allclose(estimate.external_wrenches[0], knee.actInv(foot.act(pin.Force(PUSH))).vector, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_sensors_on_fixed_links_and_locked_limbs_count_as_well(leg: Robot, world: World, seed: int) -> None:
    """One on a plate under the foot, without mass of its own, and one on the wrist of an arm that is locked."""
    q, v, a = world.motion(seed)
    rows = world.rows(q, v, a, {"R_ANKLE_P_S": PUSH, "r_wrist": -PUSH})
    estimator = TorqueEstimator(leg, ("wrist", "toe"), base="floating")
    estimate = estimator.estimate(q[7:], v[6:], a[6:], world.base(q, v, a), [PUSH, -PUSH])
    assert np.allclose(estimate.external_wrenches, [-PUSH, PUSH], atol=1e-9)
    assert np.allclose(estimate.torque, rows[6:], atol=1e-9)
    assert np.allclose(estimate.base_wrench, rows[:6], atol=1e-8)


def test_the_compensation_is_that_of_the_hand_s_wrench(arm: Robot) -> None:
    """Another derivation, with the Jacobian and no recursion: the same force for the arm's hand at any motion."""
    sensor = {"name": "wrist", "frame": "hand", "bus": "b2", "can_id": 0x1C0, "command_id": 0x1C8}
    data = arm.description.model_dump() | {"force_torque_sensors": [sensor]}
    robot = Robot(type(arm.description).model_validate(data), arm.urdf)
    rng = np.random.default_rng(2)
    q, v, a, reading = rng.uniform(-1, 1, 9), rng.normal(size=9), 9 * rng.normal(size=9), rng.normal(size=6)
    force, moment = reading.reshape(2, 3).tolist()
    now = RobotModel(robot, ("hand",)).configure(q, v)
    sample = WrenchSample(name="wrist", force_in_sensor=tuple(force), torque_in_sensor=tuple(moment))
    felt = HandWrenchEstimator(robot, HandForce(sensor="wrist")).update(sample, now, acceleration=a)
    estimator = TorqueEstimator(robot, ("wrist",))
    estimate = estimator.estimate(q, v, a, REST, [reading])
    hand = now.frames["hand"]
    in_world = estimate.external_wrenches[0].reshape(2, 3) @ hand.rotation.T
    assert np.allclose(in_world.ravel(), felt.wrench, atol=1e-10)
    assert np.allclose(estimate.torque, now.mass @ a + now.nonlinear - hand.jacobian.T @ felt.wrench, atol=1e-9)
    assert estimator.carried("wrist").mass == pytest.approx(0.1)


def test_what_the_sensor_carries_changes_its_wrench_but_no_torque_before_it(leg: Robot, world: World) -> None:
    """Only the reading passes on: a payload moves the environment's wrench, the offset moves both."""
    q, v, a = world.fixed(1)
    rows = world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    reading, plain = world.reading("R_ANKLE_P"), TorqueEstimator(leg, ("ankle",))
    body, offset = plain.carried("ankle"), np.array([2.0, -1.0, 4.0, 0.3, 0.2, -0.5])
    true = Payload(body.mass, body.mass * body.lever, offset)
    wrong = Payload(2.0 * body.mass, np.array([0.2, 0.1, 0.0]), offset)
    found = [
        TorqueEstimator(leg, ("ankle",), compensations={"ankle": payload}).estimate(
            q[7:], v[6:], a[6:], REST, [reading + offset]
        )
        for payload in (true, wrong)
    ]
    assert np.allclose(found[0].external_wrenches[0], PUSH, atol=1e-9)
    assert np.allclose(found[0].torque, rows[6:], atol=1e-9)
    assert np.allclose(found[1].torque, rows[6:], atol=1e-8)
    extra = found[1].external_wrenches[0] - PUSH
    # Newton for the heavier foot, of another centre of mass
    lever = wrong.first_moment / wrong.mass
    world.rows(q, v, a)
    joint = world.model.getJointId("R_ANKLE_P")
    spin, felt = world.data.v[joint], world.data.a_gf[joint]
    linear = felt.linear + np.cross(spin.angular, spin.linear)
    for mass, centre, sign in ((wrong.mass, lever, -1.0), (body.mass, body.lever, 1.0)):
        swing = np.cross(spin.angular, np.cross(spin.angular, centre))
        extra = extra.copy()
        extra[:3] += sign * mass * (linear + np.cross(felt.angular, centre) + swing)
    assert np.allclose(extra[:3], 0.0, atol=1e-9)
    unread = plain.estimate(q[7:], v[6:], a[6:], REST, [reading + offset])
    assert np.allclose(unread.external_wrenches[0], PUSH - offset, atol=1e-9)


def test_without_sensors_the_torques_are_those_in_free_air(leg: Robot, world: World) -> None:
    q, v, a = world.motion(3)
    estimate = TorqueEstimator(leg, ()).estimate(q[7:], v[6:], a[6:], world.base(q, v, a), [])
    assert np.allclose(estimate.torque, world.rows(q, v, a)[6:], atol=1e-9)
    assert estimate.external_wrenches == ()


def test_the_description_s_order_is_kept_when_the_urdf_s_differs(leg: Robot, world: World, tmp_path: Path) -> None:
    order = [3, 0, 5, 1, 4, 2]
    shuffled = load(tmp_path / "leg.yaml", order=tuple(JOINTS[i] for i in order))
    q, v, a = world.motion(4)
    world.rows(q, v, a, {"R_ANKLE_P_S": PUSH})
    base, reading = world.base(q, v, a), world.reading("R_ANKLE_P")
    options: dict[str, Any] = {"base": "floating", "unknown_link": "R_KNEE_S", "unknown": "force"}
    one = TorqueEstimator(leg, ("ankle",), **options).estimate(q[7:], v[6:], a[6:], base, [reading])
    other = TorqueEstimator(shuffled, ("ankle",), **options).estimate(
        q[7:][order], v[6:][order], a[6:][order], base, [reading]
    )
    assert np.allclose(other.torque, one.torque[order], atol=1e-12)
    assert np.allclose(other.link_torque, one.link_torque[order], atol=1e-12)
    assert np.allclose(other.unknown_wrench, one.unknown_wrench, atol=1e-12)


def test_an_estimate_is_read_only_outlives_the_next_and_repeats(leg: Robot, world: World) -> None:
    q, v, a = world.motion(0)
    estimator = TorqueEstimator(leg, ("knee",), base="floating", unknown_link="WAIST_R_S", unknown="force")
    first = estimator.estimate(q[7:], v[6:], a[6:], REST, [PUSH])
    arrays = (
        first.torque,
        first.link_torque,
        first.base_wrench,
        first.unknown_wrench,
        *first.external_wrenches,
    )
    kept = [array.copy() for array in arrays]
    estimator.estimate(a[6:], q[7:], v[6:], world.base(q, v, a), [-PUSH])
    assert all(np.array_equal(array, copy) for array, copy in zip(arrays, kept, strict=True))
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    again = estimator.estimate(q[7:], v[6:], a[6:], REST, [PUSH])
    assert np.array_equal(again.torque, first.torque)
    assert again.residual == first.residual


@pytest.mark.parametrize("place", ["position", "velocity", "acceleration", "base", "wrench"])
def test_what_is_not_finite_or_does_not_fit_is_refused(leg: Robot, place: str) -> None:
    estimator = TorqueEstimator(leg, ("ankle",))
    inputs: dict[str, Array] = {name: np.ones(6) for name in ("position", "velocity", "acceleration", "wrench")}
    inputs["base"] = np.ones(3)

    def run() -> None:
        base = BaseMotion(np.zeros(3), np.zeros(3), inputs["base"])
        estimator.estimate(inputs["position"], inputs["velocity"], inputs["acceleration"], base, [inputs["wrench"]])

    run()
    inputs[place] = inputs[place].copy()
    inputs[place][1] = np.nan
    with pytest.raises(StateError, match="not finite"):
        run()
    if place != "base":
        inputs[place] = np.ones(7)
        with pytest.raises(StateError, match="expected"):
            run()
    with pytest.raises(StateError, match="6 joints and 1 wrenches, got"):
        estimator.estimate(np.ones(6), np.ones(6), np.ones(6), REST, [])


@pytest.mark.parametrize(
    ("sensors", "options", "words"),
    [
        (("nose",), {}, "no force/torque sensor 'nose'; it has ankle, toe"),
        (("root",), {}, "root of the URDF"),
        (("ankle", "same"), {}, "on one link"),
        (("knee", "ankle"), {}, "'ankle' lies beyond sensor 'knee'"),
        (("ankle", "knee"), {}, "'ankle' lies beyond sensor 'knee'"),
        (("knee", "toe"), {}, "'toe' lies beyond sensor 'knee'"),
        (("ankle",), {"base": "floating", "unknown_link": "nose"}, "no link 'nose'"),
        (("ankle",), {"unknown_link": "WAIST_R_S"}, "'WAIST_R_S' cannot be told from the mount's"),
        (("ankle",), {"unknown_link": "base_link", "unknown": "force"}, "cannot be told from the mount's"),
        (("knee",), {"base": "floating", "unknown_link": "R_ANKLE_P_S"}, "lies beyond sensor 'knee'"),
        (("ankle",), {"compensations": {"knee": Payload(1.0, np.zeros(3), np.zeros(6))}}, "'knee' is used"),
        (("knee",), {"compensations": {"knee": Payload(1.0, np.zeros(3), np.zeros(6))}}, "'R_ANKLE_P' moves beyond"),
    ],
)
def test_a_bad_configuration_is_refused(
    leg: Robot, sensors: tuple[str, ...], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        TorqueEstimator(leg, sensors, **options)


def test_the_environment_must_not_have_a_choice_of_limbs(leg: Robot) -> None:
    """With the left hip driven as well, a sensor before both legs cannot tell on which one it acts."""
    joint = leg.description.joints[0]
    other = joint.model_copy(update={"name": "L_HIP_P", "drive": joint.drive.model_copy(update={"node_id": 9})})
    both = leg.description.model_copy(update={"joints": (*leg.description.joints, other)})
    with pytest.raises(ConfigurationError, match="branches beyond sensor 'trunk'"):
        TorqueEstimator(Robot(both, leg.urdf), ("trunk",))
    # One leg alone is a chain: the mount's own sensor serves
    assert TorqueEstimator(leg, ("trunk",)).sensors == ("trunk",)


def test_a_fixed_base_s_unknown_wrench_at_its_root_is_the_mount_s(leg: Robot, world: World) -> None:
    q, v, a = world.fixed(2)
    rooted = TorqueEstimator(leg, (), unknown_link="base_link").estimate(q[7:], v[6:], a[6:], REST, [])
    plain = TorqueEstimator(leg, ()).estimate(q[7:], v[6:], a[6:], REST, [])
    assert np.array_equal(rooted.base_wrench, plain.base_wrench)
    assert rooted.base_wrench[2] == pytest.approx(world.rows(q, v, a)[2])


def test_what_pinocchio_cannot_read_is_refused(leg: Robot) -> None:
    with pytest.raises(ConfigurationError, match="Pinocchio"):
        TorqueEstimator(Robot(leg.description, '<robot name="x"><link name="a"/><link name="b"/></robot>'), ())
    urdf = leg.urdf.replace('name="R_KNEE" type="revolute"', 'name="R_KNEE" type="fixed"')
    with pytest.raises(ConfigurationError, match="no movable joint 'R_KNEE'"):
        TorqueEstimator(Robot(leg.description, urdf), ())
