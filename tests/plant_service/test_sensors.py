"""Force/torque sensor and inertial unit of the plant: statics, free fall, noise by the seed."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from plant_service.simulation import Simulation
from schemas.load import Robot, load_robot
from schemas.robot import Imu
from schemas.scenario import Friction, PlantConfig, SensorNoise

ARM = load_robot("arm9")
BEYOND = {"wrist_sensor": (0.2, (0.0, 0.0, -0.015)), "hand": (0.6, (0.0, 0.0, -0.12 + 0.045))}
"""Mass [kg] and centre of mass in the sensor's frame [m] of what the sensor carries."""
POSE = {"shoulder_pitch": -0.6, "shoulder_roll": -0.5, "elbow_pitch": -1.0, "wrist_yaw": 0.7, "wrist_pitch": 0.4}
G = np.array([0.0, 0.0, -9.81])


def with_imu(frame: str) -> Robot:
    imu = Imu(name="imu", frame=frame, bus="arm9-0", base_id=0x300)
    return Robot(ARM.description.model_copy(update={"imus": (imu,)}), ARM.urdf)


def orientation(simulation: Simulation, link: str) -> np.ndarray:
    w, x, y, z = simulation.pose(link).orientation_to_world
    return pin.Quaternion(w, x, y, z).toRotationMatrix()


@pytest.mark.parametrize("mass_error", [0.0, 0.1])
def test_static_wrench_carries_the_weight_beyond(mass_error: float) -> None:
    """f = −Rᵀ m g, moment = Σ r × f of the sensor's own link and the hand."""
    simulation = Simulation(ARM, PlantConfig(initial_posture=POSE, mass_error=mass_error), 3)
    for _ in range(50):
        simulation.advance()
    gravity = orientation(simulation, "wrist_sensor").T @ G
    force, moment = np.zeros(3), np.zeros(3)
    for link, (mass, centre) in BEYOND.items():
        weight = mass * simulation.plant.mass_factors[link] * gravity
        force -= weight
        moment -= np.cross(centre, weight)
    measured = simulation.sensors.wrenches["wrist"]
    assert measured == pytest.approx(np.concatenate([force, moment]), abs=1e-3)
    true_force, true_moment = simulation.truth(0, ()).sensor_wrenches["wrist"]
    assert [*true_force, *true_moment] == measured.tolist()


def test_a_push_on_the_hand_is_felt() -> None:
    """What pushes the hand one way, the parent side must balance the other way."""
    simulation = Simulation(ARM, PlantConfig(initial_posture=POSE), 0)
    simulation.advance()
    before = simulation.sensors.wrenches["wrist"]
    simulation.apply_wrench("hand", (0.0, 0.0, 0.0), (0.0, 0.0, -20.0))
    for _ in range(100):
        simulation.advance()
    change = simulation.sensors.wrenches["wrist"] - before
    rotation = orientation(simulation, "wrist_sensor")
    force = rotation.T @ (0.0, 0.0, 20.0)
    assert change[:3] == pytest.approx(force, abs=0.05)
    assert change[3:] == pytest.approx(np.cross((0.0, 0.0, -0.12), force), abs=0.02)
    simulation.apply_wrench("hand")
    for _ in range(100):
        simulation.advance()
    assert simulation.sensors.wrenches["wrist"] == pytest.approx(before, abs=0.05)


def test_imu_at_rest_feels_the_support_and_knows_its_orientation() -> None:
    simulation = Simulation(with_imu("hand"), PlantConfig(initial_posture=POSE), 0)
    for _ in range(20):
        simulation.advance()
    reading = simulation.sensors.imus["imu"]
    assert reading.angular_velocity == pytest.approx(np.zeros(3), abs=1e-6)
    assert reading.acceleration == pytest.approx(-orientation(simulation, "hand").T @ G, abs=1e-3)
    assert reading.orientation_to_world == pytest.approx(simulation.pose("hand").orientation_to_world)


def test_imu_on_a_turning_link_measures_rate_and_centripetal_acceleration() -> None:
    """Scapula yaw alone turns: ω = q̇ about z and a = −ω² r towards the axis, with gravity's counterpart upwards."""
    free = PlantConfig(friction=Friction(coulomb=0.0, breakaway=0.0), mass_error=0.0)
    simulation = Simulation(with_imu("scapula_roll_link"), free, 0)
    simulation.axes[0].follow_torque(400, 5000)
    for _ in range(100):
        simulation.advance()
    simulation.axes[0].follow_torque(0, 5000)
    simulation.advance()
    truth, reading = simulation.truth(0, ()), simulation.sensors.imus["imu"]
    rate, acceleration = truth.velocity[0], truth.acceleration[0]
    assert rate > 0.5
    assert reading.angular_velocity == pytest.approx([0.0, 0.0, rate], abs=1e-4)
    # r = (0, −0.06, 0): α × r = (0.06 α, 0, 0) and −ω² r = (0, 0.06 ω², 0).
    assert reading.acceleration == pytest.approx([0.06 * acceleration, 0.06 * rate**2, 9.81], abs=0.02)


def test_noise_and_bias_come_from_the_seed() -> None:
    noise = SensorNoise(
        force=0.5, torque=0.02, force_bias=3.0, torque_bias=0.2, angular_velocity=0.01, acceleration=0.1
    )

    def readings(seed: int) -> np.ndarray:
        simulation = Simulation(with_imu("hand"), PlantConfig(noise=noise, mass_error=0.0), seed)
        rows = []
        for _ in range(200):
            simulation.advance()
            imu = simulation.sensors.imus["imu"]
            rows.append([*simulation.sensors.wrenches["wrist"], *imu.angular_velocity, *imu.acceleration])
        return np.array(rows)

    first = readings(1)
    assert (first == readings(1)).all()
    assert (first != readings(2)).any()
    expected = np.repeat([0.5, 0.02, 0.01, 0.1], 3)
    assert first[10:].std(axis=0) == pytest.approx(expected, rel=0.25)
    clean = Simulation(ARM, PlantConfig(mass_error=0.0), 1)
    for _ in range(200):
        clean.advance()
    assert (np.abs(first.mean(axis=0)[:6] - clean.sensors.wrenches["wrist"]) > 3.0 * expected[:6] / np.sqrt(200)).any()
