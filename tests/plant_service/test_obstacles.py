"""Obstacles and what touches them: geometry, balance of forces with friction present, rest, refusal."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from plant_service.errors import PlantError
from plant_service.obstacles import Contacts
from plant_service.simulation import Simulation
from schemas.load import Robot, load_robot
from schemas.messages import PlantTruth
from schemas.scenario import Friction, PlantConfig
from schemas.world import Box, Obstacle, Pole, World

ROBOT = load_robot("arm9")
JOINTS = ROBOT.description.joints
POSE = {"scapula_roll": -0.3, "shoulder_pitch": -0.8, "shoulder_roll": -0.6, "elbow_pitch": -1.2, "wrist_pitch": 0.5}
SUBSTEP_S = 0.0005
HAND = np.array((0.629, -0.602, 0.304))
FOREARM = np.array((0.3622381, -0.51129075, 0.22787766))


def pole(depth: float = 0.0, friction: float = 0.5, name: str = "pole") -> Pole:
    """Across under the forearm, 12 cm − depth below its centre."""
    place, half = FOREARM - (0.0, 0.0, 0.12 - depth), np.array((0.0, 0.5, 0.0))
    return Pole(
        name=name,
        start_in_world=tuple((place - half).tolist()),
        end_in_world=tuple((place + half).tolist()),
        radius=0.02,
        friction=friction,
    )


def table(friction: float = 0.5) -> Box:
    """Under the hand, its top 10 cm below the hand's frame."""
    place = tuple((HAND - (0.0, 0.0, 0.2)).tolist())
    return Box(name="table", position_in_world=place, half_sizes=(0.12, 0.3, 0.1), friction=friction)


def config(*obstacles: Obstacle) -> PlantConfig:
    return PlantConfig(initial_posture=POSE, mass_error=0.0, world=World(obstacles=obstacles))


def lowered(simulation: Simulation, periods: int, speed: float = 1.0) -> list[PlantTruth]:
    """Truths while the shoulder pitches down [rad/s] for half a second, against what is there, and then stands."""
    start = [axis.position_counts() for axis in simulation.axes]
    turn = JOINTS[2].encoder_counts * JOINTS[2].gear_ratio
    truths = []
    for cycle in range(periods):
        for joint, axis in enumerate(simulation.axes):
            moved = round(min(cycle, 250) * 0.002 * speed * turn / (2.0 * np.pi)) if joint == 2 else 0
            axis.follow_position(start[joint] + moved, 1500)
        simulation.advance()
        truths.append(simulation.truth(cycle, ()))
    return truths


def imbalance(simulation: Simulation, truth: PlantTruth) -> np.ndarray:
    """M q̈ + h − motor − friction − Σ Jᵀ F [N·m], at the start of the substep that ended at a truth."""
    plant = simulation.plant
    data, mass = mujoco.MjData(plant.model), np.zeros((9, 9))
    q, v, a = (np.array(values) for values in (truth.position, truth.velocity, truth.acceleration))
    data.qpos[:], data.qvel[:] = q - SUBSTEP_S * v, v - SUBSTEP_S * a
    mujoco.mj_forward(plant.model, data)
    mujoco.mj_fullM(plant.model, data, mass)
    left = mass @ a + data.qfrc_bias - np.array(truth.motor_torque) - np.array(truth.friction_torque)
    for contact in truth.contacts:
        for link, sign in ((contact.link, 1.0), (contact.other, -1.0)):
            if link in plant.frame_bodies:
                rows = np.zeros((3, 9))
                place = np.array(contact.position_in_world)
                mujoco.mj_jac(plant.model, data, rows, None, place, plant.frame_bodies[link])
                left -= sign * rows.T @ contact.force_in_world
    return left


