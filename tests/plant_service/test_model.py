"""The plant's MuJoCo model against Pinocchio on the same URDF."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from plant_service.errors import PlantError
from plant_service.model import build, reduced
from schemas.bus_load import cycle_plan
from schemas.load import Robot, load_robot
from schemas.robot import LinkBox
from schemas.scenario import PlantConfig

ROBOT = load_robot("arm9")
LEG = load_robot("leg6")
EXACT = PlantConfig(mass_error=0.0)


@pytest.mark.parametrize("seed", range(3))
def test_dynamics_agree_with_pinocchio(seed: int) -> None:
    """M(q) with armature and h(q, q̇) of both libraries."""
    plant = build(ROBOT, EXACT, seed)
    data = mujoco.MjData(plant.model)
    reference = pin.buildModelFromXML(ROBOT.urdf)
    reference.armature = np.array([j.rotor_inertia * j.gear_ratio**2 for j in ROBOT.description.joints])
    generator = np.random.default_rng(seed)
    q, v = generator.uniform(-1.0, 1.0, 9), generator.normal(size=9)
    data.qpos[plant.qpos_address], data.qvel[plant.dof_address] = q, v
    mujoco.mj_forward(plant.model, data)
    mass = np.zeros((9, 9))
    mujoco.mj_fullM(plant.model, data, mass)
    assert mass == pytest.approx(pin.crba(reference, reference.createData(), q), abs=1e-9)
    bias = pin.nonLinearEffects(reference, reference.createData(), q, v)
    assert data.qfrc_bias == pytest.approx(bias, abs=1e-9)


def test_frames_agree_with_pinocchio() -> None:
    plant = build(ROBOT, EXACT, 0)
    data = mujoco.MjData(plant.model)
    reference = pin.buildModelFromXML(ROBOT.urdf)
    q = np.linspace(-0.5, 0.5, 9)
    data.qpos[:] = q
    mujoco.mj_forward(plant.model, data)
    scratch = reference.createData()
    pin.framesForwardKinematics(reference, scratch, q)
    for frame in ("hand", "wrist_sensor"):
        placement = scratch.oMf[reference.getFrameId(frame)]
        body = plant.frame_bodies[frame]
        assert data.xpos[body] == pytest.approx(placement.translation, abs=1e-12)
        assert data.xmat[body].reshape(3, 3) == pytest.approx(placement.rotation, abs=1e-12)


def test_mass_error_scales_mass_and_inertia_by_the_seed() -> None:
    exact, first, again, other = (
        build(ROBOT, config, seed)
        for config, seed in ((EXACT, 0), (PlantConfig(), 1), (PlantConfig(), 1), (PlantConfig(), 2))
    )
    factors = np.array(list(first.mass_factors.values()))
    assert set(np.round(factors, 12)) == {0.9, 1.1}
    assert first.mass_factors == again.mass_factors != other.mass_factors
    assert first.model.body_mass[1:] == pytest.approx(exact.model.body_mass[1:] * factors)
    assert first.model.body_inertia[1:] == pytest.approx(exact.model.body_inertia[1:] * factors[:, np.newaxis])


def test_friction_error_scales_each_joint_and_leaves_the_masses() -> None:
    exact, first = (build(ROBOT, PlantConfig(friction_error=error), 1) for error in (0.0, 0.25))
    assert first.mass_factors == exact.mass_factors
    assert (exact.friction_factors == 1.0).all()
    assert np.ptp(first.friction_factors) > 0.1
    for name in ("dof_damping", "dof_frictionloss"):
        scaled = getattr(exact.model, name)[first.dof_address] * first.friction_factors
        assert getattr(first.model, name)[first.dof_address] == pytest.approx(scaled, rel=1e-12)


def test_armature_and_viscous_friction_are_reflected_through_the_gear() -> None:
    model = build(ROBOT, EXACT, 0).model
    squares = np.array([joint.gear_ratio for joint in ROBOT.description.joints]) ** 2
    assert model.dof_damping == pytest.approx(squares * EXACT.friction.viscous)
    assert model.dof_armature == pytest.approx(squares * [j.rotor_inertia for j in ROBOT.description.joints])


def test_joints_not_described_are_locked_and_order_is_the_descriptions() -> None:
    joints = tuple(reversed(ROBOT.description.joints[:4]))
    robot = Robot(ROBOT.description.model_copy(update={"joints": joints}), ROBOT.urdf)
    plant = build(robot, EXACT, 0)
    assert plant.model.nv == 4
    assert plant.dof_address.tolist() == [3, 2, 1, 0]


def test_neighbours_do_not_collide_but_hand_and_chest_do() -> None:
    plant = build(ROBOT, EXACT, 0)
    data = mujoco.MjData(plant.model)
    mujoco.mj_forward(plant.model, data)
    assert data.ncon == 0
    for angle in np.linspace(-2.3, 0.0, 20):
        data.qpos[5] = angle
        mujoco.mj_forward(plant.model, data)
        assert data.ncon == 0
    data.qpos[:] = (0.0, 0.0, 0.0, 0.2, 1.6, -1.6, 0.0, 0.0, 0.0)
    mujoco.mj_forward(plant.model, data)
    assert data.ncon > 0


def test_meshes_are_left_out() -> None:
    mesh = '<visual><geometry><mesh filename="a.dae"/></geometry></visual>'
    urdf = ROBOT.urdf.replace('<link name="hand">', f'<link name="hand">{mesh}')
    assert "a.dae" in urdf
    assert "a.dae" not in reduced(urdf)
    build(Robot(ROBOT.description, urdf), EXACT, 0)


def leg_in_pinocchio() -> pin.Model:
    """The six joints of leg6, the others of the humanoid locked at zero, without rotors."""
    whole = pin.buildModelFromXML(LEG.urdf)
    names = LEG.description.joint_names
    locked = [whole.getJointId(name) for name in whole.names[1:] if name not in names]
    return pin.buildReducedModel(whole, locked, pin.neutral(whole))


def test_a_leg_of_a_humanoid_with_meshes_builds() -> None:
    """JVRC-1's right leg: MuJoCo cannot read its meshes, and the other 38 joints are locked."""
    plant = build(LEG, EXACT, 0)
    assert plant.model.nv == 6
    assert plant.model.body_mass.sum() == pytest.approx(62.4, abs=0.5)
    reference, data = leg_in_pinocchio(), mujoco.MjData(plant.model)
    reference.armature = np.array([j.rotor_inertia * j.gear_ratio**2 for j in LEG.description.joints])
    q, v = np.array([-0.6, -0.2, 0.1, 1.2, 0.1, -0.5]), np.linspace(-1.0, 1.0, 6)
    data.qpos[plant.qpos_address], data.qvel[plant.dof_address] = q, v
    mujoco.mj_forward(plant.model, data)
    mass = np.zeros((6, 6))
    mujoco.mj_fullM(plant.model, data, mass)
    assert mass == pytest.approx(pin.crba(reference, reference.createData(), q), abs=1e-9)
    assert data.qfrc_bias == pytest.approx(pin.nonLinearEffects(reference, reference.createData(), q, v), abs=1e-9)


