"""The simulation as a whole: balance, energy, modes, truth, and the same bits from the same seed."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from plant_service.errors import DivergedError, PlantError
from plant_service.simulation import Simulation
from schemas.base import Vector
from schemas.load import Robot, load_robot
from schemas.messages import DriveState
from schemas.scenario import Friction, PlantConfig, SensorNoise

ROBOT = load_robot("arm9")
JOINTS = ROBOT.description.joints
STATES = (DriveState.OPERATION_ENABLED,) * 9
POSE = {"scapula_roll": -0.3, "shoulder_pitch": -0.8, "shoulder_roll": -0.6, "elbow_pitch": -1.2, "wrist_pitch": 0.5}
SLIPPERY = Friction(coulomb=0.0, breakaway=0.0, viscous=0.0)


def advance(simulation: Simulation, periods: int) -> None:
    for _ in range(periods):
        simulation.advance()


def gravity_torque(q: Vector) -> np.ndarray:
    model = pin.buildModelFromXML(ROBOT.urdf)
    return pin.rnea(model, model.createData(), np.array(q), np.zeros(9), np.zeros(9))


def hold_positions(simulation: Simulation, seconds: float) -> None:
    targets = [axis.position_counts() for axis in simulation.axes]
    for _ in range(round(seconds * 500.0)):
        for axis, target in zip(simulation.axes, targets, strict=True):
            axis.follow_position(target, 5000)
        simulation.advance()


def test_brakes_carry_what_pinocchio_says() -> None:
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=POSE, mass_error=0.0), 0)
    for _ in range(10):
        simulation.advance()
    truth = simulation.truth(0, STATES)
    assert truth.friction_torque == pytest.approx(gravity_torque(truth.position), abs=1e-3)
    assert truth.motor_torque == (0.0,) * 9
    assert truth.mode == (0,) * 9


def test_motors_carry_what_pinocchio_says_and_report_more() -> None:
    """Without friction the true motor torque is gravity's; the drive reports 1 / torque_scale times as much."""
    config = PlantConfig(initial_posture=POSE, mass_error=0.0, friction=SLIPPERY, torque_scale=0.9)
    simulation = Simulation(ROBOT, config, 0)
    hold_positions(simulation, 2.0)
    truth = simulation.truth(0, STATES)
    gravity = gravity_torque(truth.position)
    # One count of the encoder is up to 0.2 N·m.
    assert truth.motor_torque == pytest.approx(gravity, abs=0.3)
    reported = [
        axis.torque_per_mille() * joint.drive.rated_motor_torque * joint.gear_ratio / 1000.0
        for axis, joint in zip(simulation.axes, JOINTS, strict=True)
    ]
    assert reported == pytest.approx(gravity / 0.9, abs=0.4)


def test_sag_under_the_position_loop_is_small() -> None:
    simulation = Simulation(ROBOT, PlantConfig(initial_posture={"shoulder_roll": -1.55, "scapula_roll": -0.0}), 1)
    start = np.array(simulation.truth(0, STATES).position)
    hold_positions(simulation, 0.5)
    assert np.rad2deg(np.abs(np.array(simulation.truth(0, STATES).position) - start)).max() < 0.15


def test_energy_is_conserved_without_friction() -> None:
    """The arm swings freely: kinetic plus potential energy drifts by O(step)."""

    def drift(substep_s: float) -> float:
        config = PlantConfig(initial_posture=POSE, friction=SLIPPERY, substep_s=substep_s)
        simulation = Simulation(ROBOT, config, 0)
        for axis in simulation.axes:
            axis.follow_torque(0, 5000)
        plant, data = simulation.plant, mujoco.MjData(simulation.plant.model)
        energies, kinetic = [], []
        for _ in range(150):
            truth = simulation.truth(0, STATES)
            data.qpos[plant.qpos_address] = truth.position
            mujoco.mj_kinematics(plant.model, data)
            mujoco.mj_energyPos(plant.model, data)
            energies.append(data.energy[0] + truth.kinetic_energy)
            kinetic.append(truth.kinetic_energy)
            simulation.advance()
        assert max(kinetic) > 1.0
        return (max(energies) - min(energies)) / max(kinetic)

    coarse, fine = drift(0.0005), drift(0.00025)
    assert coarse < 0.01
    assert fine < 0.6 * coarse


def test_truth_is_consistent_with_itself() -> None:
    """Newton at the joints from the truth alone: M q̈ + h = τ_m + τ_f, and the pose is that of the position."""
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=POSE, mass_error=0.0), 0)
    for index, axis in enumerate(simulation.axes):
        axis.follow_torque((-1) ** index * 400, 5000)
    for _ in range(25):
        simulation.advance()
    truth = simulation.truth(25, STATES)
    assert truth.time_ns == 50_000_000
    assert truth.mode == (10,) * 9
    assert len(truth.motor_torque_substeps) == 4
    assert truth.motor_torque_substeps[-1] == truth.motor_torque
    model = pin.buildModelFromXML(ROBOT.urdf)
    model.armature = np.array([j.rotor_inertia * j.gear_ratio**2 for j in JOINTS])
    data = model.createData()
    q, v, a = (np.array(values) for values in (truth.position, truth.velocity, truth.acceleration))
    left = pin.rnea(model, data, q, v, a)
    right = np.array(truth.motor_torque) + np.array(truth.friction_torque)
    assert left == pytest.approx(right, abs=0.5)
    assert truth.kinetic_energy == pytest.approx(0.5 * v @ pin.crba(model, data, q) @ v, rel=1e-6)
    pin.framesForwardKinematics(model, data, q)
    expected = data.oMf[model.getFrameId("hand")].translation
    assert truth.frames["hand"].position_in_world == pytest.approx(expected, abs=1e-12)