@pytest.mark.parametrize("obstacle", [pole(), table()], ids=["pole", "table"])
@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_an_arm_that_hits_an_obstacle_comes_to_rest_on_it(obstacle: Obstacle, speed: float) -> None:
    """It is stopped within millimetres, without a bounce, and rests under a steady force."""
    simulation = Simulation(ROBOT, config(obstacle), 0)
    truths = lowered(simulation, 500, speed)
    touching = [bool(truth.contacts) for truth in truths]
    first = touching.index(True)
    assert first > 10
    speed_at_contact = np.abs(truths[first - 1].velocity).max()
    assert speed_at_contact > 0.1
    assert max(np.abs(truth.velocity).max() for truth in truths[first:]) < 3.0 * max(speed, speed_at_contact)
    end = truths[-1]
    assert np.abs(end.velocity).max() < 1e-4
    forces = [truth.contact_force for truth in truths[-50:]]
    assert min(forces) > 100.0
    assert np.ptp(forces) < 0.01 * max(forces)
    assert {contact.other for contact in end.contacts} == {obstacle.name}


@pytest.mark.parametrize("obstacle", [pole(), table()], ids=["pole", "table"])
def test_forces_balance_at_the_joints_in_the_blow_and_at_rest(obstacle: Obstacle) -> None:
    """Friction holds no part of the contact: M q̈ + h = motor + friction + Σ Jᵀ F."""
    simulation = Simulation(ROBOT, config(obstacle), 0)
    truths = lowered(simulation, 500)
    blow = max(truths, key=lambda truth: truth.contact_force)
    assert blow.contact_force > 500.0
    for truth in (blow, truths[-1]):
        gear = np.array([joint.gear_ratio for joint in JOINTS])
        dry = np.array(truth.friction_torque) + simulation.plant.model.dof_damping * (
            np.array(truth.velocity) - SUBSTEP_S * np.array(truth.acceleration)
        )
        assert (np.abs(dry) <= gear * Friction().breakaway + 1e-6).all()
        assert np.abs(imbalance(simulation, truth)).max() < 1e-9


def test_a_contact_lies_on_the_pole_and_pushes_straight_away_from_it() -> None:
    """Without friction the force is normal: along the line from the pole's axis to the contact."""
    simulation = Simulation(ROBOT, config(pole(friction=0.0)), 0)
    end = lowered(simulation, 200)[-1]
    (contact,) = end.contacts
    arm = (np.array(contact.position_in_world) - FOREARM - (0.0, 0.0, -0.12)) * (1.0, 0.0, 1.0)
    assert np.linalg.norm(arm) == pytest.approx(0.02, abs=2e-4)
    force = np.array(contact.force_in_world)
    assert np.linalg.norm(force) == pytest.approx(end.contact_force, rel=1e-9)
    assert force / np.linalg.norm(force) == pytest.approx(arm / np.linalg.norm(arm), abs=0.01)


@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_dry_friction_is_bounded_by_the_obstacles_own_coefficient(friction: float) -> None:
    """On the level table |F_xy| ≤ μ F_z, though the links' own coefficient is 1; while it slides, at least μ/√2 F_z."""
    simulation = Simulation(ROBOT, config(table(friction)), 0)
    truths = [truth for truth in lowered(simulation, 250) if truth.contact_force > 50.0]
    forces = np.array([contact.force_in_world for truth in truths for contact in truth.contacts])
    shares = np.hypot(forces[:, 0], forces[:, 1]) / forces[:, 2]
    assert shares.max() <= friction + 1e-6
    assert shares.max() >= 0.7 * friction


def test_contact_between_links_has_both_names_and_balances() -> None:
    """The forearm swings against the chest."""
    posture = {"shoulder_roll": 0.19, "shoulder_yaw": 1.55, "elbow_pitch": -0.2}
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=posture, mass_error=0.0), 0)
    start = [axis.position_counts() for axis in simulation.axes]
    turn = JOINTS[5].encoder_counts * JOINTS[5].gear_ratio
    for cycle in range(400):
        for joint, axis in enumerate(simulation.axes):
            axis.follow_position(start[joint] - (round(cycle * turn / 3000.0) if joint == 5 else 0), 1500)
        simulation.advance()
        truth = simulation.truth(cycle, ())
        assert bool(truth.contacts) == (truth.contact_force > 0.0)
        if truth.contact_force > 100.0:
            break
    (contact,) = truth.contacts
    assert (contact.link, contact.other) == ("wrist_yaw_link", "chest")
    assert np.linalg.norm(contact.force_in_world) <= truth.contact_force * (1.0 + 1e-9)
    assert np.abs(imbalance(simulation, truth)).max() < 1e-9


