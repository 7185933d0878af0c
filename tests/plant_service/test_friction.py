"""Joint friction: [Cisneros 2018] Table I at the motor, seen at the joint; stiction without creep; dissipation."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from plant_service.friction import BRAKE_FACTOR, DryFriction, friction_factors
from plant_service.model import FRICTION_IMPEDANCE, build
from plant_service.simulation import Simulation
from schemas.load import Robot, load_robot
from schemas.robot import RobotDescription
from schemas.scenario import Friction, PlantConfig

TABLE = Friction()
N = 250.0
STATES = ()
EXACT = PlantConfig(torque_scale=1.0, mass_error=0.0)
WHEEL_URDF = """<robot name="wheel"><link name="base"/>
<joint name="hinge" type="continuous"><parent link="base"/><child link="wheel"/><axis xyz="0 0 1"/></joint>
<link name="wheel"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def wheel() -> Robot:
    """One geared joint about the vertical, without gravity's help or hindrance, resolution 0.1 N·m."""
    drive = {
        "kind": "torque",
        "bus": "b",
        "node_id": 1,
        "rated_motor_torque": 0.4,
        "position_gain": 1e4,
        "velocity_gain": 300,
    }
    joint = {
        "name": "hinge",
        "gear_ratio": N,
        "rotor_inertia": 5e-5,
        "torque_limit": 300,
        "torque_rate_limit": 1e5,
        "velocity_limit": 5,
        "position_min": -1000,
        "position_max": 1000,
        "encoder_counts": 4096,
        "drive": drive,
    }
    description = RobotDescription.model_validate(
        {
            "name": "wheel",
            "urdf": "wheel.urdf",
            "rate_hz": 500,
            "compute_budget_s": 1e-4,
            "buses": [{"name": "b", "channel": "b"}],
            "joints": [joint],
        }
    )
    return Robot(description, WHEEL_URDF)


def pushed_wheel(torque: float, config: PlantConfig = EXACT) -> Simulation:
    """The wheel in torque mode under a constant torque [N·m]."""
    simulation = Simulation(wheel(), config, 0)
    simulation.axes[0].follow_torque(round(10.0 * torque), 3000)
    return simulation


def run(simulation: Simulation, seconds: float) -> Simulation:
    for _ in range(round(seconds * 500.0)):
        simulation.advance()
    return simulation


def position(simulation: Simulation) -> float:
    return simulation.truth(0, STATES).position[0]


def velocity(simulation: Simulation) -> float:
    return simulation.truth(0, STATES).velocity[0]


def test_bound_is_the_stribeck_curve() -> None:
    law = DryFriction(TABLE, np.full(5, N), np.full(5, 300.0))
    law.set_brakes(np.zeros(5, dtype=bool))
    v = np.array([0.0, 2e-4, -8e-4, 2e-3, -1.0])
    expected = N * (0.04 + 0.01 * np.exp(-((v * N / 0.2) ** 2)))
    assert law.bound(v) == pytest.approx(expected, rel=1e-12)
    assert law.bound(v)[0] == N * TABLE.breakaway


def test_brake_adds_to_friction_where_engaged() -> None:
    law = DryFriction(TABLE, np.full(2, N), np.full(2, 300.0))
    law.set_brakes(np.array([True, False]))
    assert law.bound(np.zeros(2)) == pytest.approx([12.5 + BRAKE_FACTOR * 300.0, 12.5])


def test_a_factor_scales_the_curve_and_not_the_brake() -> None:
    factors = np.array([0.7, 1.0, 1.3])
    true, given = (DryFriction(TABLE, np.full(3, N), np.full(3, 300.0), factor) for factor in (factors, 1.0))
    brake = BRAKE_FACTOR * 300.0
    for v in (0.0, 4e-4, 0.1):
        velocity = np.full(3, v)
        assert true.bound(velocity) - brake == pytest.approx(factors * (given.bound(velocity) - brake), rel=1e-12)


def test_factors_are_uniform_within_the_error_and_drawn_from_the_seed() -> None:
    factors = friction_factors(4000, 0.3, 5)
    assert factors.min() >= 0.7
    assert factors.max() <= 1.3
    shares = np.histogram(factors, bins=4, range=(0.7, 1.3))[0] / 4000.0
    assert shares == pytest.approx(0.25, abs=0.03)
    assert (factors == friction_factors(4000, 0.3, 5)).all()
    assert (factors != friction_factors(4000, 0.3, 6)).all()
    assert (friction_factors(9, 0.0, 5) == 1.0).all()


