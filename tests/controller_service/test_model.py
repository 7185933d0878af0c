"""The rigid-body model: finite differences, skew symmetry, joint order, locked joints, armature."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from controller_service.errors import StateError
from controller_service.model import Array, RobotModel
from schemas.errors import ConfigurationError
from schemas.load import Robot

STEP = 1e-6


def states(count: int = 5) -> list[tuple[Array, Array]]:
    rng = np.random.default_rng(3)
    return [(rng.uniform(-1.5, 1.5, 9), rng.normal(size=9)) for _ in range(count)]


@pytest.fixture(scope="module")
def model(arm: Robot) -> RobotModel:
    return RobotModel(arm, ("hand",))


def test_only_the_described_joints_move_and_a_continuous_one_has_one_coordinate(model: RobotModel) -> None:
    assert (model.model.nq, model.model.nv) == (9, 9)
    assert np.isclose(sum(inertia.mass for inertia in model.model.inertias), 21.6)  # the locked finger stays a mass


@pytest.mark.parametrize(("q", "v"), states())
def test_jacobian_and_drift_agree_with_finite_differences(model: RobotModel, q: Array, v: Array) -> None:
    frame = model.configure(q, v).frames["hand"]
    after, before = (model.configure(q + sign * STEP * v, v).frames["hand"] for sign in (1, -1))
    spin = pin.log3(after.rotation @ before.rotation.T)
    velocity = np.concatenate((after.position - before.position, spin)) / (2 * STEP)
    assert np.allclose(frame.velocity, velocity, atol=1e-7)
    assert np.allclose(frame.jacobian @ v, frame.velocity)
    assert np.allclose(frame.drift, (after.velocity - before.velocity) / (2 * STEP), atol=1e-6)


@pytest.mark.parametrize(("q", "v"), states())
def test_the_jacobian_s_rate_agrees_with_finite_differences(model: RobotModel, q: Array, v: Array) -> None:
    """J̇ along q̇; J̇ q̇ is the drift."""
    after, before = (model.configure(q + sign * STEP * v, v).frames["hand"].jacobian for sign in (1, -1))
    frame = model.configure(q, v).frames["hand"]
    assert np.abs(frame.jacobian_rate).max() > 0.1
    assert np.allclose(frame.jacobian_rate, (after - before) / (2 * STEP), atol=1e-7)
    assert np.allclose(frame.jacobian_rate @ v, frame.drift)
    still = model.configure(q, np.zeros(9)).frames["hand"]
    assert not still.jacobian_rate.any()


@pytest.mark.parametrize(("q", "v"), states())
def test_mass_rate_minus_twice_coriolis_is_skew(model: RobotModel, q: Array, v: Array) -> None:
    after, before = (model.configure(q + sign * STEP * v, v).mass for sign in (1, -1))
    skew = (after - before) / (2 * STEP) - 2.0 * model.configure(q, v).coriolis
    assert np.allclose(skew, -skew.T, atol=1e-6)


@pytest.mark.parametrize(("q", "v"), states())
def test_terms_agree_with_inverse_dynamics(model: RobotModel, arm: Robot, q: Array, v: Array) -> None:
    now = model.configure(q, v)
    a = np.sin(np.arange(9.0))
    assert np.allclose(now.mass @ a + now.nonlinear, pin.rnea(model.model, model.model.createData(), q, v, a))
    assert np.allclose(now.coriolis @ v + now.gravity, now.nonlinear)
    assert np.allclose(now.gravity, model.configure(q, np.zeros(9)).nonlinear)
    assert np.linalg.eigvalsh(now.mass).min() > 0.0
    bare = RobotModel(Robot(arm.description.model_copy(update={"joints": _without_rotors(arm)}), arm.urdf))
    armature = [joint.rotor_inertia * joint.gear_ratio**2 for joint in arm.description.joints]
    assert np.allclose(now.mass - bare.configure(q, v).mass, np.diag(armature))


def test_the_description_s_order_is_kept_when_the_urdf_s_differs(arm: Robot) -> None:
    order = [4, 0, 8, 2, 6, 1, 3, 7, 5]
    joints = tuple(arm.description.joints[i] for i in order)
    shuffled = RobotModel(Robot(arm.description.model_copy(update={"joints": joints}), arm.urdf), ("hand",))
    straight = RobotModel(arm, ("hand",))
    q, v = states(1)[0]
    one, other = straight.configure(q, v), shuffled.configure(q[order], v[order])
    assert np.allclose(one.mass[np.ix_(order, order)], other.mass)
    assert np.allclose(one.coriolis[np.ix_(order, order)], other.coriolis)
    assert np.allclose(one.nonlinear[order], other.nonlinear)
    assert np.allclose(one.frames["hand"].jacobian[:, order], other.frames["hand"].jacobian)
    assert np.allclose(one.frames["hand"].jacobian_rate[:, order], other.frames["hand"].jacobian_rate)
    assert np.allclose(one.frames["hand"].drift, other.frames["hand"].drift)
    assert np.allclose(straight.pose(q, "hand")[0], shuffled.pose(q[order], "hand")[0])


def test_a_configuration_cannot_be_written_and_outlives_the_next(model: RobotModel) -> None:
    (q, v), (q2, v2) = states(2)
    now = model.configure(q, v)
    hand = now.frames["hand"]
    arrays = (now.mass, now.coriolis, now.nonlinear, hand.jacobian, hand.jacobian_rate, hand.drift, hand.velocity)
    kept = [array.copy() for array in arrays]
    model.configure(q2, v2)
    assert all(np.array_equal(array, copy) for array, copy in zip(arrays, kept, strict=True))
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_what_does_not_fit_is_refused(model: RobotModel, arm: Robot) -> None:
    with pytest.raises(StateError, match="9"):
        model.configure(np.zeros(8), np.zeros(8))
    with pytest.raises(ConfigurationError, match="'wheel'"):
        RobotModel(arm, ("wheel",))
    with pytest.raises(ConfigurationError, match="Pinocchio"):
        RobotModel(Robot(arm.description, '<robot name="x"/>'))


def _without_rotors(arm: Robot) -> tuple[object, ...]:
    return tuple(joint.model_copy(update={"rotor_inertia": 0.0}) for joint in arm.description.joints)
