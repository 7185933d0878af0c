"""Distances to keep: gradient and its rate by differences, the damper's guarantee, penetration, arm9's capsules."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from controller_service.collision import CollisionModel, CollisionRows
from controller_service.model import Array, RobotModel
from schemas.control_law import CollisionAvoidance, WorldCapsule
from schemas.errors import ConfigurationError
from schemas.load import Robot, load_robot
from schemas.robot import Capsule

RESPONSE = 0.01
STEP = 1e-6
PERIOD = 0.002
CAPSULES = (
    Capsule(name="trunk", link="base", start_in_link=(0.1, 0, 0.5), end_in_link=(0.1, 0.1, 1.2), radius=0.12),
    Capsule(name="upper", link="link4", start_in_link=(0, 0, -0.02), end_in_link=(0.02, 0, -0.2), radius=0.05),
    Capsule(name="fore", link="link6", start_in_link=(0, 0, 0), end_in_link=(0, 0.01, -0.14), radius=0.04),
    Capsule(name="palm", link="hand", start_in_link=(0, -0.03, 0), end_in_link=(0, 0.03, 0.02), radius=0.03),
    Capsule(name="ball", link="link8", start_in_link=(0, 0, -0.05), end_in_link=(0, 0, -0.05), radius=0.04),
)
PAIRS = (("trunk", "palm"), ("fore", "trunk"), ("upper", "palm"), ("ball", "upper"))
BAR = WorldCapsule(name="bar", start_in_world=(0.3, -2, 0.7), end_in_world=(0.4, 2, 0.9), radius=0.02)
POST = WorldCapsule(name="post", start_in_world=(0.2, -0.4, 0.0), end_in_world=(0.2, -0.4, 0.6), radius=0.03)


def with_capsules(arm: Robot, **changes: Any) -> Robot:
    update: dict[str, Any] = {"capsules": CAPSULES, "collision_pairs": PAIRS, **changes}
    return Robot(arm.description.model_copy(update=update), arm.urdf)


def build(robot: Robot, response: float = RESPONSE, **config: Any) -> CollisionModel:
    return CollisionModel(robot, CollisionAvoidance(**config), RobotModel(robot), response)


def everywhere(robot: Robot, response: float = RESPONSE) -> CollisionModel:
    """All pairs within their influence."""
    return build(robot, response, obstacles=(BAR, POST), influence_m=5.0, max_pairs=12)


@pytest.fixture(scope="module")
def robot(arm: Robot) -> Robot:
    return with_capsules(arm)


@pytest.fixture(scope="module")
def rigid(robot: Robot) -> RobotModel:
    return RobotModel(robot)


def states(count: int) -> list[tuple[Array, Array]]:
    rng = np.random.default_rng(11)
    return [(rng.uniform(-1.5, 1.5, 9), rng.normal(size=9)) for _ in range(count)]


def used(rows: CollisionRows) -> slice:
    return slice(len(rows.names))


def ends(robot: Robot, rigid: RobotModel, q: Array) -> dict[str, tuple[Array, Array, float]]:
    """Axes of all capsules and obstacles in the world."""
    found = {}
    for capsule in robot.description.capsules:
        position, rotation = rigid.pose(q, capsule.link)
        start, end = (position + rotation @ np.array(p) for p in (capsule.start_in_link, capsule.end_in_link))
        found[capsule.name] = (start, end, capsule.radius)
    for obstacle in (BAR, POST):
        found[obstacle.name] = (np.array(obstacle.start_in_world), np.array(obstacle.end_in_world), obstacle.radius)
    return found


def test_distances_are_those_of_sampled_axes(robot: Robot, rigid: RobotModel) -> None:
    model = everywhere(robot)
    share = np.linspace(0.0, 1.0, 300)[:, None]
    for q, _ in states(5):
        shapes = ends(robot, rigid, q)
        for (one, other), d in zip(model.pairs, model.distances(q), strict=True):
            (a, b, r), (c, e, s) = shapes[one], shapes[other]
            first, second = a + share * (b - a), c + share * (e - c)
            sampled = np.linalg.norm(first[:, None] - second[None], axis=2).min() - r - s
            step = (np.linalg.norm(b - a) + np.linalg.norm(e - c)) / 299
            assert sampled - step <= d <= sampled + 1e-9


def test_rows_are_the_distances_gradient(robot: Robot, rigid: RobotModel) -> None:
    model = everywhere(robot)
    for q, v in states(20):
        rows = model.rows(rigid.configure(q, v))
        index = [model.pairs.index(names) for names in rows.names]
        assert len(index) >= 10
        assert np.array_equal(rows.distances, model.distances(q)[index])
        steps = STEP * np.eye(9)
        slopes = np.array([model.distances(q + step) - model.distances(q - step) for step in steps]) / (2 * STEP)
        assert np.allclose(rows.A[used(rows)], slopes[:, index].T, atol=1e-7)


def test_rate_of_the_gradient_agrees_with_differences_of_the_approach_speed(robot: Robot, rigid: RobotModel) -> None:
    """Only along nearly parallel axes it is bounded instead: there the nearest points jump from end to end."""
    slow, fast = everywhere(robot, 0.02), everywhere(robot, 0.01)
    compared = 0
    for q, v in states(60):
        now = rigid.configure(q, v)
        rows, quicker = slow.rows(now), fast.rows(now)
        # lower = (v(d) − ḋ)/t_v − Ȧq̇ at two response times
        drift = (quicker.lower - 2.0 * rows.lower)[used(rows)]
        after, before = (slow.rows(rigid.configure(q + sign * STEP * v, v)) for sign in (1, -1))
        assert after.names == before.names == rows.names
        rate = ((after.A - before.A)[used(rows)] @ v) / (2 * STEP)
        shapes = ends(robot, rigid, q)
        for k, pair in enumerate(rows.names):
            axes = [end - start for start, end, _ in (shapes[name] for name in pair)]
            sizes = [float(np.linalg.norm(axis)) for axis in axes]
            parallel = min(sizes) > 0.0 and abs(axes[0] @ axes[1]) / (sizes[0] * sizes[1]) > 0.97
            overlap = rows.distances[k] < 0.0
            if parallel or overlap:
                assert np.isfinite(drift[k])
                continue
            assert np.isclose(drift[k], rate[k], rtol=1e-4, atol=1e-4), pair
            compared += 1
    assert compared > 400


def test_all_is_the_same_in_another_order_of_joints(arm: Robot, robot: Robot, rigid: RobotModel) -> None:
    order = [4, 0, 8, 2, 6, 1, 3, 7, 5]
    joints = tuple(arm.description.joints[i] for i in order)
    shuffled = with_capsules(arm, joints=joints)
    for q, v in states(5):
        rows = everywhere(robot).rows(rigid.configure(q, v))
        other = everywhere(shuffled).rows(RobotModel(shuffled).configure(q[order], v[order]))
        assert rows.names == other.names
        assert np.allclose(rows.A[used(rows)][:, order], other.A[used(rows)])
        assert np.allclose(rows.lower[used(rows)], other.lower[used(rows)])


def nearest_acceleration(rows: CollisionRows, wanted: Array) -> Array:
    """Minimise ‖q̈ − wanted‖ over A q̈ ≥ lower, by Hildreth's sweeps over the dual."""
    A, lower, x = rows.A[used(rows)], rows.lower[used(rows)], wanted.copy()
    dual = np.zeros(len(A))
    squares = (A * A).sum(axis=1)
    for _ in range(300):
        before = dual.copy()
        for i, row in enumerate(A):
            change = max(-dual[i], (lower[i] - row @ x) / squares[i])
            dual[i] += change
            x += change * row
        if np.array_equal(before, dual) or np.abs(before - dual).max() < 1e-9:
            break
    return x