def test_what_touches_no_more_is_told_no_more() -> None:
    simulation = Simulation(ROBOT, config(pole()), 0)
    model, data = simulation.plant.model, mujoco.MjData(simulation.plant.model)
    contacts = Contacts(model)
    told = []
    for angle in np.linspace(0.0, 1.0, 51):
        data.qpos[:] = simulation.plant.initial_position
        data.qpos[2] += angle
        mujoco.mj_forward(model, data)
        contacts.sample(data)
        assert (contacts.force > 0.0) == bool(contacts.samples)
        told.append({sample.other for sample in contacts.samples})
    # The arm swings down through the pole and leaves it above.
    assert told[0] == told[-1] == set()
    assert {"pole"} in told


def test_a_box_turns_with_its_quaternion() -> None:
    """A lath along y, turned by 90° about z, lies along x: it reaches what it did not."""
    lath = Box(name="lath", position_in_world=(0.9, -0.6, 0.3), half_sizes=(0.02, 0.4, 0.02))
    Simulation(ROBOT, config(lath), 0)
    turned = lath.model_copy(update={"orientation_to_world": (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))})
    with pytest.raises(PlantError, match=r"lath is .* mm deep in link hand"):
        Simulation(ROBOT, config(turned), 0)


@pytest.mark.parametrize("depth", [0.065, 0.09, 0.11])
def test_a_pole_in_the_arm_is_refused_with_link_and_depth(depth: float) -> None:
    """Of two crossing cylinders: the sum of the radii less the distance of the axes."""
    free = Simulation(ROBOT, config(pole()), 0)
    axis = np.array(free.pose("wrist_pitch_link").position_in_world) - free.pose("wrist_yaw_link").position_in_world
    across = np.cross(axis, (0.0, 1.0, 0.0))
    distance = (0.12 - depth) * abs(across[2]) / np.linalg.norm(across)
    words = r"obstacles\.1: inside is (.*) mm deep in link wrist_yaw_link of arm9 at the start.*plant\.initial_posture"
    with pytest.raises(PlantError, match=words) as caught:
        Simulation(ROBOT, config(pole(), pole(depth, name="inside")), 0)
    told = float(str(caught.value).split(" is ")[1].split(" mm")[0])
    assert told == pytest.approx(1000.0 * (0.035 + 0.02 - distance), rel=0.01)


def test_a_name_of_a_link_is_refused() -> None:
    with pytest.raises(PlantError, match=r"plant\.world\.obstacles\.0\.name: 'hand' is a link of arm9"):
        Simulation(ROBOT, config(pole(name="hand")), 0)


def test_a_robot_without_shapes_cannot_have_obstacles() -> None:
    bare = Robot(ROBOT.description, ROBOT.urdf.replace("<collision>", "<!--").replace("</collision>", "-->"))
    Simulation(bare, PlantConfig(initial_posture=POSE), 0)
    with pytest.raises(PlantError, match=r"plant\.world\.obstacles: no moving link of arm9 has a collision shape"):
        Simulation(bare, config(pole()), 0)


LEG = load_robot("leg6")
SQUAT = {"R_HIP_P": -0.6, "R_KNEE": 1.2, "R_ANKLE_P": -0.6}
SOLE_Z = -0.1077
"""Of the lowest face of the contact box in the foot's frame, level in this posture."""


def on_floor(depth: float) -> PlantConfig:
    """leg6 over a floor that its sole is `depth` deep in."""
    foot = np.array(
        Simulation(LEG, PlantConfig(initial_posture=SQUAT, mass_error=0.0), 0).pose("R_ANKLE_P_S").position_in_world
    )
    top = foot[2] + SOLE_Z + depth
    floor = Box(name="floor", position_in_world=(foot[0], foot[1], top - 0.05), half_sizes=(0.5, 0.5, 0.05))
    return PlantConfig(initial_posture=SQUAT, mass_error=0.0, world=World(obstacles=(floor,)))