def test_friction_of_a_joint_is_that_of_its_factor() -> None:
    """Steady velocities of wheels of several seeds: τ = f (N c + N² v q̇); damping and breakaway with the same f."""
    factors = set()
    for seed in range(3):
        simulation = Simulation(wheel(), PlantConfig(torque_scale=1.0, mass_error=0.0, friction_error=0.4), seed)
        plant = simulation.plant
        (factor,) = plant.friction_factors
        assert plant.model.dof_damping[0] == pytest.approx(factor * N**2 * TABLE.viscous, rel=1e-12)
        simulation.axes[0].follow_torque(400, 3000)
        assert velocity(run(simulation, 2.0)) == pytest.approx(
            (40.0 / factor - N * TABLE.coulomb) / (N**2 * TABLE.viscous), rel=1e-4
        )
        factors.add(factor)
    assert len(factors) == 3


@pytest.mark.parametrize("motor_velocity", [0.05, 0.1, 0.2, 0.4, 1.0, 10.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_friction_force_in_the_model_follows_the_curve(motor_velocity: float, sign: float) -> None:
    """The constraint gives −F(q̇) − N² v q̇ to a joint too heavy to be stopped in one step."""
    plant = build(wheel(), PlantConfig(), 0)
    plant.model.dof_armature[:] = 1e6
    mujoco.mj_setConst(plant.model, mujoco.MjData(plant.model))
    data = mujoco.MjData(plant.model)
    data.qvel[0] = v = sign * motor_velocity / N
    law = DryFriction(TABLE, np.array([N]), np.array([300.0]))
    law.set_brakes(np.array([False]))
    plant.model.dof_frictionloss[:] = law.bound(data.qvel)
    mujoco.mj_forward(plant.model, data)
    dry = N * (0.04 + 0.01 * np.exp(-((motor_velocity / 0.2) ** 2)))
    assert data.qfrc_constraint[0] == pytest.approx(-sign * dry, rel=1e-6)
    assert data.qfrc_passive[0] == pytest.approx(-(N**2) * TABLE.viscous * v, rel=1e-12)


@pytest.mark.parametrize("share", [-0.8, 0.3, 0.8, 0.98])
def test_stiction_holds_a_joint_still(share: float) -> None:
    """Below breakaway a joint moves less than 1e-5 rad in 2 s: what MuJoCo's soft constraint lets it creep."""
    simulation = run(pushed_wheel(share * N * TABLE.breakaway), 2.0)
    assert abs(position(simulation)) < 1e-5
    creep = (1.0 - FRICTION_IMPEDANCE) * 0.0005 * abs(share) * 12.5 / 3.2
    assert abs(velocity(simulation)) < 2.0 * creep
    assert simulation.truth(0, STATES).friction_torque[0] == pytest.approx(-share * 12.5, abs=0.06)


def test_above_breakaway_a_joint_moves() -> None:
    assert position(run(pushed_wheel(1.05 * N * TABLE.breakaway), 0.2)) > 1e-2


@pytest.mark.parametrize("torque", [13.0, 20.0, 40.0])
def test_steady_velocity_balances_friction(torque: float) -> None:
    """τ = N c + N² v q̇ once the Stribeck term is gone."""
    simulation = run(pushed_wheel(torque), 2.0)
    assert velocity(simulation) == pytest.approx((torque - N * 0.04) / (N**2 * 0.0005), rel=1e-4)


def test_a_joint_let_go_slows_down_and_stays_at_rest() -> None:
    """Energy never grows, the sign of the velocity never changes, and rest is rest."""
    simulation = run(pushed_wheel(100.0), 0.3)
    simulation.axes[0].follow_torque(0, 3000)
    energies, velocities = [], []
    for _ in range(1000):
        simulation.advance()
        energies.append(simulation.kinetic_energy)
        velocities.append(velocity(simulation))
    # Rounding of the solver leaves some 1e-15 rad/s.
    assert (np.diff(energies) <= 1e-28).all()
    assert min(velocities) > -1e-13
    assert abs(velocities[-1]) < 1e-13


@pytest.mark.parametrize("field", ["coulomb", "breakaway", "viscous"])
def test_without_friction_nothing_resists(field: str) -> None:
    none = Friction(coulomb=0.0, breakaway=0.0, viscous=0.0)
    config = PlantConfig(torque_scale=1.0, mass_error=0.0, friction=none)
    simulation = run(pushed_wheel(10.0, config), 0.5)
    inertia = 0.1 + 5e-5 * N**2
    assert velocity(simulation) == pytest.approx(10.0 * 0.5 / inertia, rel=1e-6)
    one = PlantConfig(torque_scale=1.0, mass_error=0.0, friction=none.model_copy(update={field: 0.05}))
    assert velocity(run(pushed_wheel(10.0, one), 0.5)) < velocity(simulation)


def test_brake_holds_the_arm_when_power_is_off() -> None:
    robot = load_robot("arm9")
    config = PlantConfig(initial_posture={"shoulder_pitch": -1.5, "scapula_roll": -0.5})
    simulation = Simulation(robot, config, 0)
    start = np.array(simulation.truth(0, STATES).position)
    run(simulation, 1.0)
    assert np.abs(np.array(simulation.truth(0, STATES).position) - start).max() < 1e-5