def drive(model: CollisionModel, rigid: RobotModel, q: Array, push: Array, ticks: int) -> Array:
    """Integrate the allowed acceleration nearest to a constant one with damping 4/s; give all distances."""
    log, v = [], np.zeros(9)
    for _ in range(ticks):
        log.append(model.distances(q))
        a = nearest_acceleration(model.rows(rigid.configure(q, v)), push - 4.0 * v)
        q, v = q + PERIOD * v + 0.5 * PERIOD**2 * a, v + PERIOD * a
    return np.array(log)


START = np.array([0.1, -0.1, -0.2, -0.3, 0.2, -0.6, 0.1, 0.2, 0.1])
WALL = WorldCapsule(name="wall", start_in_world=(2.6, -2, 0.6), end_in_world=(2.6, 2, 0.6), radius=2.0)
"""Almost a plane, 0.18 m in front of the hand at the start."""


@pytest.mark.parametrize("push", [2.0, 8.0, 25.0])
def test_a_hand_pushed_at_a_wall_keeps_its_distance_and_is_braked_no_harder_than_said(
    robot: Robot, rigid: RobotModel, push: float
) -> None:
    """The lag t_v a behind the allowed speed is what a deceleration of a takes; nobody is ever asked for much more."""
    wide = build(robot, obstacles=(WALL,), influence_m=5.0, max_pairs=12)
    rows = wide.rows(rigid.configure(START, np.zeros(9)))
    ahead = -rows.A[rows.names.index(("palm", "wall"))]
    model = build(robot, obstacles=(WALL,))
    wall = [k for k, (_, other) in enumerate(model.pairs) if other == "wall"]
    d = drive(model, rigid, START, push * ahead / np.linalg.norm(ahead), 1500)[:, wall]
    assert d[0].min() > 0.18
    assert 0.02 - 1e-4 < d.min() < 0.021
    speed, d = np.diff(d, axis=0) / PERIOD, d[:-1]
    braking = np.sqrt(0.5**2 + 2 * model.braking * np.maximum(d - 0.08, 0.0))
    excess = -speed - np.where(d < 0.08, 0.5 * (d - 0.02) / 0.06, braking)
    assert excess.max() < 1.2 * RESPONSE * model.braking
    if push > 2.0:
        assert excess.max() > 0.0