def test_motor_gives_scale_times_the_nominal_torque() -> None:
    simulation = Simulation(ROBOT, PlantConfig(torque_scale=0.8, initial_posture=POSE), 0)
    simulation.axes[2].follow_torque(500, 5000)
    simulation.advance()
    nominal = 500 * 280 * 0.6 / 1000.0 - JOINTS[2].drive.dead_zone
    assert simulation.truth(0, STATES).motor_torque[2] == pytest.approx(0.8 * nominal)


def test_a_target_is_tracked() -> None:
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=POSE), 0)
    start = [axis.position_counts() for axis in simulation.axes]
    for cycle in range(500):
        for axis, counts in zip(simulation.axes, start, strict=True):
            axis.follow_position(counts + round(20000 * (1.0 - np.cos(0.01 * cycle))), 5000)
        simulation.advance()
        if cycle > 100:
            error = [
                axis.position_counts() - counts - 20000 * (1.0 - np.cos(0.01 * cycle))
                for axis, counts in zip(simulation.axes, start, strict=True)
            ]
            turns = np.array([joint.encoder_counts * joint.gear_ratio for joint in JOINTS])
            assert np.rad2deg(np.abs(error) * 2.0 * np.pi / turns).max() < 0.4


def test_contact_with_the_own_chest_is_reported() -> None:
    posture = {"shoulder_roll": 0.19, "shoulder_yaw": 1.55, "elbow_pitch": -0.2}
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=posture), 0)
    assert simulation.truth(0, STATES).contact_force == 0.0
    start = [axis.position_counts() for axis in simulation.axes]
    turn = JOINTS[5].encoder_counts * JOINTS[5].gear_ratio
    for cycle in range(400):
        for joint, axis in enumerate(simulation.axes):
            axis.follow_position(start[joint] - (round(cycle * turn / 3000.0) if joint == 5 else 0), 1500)
        simulation.advance()
        if simulation.truth(0, STATES).contact_force > 1.0:
            return
    pytest.fail("no contact")


def records(seed: int, config: PlantConfig) -> list[str]:
    simulation = Simulation(ROBOT, config, seed)
    rows = []
    for cycle in range(60):
        for index, axis in enumerate(simulation.axes):
            if cycle < 20:
                axis.follow_position(axis.position_counts() + 200, 4000)
            elif cycle < 40:
                axis.follow_torque(30 * index, 4000)
            elif cycle == 40:
                axis.hold()
        simulation.advance()
        reports = [(axis.position_counts(), axis.torque_per_mille()) for axis in simulation.axes]
        wrench = simulation.sensors.wrenches["wrist"].tolist()
        rows.append(f"{simulation.truth(cycle, STATES).model_dump_json()} {reports} {wrench}")
    return rows


def test_same_seed_same_bits_other_seed_others() -> None:
    config = PlantConfig(noise=SensorNoise(force=0.1, torque=0.01, motor_torque=0.3), initial_posture=POSE)
    first = records(4, config)
    assert first == records(4, config)
    assert all(a != b for a, b in zip(first, records(5, config), strict=True))


def test_holding_from_torque_does_not_jump_and_does_not_drop() -> None:
    """Motor torque over the change of mode is continuous to 1 % of the limit, with every error the plant has."""
    simulation = Simulation(ROBOT, PlantConfig(initial_posture=POSE), 2)
    hold_positions(simulation, 0.5)
    for axis in simulation.axes:
        axis.follow_torque(axis.torque_per_mille(), 5000)
    for _ in range(20):
        simulation.advance()
    before = simulation.truth(0, STATES)
    for axis in simulation.axes:
        axis.hold()
    simulation.advance()
    after = simulation.truth(0, STATES)
    limits = np.array([joint.torque_limit for joint in JOINTS])
    steps = np.abs(np.array(after.motor_torque_substeps[0]) - np.array(before.motor_torque)) / limits
    assert steps.max() < 0.01
    for _ in range(500):
        simulation.advance()
    end = simulation.truth(0, STATES)
    assert np.rad2deg(np.abs(np.array(end.position) - np.array(before.position))).max() < 0.5


def test_unknown_link_is_refused() -> None:
    with pytest.raises(PlantError, match="no link 'nose'"):
        Simulation(ROBOT, PlantConfig(), 0).apply_wrench("nose", force_in_world=(1.0, 0.0, 0.0))


def test_divergence_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = JOINTS[0].drive.model_copy(update={"velocity_gain": 1e6})
    wild = JOINTS[0].model_copy(update={"drive": drive, "torque_limit": 1e300})
    robot = Robot(ROBOT.description.model_copy(update={"joints": (wild, *JOINTS[1:])}), ROBOT.urdf)
    simulation = Simulation(robot, PlantConfig(), 0)
    simulation.axes[0].follow_position(simulation.axes[0].position_counts() + 1000, 2**1000)
    with pytest.raises(DivergedError, match=r"velocity .* rad/s at .*BADQ"):
        advance(simulation, 200)
    assert not list(tmp_path.iterdir())
