"""Events of the world: profiles, Newton at the joints under pushes and hands, stability, repeatability."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from plant_service.errors import PlantError
from plant_service.simulation import Simulation
from plant_service.world import LinkPoint, minimum_jerk, minimum_jerk_rate, path_point, push_share
from schemas.base import Vector3
from schemas.load import Robot, load_robot
from schemas.messages import PlantTruth
from schemas.scenario import Friction, PlantConfig
from schemas.world import HandHeld, Pole, Push, World, WorldEvent

LOADED = load_robot("arm9")
WEIGHTLESS = Robot(LOADED.description.model_copy(update={"gravity_in_world": (0.0, 0.0, 0.0)}), LOADED.urdf)
POSE = {"scapula_roll": -0.3, "shoulder_pitch": -0.8, "shoulder_roll": -0.6, "elbow_pitch": -1.2, "wrist_pitch": 0.5}
SLIPPERY = Friction(coulomb=0.0, breakaway=0.0, viscous=0.0)
SUBSTEP_S = 0.0005
POINT = (0.02, -0.01, 0.03)


def push(name: str = "push", **fields: Any) -> Push:
    given = {"link": "hand", "point_in_link": POINT, "force_in_world": (20.0, -10.0, 30.0), "start_s": 0.0}
    return Push(name=name, **given | {"duration_s": 0.1, "ramp_s": 0.0} | fields)


def hand(name: str = "person", **fields: Any) -> HandHeld:
    given = {"link": "hand", "point_in_link": POINT, "start_s": 0.0, "duration_s": 10.0}
    return HandHeld(name=name, **given | {"stiffness": 2000.0, "damping": 50.0, "force_limit": 100.0} | fields)


def arm(*events: WorldEvent, robot: Robot = WEIGHTLESS, braked: bool = False, **fields: Any) -> Simulation:
    """The arm, weightless and free of friction unless told otherwise, its motors without torque or its brakes on."""
    config = PlantConfig(
        initial_posture=POSE, mass_error=0.0, world=World(events=events), **{"friction": SLIPPERY} | fields
    )
    simulation = Simulation(robot, config, 0)
    if not braked:
        for axis in simulation.axes:
            axis.follow_torque(0, 5000)
    return simulation


def run(simulation: Simulation, seconds: float) -> PlantTruth:
    for _ in range(round(seconds * 500.0)):
        simulation.advance()
    return simulation.truth(0, ())


def before(simulation: Simulation, truth: PlantTruth) -> mujoco.MjData:
    """MuJoCo's quantities at the start of the substep that ended at a truth: q − h q̇ and q̇ − h q̈."""
    plant = simulation.plant
    data = mujoco.MjData(plant.model)
    q, v, a = (np.array(values) for values in (truth.position, truth.velocity, truth.acceleration))
    data.qpos[plant.qpos_address], data.qvel[plant.dof_address] = q - SUBSTEP_S * v, v - SUBSTEP_S * a
    mujoco.mj_forward(plant.model, data)
    return data


def inertia_times(simulation: Simulation, data: mujoco.MjData, acceleration: tuple[float, ...]) -> np.ndarray:
    mass = np.zeros((9, 9))
    mujoco.mj_fullM(simulation.plant.model, data, mass)
    return mass @ np.array(acceleration)


def jacobian(simulation: Simulation, data: mujoco.MjData, link: str, point: Vector3 = POINT) -> np.ndarray:
    body = simulation.plant.frame_bodies[link]
    place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
    rows = np.zeros((3, 9))
    mujoco.mj_jac(simulation.plant.model, data, rows, None, place, body)
    return rows