@pytest.mark.parametrize("depth", [0.05, 0.09, 0.12])
def test_penetration_leads_apart_at_bounded_speed(robot: Robot, rigid: RobotModel, depth: float) -> None:
    start, end, radius = ends(robot, rigid, START)["palm"]
    beside = 0.5 * (start + end) + (radius + 0.1 - depth) * np.array([0.3, 0.1, -0.94])
    along = np.array([0.0, 2.0, 0.1])
    rock = WorldCapsule(
        name="rock", start_in_world=tuple(beside - along), end_in_world=tuple(beside + along), radius=0.1
    )
    model = build(robot, obstacles=(rock,))
    k = model.pairs.index(("palm", "rock"))
    d = drive(model, rigid, START, np.zeros(9), 400)[:, k]
    assert -0.13 < d[0] < -0.04
    assert d[-1] > 0.018
    assert (np.diff(d) > -1e-4).all()
    assert np.diff(d).max() / PERIOD < 0.55


def test_crossing_axes_still_have_a_way_out(arm: Robot) -> None:
    """Exactly crossing, in their middles: the library then gives no normal."""
    spar = Capsule(name="spar", link="link1", start_in_link=(0, -0.3, 0), end_in_link=(0, -0.1, 0), radius=0.05)
    rod = WorldCapsule(name="rod", start_in_world=(-1, -0.28, 1.1), end_in_world=(1, -0.28, 1.1), radius=0.03)
    robot = with_capsules(arm, capsules=(spar,), collision_pairs=())
    model = build(robot, obstacles=(rod,))
    rows = model.rows(RobotModel(robot).configure(np.zeros(9), np.zeros(9)))
    assert np.allclose(rows.distances, [-0.08])
    assert rows.names == (("spar", "rod"),)
    assert np.isclose(abs(rows.A[0, 1]), 0.2)
    assert np.isclose(rows.lower[0], 0.5 / RESPONSE)
    assert np.isclose(model.distances(0.1 * rows.A[0])[0], -0.08 + 0.2 * np.sin(0.02))


def test_rows_without_a_pair_bind_nothing_and_cannot_be_written(robot: Robot, rigid: RobotModel) -> None:
    model = build(robot, max_pairs=11)
    rows = model.rows(rigid.configure(START, np.zeros(9)))
    assert rows.names == ()
    assert rows.A.shape == (11, 9)
    assert np.array_equal(np.linalg.norm(rows.A, axis=1), np.ones(11))
    assert (rows.lower == -np.inf).all()
    with pytest.raises(ValueError, match="read-only"):
        rows.A[0, 0] = 2.0