def test_the_legs_buses_carry_its_plan_and_its_sensor_holds_a_step() -> None:
    plan = cycle_plan(LEG.description)
    assert plan.fits
    assert plan.needed_s <= 0.98 * plan.available_s
    (sensor,) = LEG.description.force_torque_sensors
    assert 32767 * sensor.force_resolution > 1000.0
    assert 32767 * sensor.torque_resolution > 100.0


def test_the_legs_ranges_lie_inside_the_stops_and_its_loops_are_damped() -> None:
    """(k_d + v N²) / (2 √(k_p M)) with the knee stretched, the links and the rotor in M."""
    plant = build(LEG, EXACT, 0)
    joints = LEG.description.joints
    stops = plant.model.jnt_range[[plant.model.joint(joint.name).id for joint in joints]]
    inside = np.array([(joint.position_min, joint.position_max) for joint in joints]) - stops
    assert (np.abs(inside - (0.05, -0.05)) < 1.001e-3).all()
    assert (inside * (1.0, -1.0) >= 0.05).all()
    reference = leg_in_pinocchio()
    links = pin.crba(reference, reference.createData(), np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])).diagonal()
    for joint, link in zip(joints, links.tolist(), strict=True):
        drive, square = joint.drive, joint.gear_ratio**2
        damping = drive.velocity_gain + EXACT.friction.viscous * square
        stiffness_times_inertia = drive.position_gain * (link + joint.rotor_inertia * square)
        assert 0.6 <= damping / (2.0 * np.sqrt(stiffness_times_inertia)) <= 0.7, joint.name
        assert 0.010 <= damping / drive.position_gain <= 0.020, joint.name