def test_minimum_jerk_goes_from_rest_to_rest() -> None:
    assert [minimum_jerk(x) for x in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    for x in np.linspace(0.01, 0.99, 30):
        assert minimum_jerk_rate(x) == pytest.approx((minimum_jerk(x + 1e-6) - minimum_jerk(x - 1e-6)) / 2e-6, abs=1e-8)
    for end in (0.0, 1.0):
        assert minimum_jerk_rate(end) == 0.0
        assert abs(minimum_jerk_rate(end + 1e-4) + minimum_jerk_rate(end - 1e-4)) < 1e-6


@pytest.mark.parametrize("ramp_s", [0.0, 0.03, 0.1])
def test_impulse_is_force_times_duration_less_a_ramp_or_times_two_over_pi(ramp_s: float) -> None:
    shares = [push_share(push(duration_s=0.2, ramp_s=ramp_s), t) for t in np.linspace(-0.1, 0.3, 40001)]
    assert sum(shares) * 1e-5 == pytest.approx(0.2 - ramp_s, abs=2e-5)
    assert max(shares) == 1.0
    assert ramp_s == 0.0 or np.abs(np.diff(shares)).max() < 1.9 * 1e-5 / ramp_s  # the greatest slope is 15/8
    sine = [push_share(push(duration_s=0.2, shape="half_sine"), t) for t in np.linspace(-0.1, 0.3, 40001)]
    assert sum(sine) * 1e-5 == pytest.approx(0.4 / math.pi, rel=1e-6)


def test_a_path_passes_its_way_points_at_rest_and_stays_at_the_last() -> None:
    path = ((0.4, 0.1, 0.0, -0.2), (1.0, 0.0, 0.3, 0.0))
    for explicit in (path, ((0.0, 0.0, 0.0, 0.0), *path)):
        for t, *place in ((0.0, 0.0, 0.0, 0.0), *path, (5.0, 0.0, 0.3, 0.0)):
            point, velocity = path_point(explicit, t)
            assert point == pytest.approx(place, abs=1e-15)
            assert velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
        for t in (0.1, 0.3, 0.55, 0.9):
            ahead, behind = (np.array(path_point(explicit, t + step)[0]) for step in (1e-6, -1e-6))
            assert path_point(explicit, t)[1] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
    assert path_point((), 1.0) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_a_point_of_a_link_moves_as_its_jacobian_says() -> None:
    simulation = arm()
    model, data = simulation.plant.model, mujoco.MjData(simulation.plant.model)
    generator = np.random.default_rng(1)
    for link in ("scapula_roll_link", "elbow_pitch_link", "hand"):
        data.qpos[:], data.qvel[:] = generator.uniform(-1.0, 1.0, 9), generator.normal(size=9)
        mujoco.mj_forward(model, data)
        body = simulation.plant.frame_bodies[link]
        point = LinkPoint(model, data, body, POINT)
        rows = jacobian(simulation, data, link)
        assert point.position() == pytest.approx(data.xpos[body] + data.xmat[body].reshape(3, 3) @ POINT, abs=1e-14)
        assert point.velocity(point.position()) == pytest.approx(rows @ data.qvel, abs=1e-12)
        force, wrench = (3.0, -5.0, 7.0), [0.0] * 6
        point.add(wrench, point.position(), force)
        torque = np.zeros(9)
        mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], data.xipos[body], body, torque)
        assert torque == pytest.approx(rows.T @ force, abs=1e-12)


@pytest.mark.parametrize("seconds", [0.002, 0.06])
def test_a_push_accelerates_a_free_arm_by_newton(seconds: float) -> None:
    """M q̈ + h = Jᵀ F, at rest and in motion; force and point as told, the direction fixed in the world."""
    simulation = arm(push())
    truth = run(simulation, seconds)
    assert truth.world_forces == {"push": (20.0, -10.0, 30.0)}
    data = before(simulation, truth)
    left = inertia_times(simulation, data, truth.acceleration) + data.qfrc_bias
    right = jacobian(simulation, data, "hand").T @ truth.world_forces["push"]
    assert np.abs(right).max() > 1.0
    assert left == pytest.approx(right, abs=1e-9)


def test_work_of_a_push_becomes_kinetic_energy() -> None:
    simulation = arm(push(shape="half_sine", duration_s=0.1))
    work, place = 0.0, None
    for _ in range(60):
        simulation.advance()
        data, truth = mujoco.MjData(simulation.plant.model), simulation.truth(0, ())
        data.qpos[:] = truth.position
        mujoco.mj_kinematics(simulation.plant.model, data)
        body = simulation.plant.frame_bodies["hand"]
        now = data.xpos[body] + data.xmat[body].reshape(3, 3) @ POINT
        if place is not None:
            # The force halfway through the period, between those of its substeps.
            share = push_share(push(shape="half_sine", duration_s=0.1), max(0.0, simulation.time_ns * 1e-9 - 0.001))
            work += share * float(np.array((20.0, -10.0, 30.0)) @ (now - place))
        place = now
    assert truth.world_forces == {}
    assert work > 0.02
    assert truth.kinetic_energy == pytest.approx(work, rel=0.02)