def test_the_nearest_pairs_have_the_rows_in_the_order_of_the_pairs(robot: Robot, rigid: RobotModel) -> None:
    every = everywhere(robot)
    few = build(robot, obstacles=(BAR, POST), influence_m=5.0, max_pairs=3)
    for q, v in states(10):
        d = every.distances(q)
        rows = few.rows(rigid.configure(q, v))
        index = [few.pairs.index(names) for names in rows.names]
        assert index == sorted(index)
        assert set(index) == set(np.argsort(d)[:3].tolist())
        again = few.rows(rigid.configure(q, v))
        assert np.array_equal(rows.A, again.A)
        assert np.array_equal(rows.lower, again.lower)


def test_a_pair_beyond_its_influence_gets_its_row_before_it_can_be_too_fast(robot: Robot, rigid: RobotModel) -> None:
    model = build(robot, obstacles=(BAR, POST), max_pairs=12)
    slopes = everywhere(robot)
    early = 0
    for q, v in states(60):
        now = rigid.configure(q, 3.0 * v)
        rows, every = model.rows(now), slopes.rows(now)
        speed = every.A[used(every)] @ now.velocity
        for names, d, rate in zip(every.names, every.distances, speed, strict=True):
            if d > 0.08 and rate < -np.sqrt(0.5**2 + 2 * model.braking * (d - 0.08)):
                assert names in rows.names
                early += 1
    assert early > 20


def test_a_distance_that_no_joint_changes_has_no_row(arm: Robot) -> None:
    """A capsule about the first joint's own axis."""
    mast = Capsule(name="mast", link="link0", start_in_link=(0, 0, 0), end_in_link=(0, 0, -0.5), radius=0.05)
    robot = with_capsules(arm, capsules=(mast,), collision_pairs=())
    near = WorldCapsule(name="near", start_in_world=(0.1, 0, 0), end_in_world=(0.1, 0, 1), radius=0.04)
    model = build(robot, obstacles=(near,))
    rows = model.rows(RobotModel(robot).configure(START, np.ones(9)))
    assert np.isclose(model.distances(START).min(), 0.01)
    assert rows.names == ()
    assert (rows.lower == -np.inf).all()


def test_bad_input_is_refused(arm: Robot) -> None:
    lost = CAPSULES[1].model_copy(update={"link": "tail"})
    with pytest.raises(ConfigurationError, match=r"capsule 'upper'.*no link 'tail'"):
        build(with_capsules(arm, capsules=(lost, *CAPSULES[2:]), collision_pairs=()))
    with pytest.raises(ConfigurationError, match="'palm' is also the name"):
        build(with_capsules(arm), obstacles=(BAR.model_copy(update={"name": "palm"}),))
    with pytest.raises(ConfigurationError, match="'bar' is also the name"):
        build(with_capsules(arm), obstacles=(BAR, BAR))
    for pair, links in ((("palm", "ball"), "'hand' and 'link8'"), (("palm", "palm"), "'hand' and 'hand'")):
        with pytest.raises(ConfigurationError, match=f"no joint moves .* {links}"):
            build(with_capsules(arm, collision_pairs=(pair,)))
    with pytest.raises(ConfigurationError, match="twice"):
        build(with_capsules(arm, collision_pairs=(("fore", "trunk"), ("trunk", "fore"))))
    with pytest.raises(ConfigurationError, match="nothing to avoid"):
        build(with_capsules(arm, collision_pairs=()))
    with pytest.raises(ConfigurationError, match="nothing to avoid"):
        build(arm, obstacles=(BAR,))


ARM9 = load_robot("arm9")
ARM9_NAMES = ARM9.description.joint_names
HELD = {
    "chest": ("chest",),
    "upper_arm": ("shoulder_yaw_link",),
    "forearm": ("elbow_pitch_link", "wrist_yaw_link", "wrist_pitch_link"),
    "hand": ("wrist_roll_link", "wrist_sensor", "hand"),
}


