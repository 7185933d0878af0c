"""The plant's MuJoCo model against Pinocchio on the same URDF."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from plant_service.errors import PlantError
from plant_service.model import build, reduced
from schemas.load import Robot, load_robot
from schemas.scenario import PlantConfig

ROBOT = load_robot("arm9")
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


def test_a_leg_of_a_humanoid_with_meshes_builds() -> None:
    """JVRC-1's right leg: MuJoCo cannot read its meshes, and the other 38 joints are locked."""
    urdf = Path(str(resources.files("jvrc_description"))) / "urdf" / "jvrc1.urdf"
    names = ("R_HIP_P", "R_HIP_R", "R_HIP_Y", "R_KNEE", "R_ANKLE_R", "R_ANKLE_P")
    template = ROBOT.description.joints[0]
    joints = tuple(template.model_copy(update={"name": name}) for name in names)
    leg = ROBOT.description.model_copy(update={"joints": joints, "force_torque_sensors": ()})
    plant = build(Robot(leg, urdf.read_text(encoding="utf-8")), EXACT, 0)
    assert plant.model.nv == 6
    assert plant.model.body_mass.sum() == pytest.approx(62.4, abs=0.5)


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