def test_events_and_applied_wrenches_on_one_link_add_up() -> None:
    """Half the force three times, from two events and by hand, is the force and a half."""
    half = {"force_in_world": (10.0, -5.0, 15.0)}
    several = arm(push("one", **half), push("two", **half))
    several.apply_wrench("hand", POINT, (10.0, -5.0, 15.0))
    one = arm(push(force_in_world=(30.0, -15.0, 45.0)))
    truth = run(several, 0.05)
    assert truth.world_forces == {"one": (10.0, -5.0, 15.0), "two": (10.0, -5.0, 15.0)}
    assert truth.position == pytest.approx(run(one, 0.05).position, abs=1e-12)
    several.apply_wrench("hand")
    assert run(several, 0.06).world_forces == {}


def test_forces_end_with_their_events_and_leave_the_links() -> None:
    """A push that has ended leaves nothing behind: the free arm keeps its energy from then on."""
    simulation = arm(push(duration_s=0.0095), push("late", link="elbow_pitch_link", start_s=0.0085, duration_s=0.001))
    forces = []
    for _ in range(10):
        simulation.advance()
        forces.append(sorted(simulation.truth(0, ()).world_forces))
    # A truth tells of the last substep of its period.
    assert forces == [["push"]] * 4 + [[]] * 6
    energy = simulation.kinetic_energy
    assert energy > 1e-4
    assert run(simulation, 0.1).kinetic_energy == pytest.approx(energy, rel=1e-3)


def test_events_count_from_sequence_0() -> None:
    """Before it is known when sequence 0 is, nothing acts; then times count from there."""
    simulation = arm(push(start_s=0.01))
    simulation.count_events_from(None)
    assert run(simulation, 0.05).kinetic_energy == 0.0
    simulation.count_events_from(simulation.time_ns)
    assert run(simulation, 0.01).world_forces == {}
    assert run(simulation, 0.002).world_forces == {"push": (20.0, -10.0, 30.0)}
    assert run(simulation, 0.1).world_forces == {}


@pytest.mark.parametrize(("shift", "force"), [(0.01, 20.0), (0.04, 80.0), (0.2, 100.0)])
def test_a_hand_at_rest_pulls_with_stiffness_times_displacement_up_to_its_limit(shift: float, force: float) -> None:
    """The brakes keep the point where it is; they carry what the hand pulls and nothing else."""
    path = ((0.2, 0.0, 0.6 * shift, 0.8 * shift),)
    simulation = arm(hand(path=path), braked=True)
    truth = run(simulation, 0.4)
    pulled = np.array(truth.world_forces["person"])
    assert pulled == pytest.approx((0.0, 0.6 * force, 0.8 * force), rel=1e-3, abs=1e-3)
    torque = jacobian(simulation, before(simulation, truth), "hand").T @ pulled
    assert truth.friction_torque == pytest.approx(-torque, abs=1e-3)


def test_a_hand_takes_hold_where_the_point_truly_is() -> None:
    """A moving arm is braked by the damper alone at first: F = −d ṗ."""
    simulation = arm(push(), hand(start_s=0.12, stiffness=500.0, damping=80.0))
    run(simulation, 0.12)
    last = simulation.truth(0, ())
    assert "person" not in last.world_forces
    truth = run(simulation, 0.002)
    data = mujoco.MjData(simulation.plant.model)
    data.qpos[:], data.qvel[:] = last.position, last.velocity
    mujoco.mj_forward(simulation.plant.model, data)
    speed = jacobian(simulation, data, "hand") @ data.qvel
    assert np.linalg.norm(speed) > 0.05
    # Three substeps later the spring has come in by 500 N/m × 1.5 ms × ṗ, 1 % of the damper's force.
    assert truth.world_forces["person"] == pytest.approx(-80.0 * speed, rel=0.1, abs=0.05)