def surface(link: str) -> Array:
    """Points (k, 3) of a link's collision primitive that are farthest out, in the link."""
    collision = ElementTree.fromstring(ARM9.urdf).find(f"link[@name='{link}']/collision")
    assert collision is not None
    origin, geometry = collision.find("origin"), collision.find("geometry")
    assert origin is not None
    assert geometry is not None
    shape = geometry[0]
    size = {name: [float(word) for word in text.split()] for name, text in shape.attrib.items()}
    turns = np.linspace(0.0, 2 * np.pi, 90)
    ring = np.stack((np.cos(turns), np.sin(turns)), axis=1)
    if shape.tag == "box":
        points = np.array(list(itertools.product(*([-0.5 * a, 0.5 * a] for a in size["size"]))))
    elif shape.tag == "cylinder":
        ends = [np.full((90, 1), sign * 0.5 * size["length"][0]) for sign in (-1, 1)]
        points = np.vstack([np.hstack((size["radius"][0] * ring, end)) for end in ends])
    else:
        heights = np.linspace(-1.0, 1.0, 21)
        points = size["radius"][0] * np.vstack(
            [np.hstack((np.sqrt(1 - z**2) * ring, np.full((90, 1), z))) for z in heights]
        )
    xyz, rpy = ([float(word) for word in origin.get(name, "0 0 0").split()] for name in ("xyz", "rpy"))
    return np.asarray(points @ pin.rpy.rpyToMatrix(*rpy).T + xyz)


@pytest.mark.parametrize("capsule", ARM9.description.capsules, ids=lambda capsule: str(capsule.name))
def test_arm9_s_capsules_hold_what_they_stand_for(capsule: Capsule) -> None:
    """Within 0.5 mm, at any posture, and with no more than 50 mm beyond (the chest's corners)."""
    model = RobotModel(ARM9)
    rng = np.random.default_rng(2)
    start, end = np.array(capsule.start_in_link), np.array(capsule.end_in_link)
    outmost = []
    for _ in range(5):
        q = rng.uniform(-1.0, 1.0, 9)
        base, turn = model.pose(q, capsule.link)
        for link in HELD[capsule.name]:
            position, rotation = model.pose(q, link)
            points = (surface(link) @ rotation.T + position - base) @ turn
            share = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0.0, 1.0)
            outmost.append(np.linalg.norm(points - start - share[:, None] * (end - start), axis=1).max())
    assert capsule.radius - 0.05 < max(outmost) < capsule.radius + 5e-4


def ordinary_postures(count: int) -> list[Array]:
    ranges = {"shoulder_pitch": (-1.5, -0.3), "shoulder_roll": (-1.4, -0.2), "elbow_pitch": (-1.6, -0.15)}
    index = [ARM9_NAMES.index(name) for name in ranges]
    postures = []
    for angles in itertools.product(*(np.linspace(low, high, count) for low, high in ranges.values())):
        posture = np.zeros(9)
        posture[index] = angles
        postures.append(posture)
    return postures


def test_arm9_is_out_of_its_dampers_influence_over_its_ordinary_range() -> None:
    model = build(ARM9)
    assert model.pairs == ARM9.description.collision_pairs
    for q in ordinary_postures(7):
        assert model.distances(q).min() > 0.1


def test_arm9_s_motors_have_the_deceleration_that_the_damper_may_ask_for() -> None:
    """With two thirds of the torque beside gravity; at the highest joint speeds where these keep a pair below ξ."""
    model, rigid = build(ARM9), RobotModel(ARM9)
    bar = WorldCapsule(name="bar", start_in_world=(0.8, -2, -0.4), end_in_world=(0.8, 2, -0.4), radius=0.03)
    all_pairs = build(ARM9, obstacles=(bar,), influence_m=5.0, max_pairs=12)
    limits, speeds = np.array([(joint.torque_limit, joint.velocity_limit) for joint in ARM9.description.joints]).T
    for q in ordinary_postures(4):
        now = rigid.configure(q, np.zeros(9))
        rows = all_pairs.rows(now)
        assert len(rows.names) >= 6  # on a stretched arm no joint moves upper arm and hand apart
        gradient = rows.A[used(rows)]
        left = 0.67 * (limits - np.abs(now.nonlinear))
        most = np.abs(np.linalg.solve(now.mass, gradient.T)).T @ left
        asked = model.braking * np.minimum(np.abs(gradient) @ speeds / 0.5, 1.0)
        assert (most > asked).all(), dict(zip(rows.names, (most / asked).tolist(), strict=True))