def test_the_sole_of_a_link_with_a_mesh_stands_on_the_floor_and_the_sensor_carries_it() -> None:
    """At rest the sensor's wrench is the negative of the floor's force and of the foot's weight."""
    simulation = Simulation(LEG, on_floor(-0.002), 0)
    start = [axis.position_counts() for axis in simulation.axes]
    turn = 4096 * 160 / (2.0 * np.pi)
    # The leg stretches by some 6 mm with the sole level, 4 mm into the floor by its targets.
    way = np.array([0.015, 0.0, 0.0, -0.03, 0.0, 0.015]) * turn
    for cycle in range(1000):
        for joint, axis in enumerate(simulation.axes):
            axis.follow_position(start[joint] + round(way[joint] * min(cycle / 300.0, 1.0)), 3000)
        simulation.advance()
        truth = simulation.truth(cycle, ())
    (contact,) = truth.contacts
    assert (contact.link, contact.other) == ("R_ANKLE_P_S", "floor")
    assert np.abs(truth.velocity).max() < 1e-5
    foot, to_world = simulation.pose("R_ANKLE_P_S"), np.zeros(9)
    mujoco.mju_quat2Mat(to_world, np.array(foot.orientation_to_world))
    force, weight = np.array(contact.force_in_world), np.array([0.0, 0.0, -1.5 * 9.81])
    assert force[2] > 20.0
    read, moment = (to_world.reshape(3, 3) @ each for each in truth.sensor_wrenches["ankle"])
    assert read == pytest.approx(-(force + weight), abs=1e-3)
    arm, centre = np.array(contact.position_in_world) - foot.position_in_world, np.array([0.03, 0.0, -0.07])
    expected = -np.cross(arm, force) - np.cross(to_world.reshape(3, 3) @ centre, weight)
    assert moment == pytest.approx(expected, abs=1e-3 * float(np.linalg.norm(expected)))


@pytest.mark.parametrize("depth", [0.003, 0.01])
def test_a_floor_that_the_sole_starts_in_is_refused_with_the_depth(depth: float) -> None:
    with pytest.raises(PlantError, match=r"obstacles\.0: floor is .* mm deep in link R_ANKLE_P_S of leg6") as caught:
        Simulation(LEG, on_floor(depth), 0)
    told = float(str(caught.value).split(" is ")[1].split(" mm")[0])
    assert told == pytest.approx(1000.0 * depth, rel=0.01)


def test_a_leg_of_meshes_alone_is_told_to_have_contact_boxes() -> None:
    bare = Robot(LEG.description.model_copy(update={"contact_boxes": ()}), LEG.urdf)
    with pytest.raises(PlantError, match=r"no moving link of leg6 has a collision shape.*contact_boxes"):
        Simulation(bare, on_floor(-0.002), 0)


def block_position(simulation: Simulation) -> np.ndarray:
    """How far the springs have let a box go [m]; its joints come after the robot's."""
    model, data = simulation.plant.model, simulation._data
    body = model.body("obstacle/table")
    return np.array(data.xpos[body.id])


@pytest.mark.parametrize("stiffness", [1e5, 1e6])
def test_a_box_on_springs_gives_way_by_force_over_stiffness(stiffness: float) -> None:
    """Under the hand's push; its own weight is carried. Along the surface the contact still creeps a little."""
    soft = table().model_copy(update={"stiffness": stiffness, "mass": 3.0})
    simulation = Simulation(ROBOT, config(soft), 0)
    simulation.advance()
    assert np.abs(block_position(simulation)).max() < 1e-9
    truth = lowered(simulation, 750)[-1]
    (contact,) = truth.contacts
    force = -np.array(contact.force_in_world)
    assert force[2] < -50.0
    assert block_position(simulation)[2] == pytest.approx(force[2] / stiffness, rel=1e-3)
    assert block_position(simulation) == pytest.approx(force / stiffness, rel=0.1, abs=1e-6)


def test_a_box_on_springs_keeps_its_contact_from_substep_to_substep() -> None:
    """Once the blow is over, no period is without contact while the hand presses on and slides."""
    soft = table(0.3).model_copy(update={"stiffness": 1e6})
    simulation = Simulation(ROBOT, config(soft), 0)
    forces = np.array([truth.contact_force for truth in lowered(simulation, 500, speed=0.4)])
    large = np.flatnonzero(forces > 50.0)
    assert large.size > 100
    assert (forces[large[0] + 50 :] > 0.0).all()