@pytest.mark.parametrize(("stiffness", "damping"), [(500.0, 60.0), (20000.0, 800.0)])
def test_a_hand_leads_a_free_arm_to_its_place(stiffness: float, damping: float) -> None:
    """Stable at 0.5 ms up to 20000 N/m; at the end the point is where the hand is, to 1 mm, and no force is left."""
    joints = Friction(coulomb=0.0, breakaway=0.0, viscous=2e-4)
    shift = np.array((-0.06, 0.04, 0.05))
    person = hand(path=((1.0, *shift),), stiffness=stiffness, damping=damping, force_limit=400.0)
    simulation = arm(person, friction=joints)
    start = before(simulation, simulation.truth(0, ()))
    body = simulation.plant.frame_bodies["hand"]
    goal = start.xpos[body] + start.xmat[body].reshape(3, 3) @ POINT + shift
    truth = run(simulation, 3.0)
    end = before(simulation, truth)
    assert end.xpos[body] + end.xmat[body].reshape(3, 3) @ POINT == pytest.approx(goal, abs=1e-3)
    assert np.linalg.norm(truth.world_forces["person"]) < 1.0
    assert truth.kinetic_energy < 1e-4


@pytest.mark.parametrize("ramp_s", [0.0, 0.05])
def test_a_hand_lets_go(ramp_s: float) -> None:
    simulation = arm(hand(path=((0.1, 0.03, 0.0, 0.0),), duration_s=0.2, ramp_s=ramp_s), braked=True)
    forces = []
    for _ in range(150):
        simulation.advance()
        forces.append(simulation.truth(0, ()).world_forces.get("person", (0.0, 0.0, 0.0))[0])
    assert forces[99] == pytest.approx(60.0, rel=1e-3)
    if ramp_s:
        # The truth after 0.226 s is that of the substep from 0.2255 s on.
        assert forces[112] == pytest.approx(60.0 * (1.0 - minimum_jerk(0.0255 / 0.05)), rel=1e-3)
        assert forces[126] == 0.0
    else:
        assert forces[100] == 0.0
    assert forces[-1] == 0.0


def test_same_seed_same_bits() -> None:
    def records(seed: int) -> list[str]:
        world = World(events=(push(start_s=0.02), hand(start_s=0.05, path=((0.1, 0.02, 0.0, 0.0),))))
        simulation = Simulation(LOADED, PlantConfig(initial_posture=POSE, friction_error=0.2, world=world), seed)
        for axis in simulation.axes:
            axis.follow_position(axis.position_counts(), 5000)
        return [run(simulation, 0.002).model_dump_json() for _ in range(80)]

    first = records(3)
    assert first == records(3)
    assert first != records(4)


def test_a_world_out_of_reach_changes_no_bit() -> None:
    far = Pole(name="far", start_in_world=(5.0, 0.0, 0.0), end_in_world=(5.0, 0.0, 2.0), radius=0.1)
    worlds = (World(), World(obstacles=(far,), events=(push(start_s=9.0), hand(start_s=9.0))))
    records = []
    for world in worlds:
        simulation = Simulation(LOADED, PlantConfig(initial_posture=POSE, world=world), 0)
        for index, axis in enumerate(simulation.axes):
            axis.follow_torque(40 * index, 5000)
        records.append([run(simulation, 0.002).model_dump_json() for _ in range(50)])
    assert records[0] == records[1]


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (push(link="nose"), r"plant\.world\.events\.0\.link: push: the robot has no link 'nose'; it has chest, "),
        (hand(link="nose"), r"plant\.world\.events\.0\.link: person: .*'nose'"),
        (hand(stiffness=1e9), r"plant\.world\.events\.0\.stiffness: person with 1e\+09 N/m .* kg.*0\.0005 s can carry"),
        (
            hand(damping=1e5),
            r"plant\.world\.events\.0\.stiffness: person .* 100000 N·s/m .*lower it, or plant\.substep_s",
        ),
    ],
)
def test_what_the_robot_cannot_take_is_refused(event: WorldEvent, words: str) -> None:
    with pytest.raises(PlantError, match=words):
        arm(event)