def boxed(*boxes: LinkBox) -> Robot:
    """leg6 with these contact boxes alone."""
    return Robot(LEG.description.model_copy(update={"contact_boxes": boxes}), LEG.urdf)


def knee_box(name: str, link: str, z: float) -> LinkBox:
    return LinkBox(name=name, link=link, position_in_link=(0.0, 0.0, z), half_sizes=(0.04, 0.04, 0.1))


def test_a_contact_box_has_its_place_and_no_mass() -> None:
    half = np.sqrt(0.5)
    box = LinkBox(
        name="shin",
        link="R_KNEE_S",
        position_in_link=(0.1, 0.02, -0.2),
        half_sizes=(0.01, 0.02, 0.15),
        orientation_to_link=(half, 0.0, half, 0.0),
    )
    bare, with_box = (build(robot, EXACT, 0).model for robot in (boxed(), boxed(box)))
    assert (bare.ngeom, with_box.ngeom) == (0, 1)
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        assert (getattr(bare, field) == getattr(with_box, field)).all()
    (geom,) = (with_box.geom(index) for index in range(with_box.ngeom))
    assert with_box.body(geom.bodyid.item()).name == "R_KNEE_S"
    assert geom.type == mujoco.mjtGeom.mjGEOM_BOX
    assert geom.size.tolist() == [0.01, 0.02, 0.15]
    assert geom.pos == pytest.approx([0.1, 0.02, -0.2])
    assert geom.quat == pytest.approx([half, 0.0, half, 0.0])


def test_contact_boxes_of_neighbours_do_not_collide_and_those_of_others_do() -> None:
    """The box that reaches over the knee from the thigh, and the same shape on the link above the thigh."""
    shank = knee_box("shank", "R_KNEE_S", -0.05)
    for link, touches in (("R_HIP_Y_S", False), ("R_HIP_R_S", True)):
        plant = build(boxed(shank, knee_box("upper", link, -0.389)), EXACT, 0)
        data = mujoco.MjData(plant.model)
        data.qpos[plant.qpos_address] = plant.initial_position
        mujoco.mj_forward(plant.model, data)
        assert (data.ncon > 0) == touches


def test_a_contact_box_on_an_unknown_link_is_refused() -> None:
    robot = boxed(knee_box("shank", "R_KNEE_S", 0.0), knee_box("nose", "NOSE_S", 0.0))
    with pytest.raises(PlantError, match=r"contact_boxes\.1\.link: leg6 has no link 'NOSE_S'; it has .*R_KNEE_S"):
        build(robot, EXACT, 0)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (PlantConfig(truth_frames=("nose",)), "truth_frames.*'nose'"),
        (PlantConfig(initial_posture={"elbow_pitch": 2.0}), "elbow_pitch: 2 rad.*-2.3, 0.05"),
    ],
)
def test_what_does_not_fit_is_refused(config: PlantConfig, words: str) -> None:
    with pytest.raises(PlantError, match=words):
        build(ROBOT, config, 0)


def test_a_broken_urdf_is_refused() -> None:
    with pytest.raises(PlantError, match="arm9"):
        build(Robot(ROBOT.description, '<robot name="x"><link name="a"/><joint/></robot>'), EXACT, 0)
