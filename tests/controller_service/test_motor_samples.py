"""Samples for the identification: what cannot tell the gains apart is refused, with joint, reason, value and bound."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from controller_service.model import Array
from controller_service.motor_samples import (
    BLOCK,
    Fault,
    IdentificationError,
    MotorSamples,
    Regression,
    SampleBounds,
    check_samples,
    condition_number,
    sign_beyond,
)
from schemas.errors import CosimError


def samples(m: int = 400, seed: int = 3) -> MotorSamples:
    generator = np.random.default_rng(seed)
    torque, velocity = generator.uniform(-30.0, 30.0, m), generator.normal(0.0, 1.0, m)
    return MotorSamples(2e-4 * torque + 7e-3 * velocity, torque, velocity)


def changed(**changes: Array) -> MotorSamples:
    return dataclasses.replace(samples(), **changes)


def with_value(value: float) -> Array:
    torque = samples().torque.copy()
    torque[[7, 8]] = value
    return torque


def test_good_samples_pass_with_ranges_of_their_size() -> None:
    check_samples("knee", samples(), coulomb=True, bounds=SampleBounds(torque_range=60.0, velocity_range=4.0))


@pytest.mark.parametrize(
    ("bad", "reason", "value", "bound"),
    [
        (changed(torque=np.zeros(399)), Fault.SHAPE, 399, 400),
        (changed(velocity=np.zeros((400, 1))), Fault.SHAPE, 400, 400),
        (samples(49), Fault.TOO_FEW, 49, 50),
        (changed(torque=with_value(np.nan)), Fault.NOT_FINITE, 2, 0),
        (changed(torque=with_value(-np.inf)), Fault.NOT_FINITE, 2, 0),
        (changed(torque=np.full(400, 4.1)), Fault.TORQUE_SPREAD, 0.0, 4.1e-9),
        (changed(velocity=np.full(400, 0.3)), Fault.VELOCITY_SPREAD, 0.0, 3e-10),
        (changed(offset=np.abs(samples().offset)), Fault.OFFSET_SIGN, 0.0, 0.01),
        (changed(velocity=np.abs(samples().velocity)), Fault.VELOCITY_SIGN, 0.0, 0.01),
        (changed(velocity=-0.1 * samples().torque), Fault.COLLINEAR, np.inf, 30.0),
    ],
)
def test_bad_samples_are_refused(bad: MotorSamples, reason: Fault, value: float, bound: float) -> None:
    with pytest.raises(IdentificationError, match=r"^knee at rest: .*\. [A-Z][^{}]*\.$") as caught:
        check_samples("knee", bad, part=" at rest")
    error = caught.value
    assert isinstance(error, CosimError)
    assert (error.joint, error.reason) == ("knee", reason)
    assert error.value == pytest.approx(value, abs=1e-12)
    assert error.bound == pytest.approx(bound)


def test_the_spread_is_measured_against_the_range_that_is_given() -> None:
    few = samples()
    for bounds, reason, values in (
        (SampleBounds(torque_range=1000.0), Fault.TORQUE_SPREAD, few.torque),
        (SampleBounds(velocity_range=50.0), Fault.VELOCITY_SPREAD, few.velocity),
    ):
        with pytest.raises(IdentificationError) as caught:
            check_samples("knee", few, bounds=bounds)
        assert caught.value.reason == reason
        assert caught.value.value == pytest.approx(np.std(values))
        assert caught.value.bound == pytest.approx(0.05 * max(bounds.torque_range or 0.0, bounds.velocity_range or 0.0))


def test_noise_at_rest_is_no_motion_the_other_way() -> None:
    one_way = samples()
    creeping = MotorSamples(one_way.offset, one_way.torque, np.where(one_way.velocity > 0.0, one_way.velocity, -1e-4))
    check_samples("knee", creeping)
    with pytest.raises(IdentificationError, match="rarer way") as caught:
        check_samples("knee", creeping, sign_velocity=1e-3)
    assert caught.value.reason == Fault.VELOCITY_SIGN


def test_a_speed_that_is_always_the_same_cannot_tell_viscous_from_dry_friction() -> None:
    steady = changed(velocity=0.4 * np.sign(samples().velocity))
    check_samples("knee", steady)
    with pytest.raises(IdentificationError, match="velocity and its sign") as caught:
        check_samples("knee", steady, coulomb=True)
    assert caught.value.reason == Fault.COLLINEAR


def test_columns_that_are_almost_one_are_refused_by_their_condition_number() -> None:
    noise = np.random.default_rng(1).normal(size=400)
    almost = changed(velocity=0.1 * samples().torque + 0.02 * noise)
    expected = np.linalg.cond(np.column_stack([almost.torque / 10.0, almost.velocity]))
    with pytest.raises(IdentificationError, match="cannot be told apart") as caught:
        check_samples("knee", almost)
    assert 30.0 < caught.value.value < 1e4
    assert caught.value.value == pytest.approx(expected, rel=1e-3)
    check_samples("knee", almost, bounds=SampleBounds(condition=1e4))


def test_samples_at_rest_need_no_velocity() -> None:
    check_samples("knee", changed(velocity=np.zeros(400)), moving=False)


def test_the_condition_number_is_that_of_the_matrix_with_unit_columns() -> None:
    generator = np.random.default_rng(0)
    A = generator.normal(size=(90, 3)) @ np.array([[1.0, 0.9, 0.0], [0.0, 0.2, 0.0], [0.3, 0.0, 50.0]])
    unit = A / np.linalg.norm(A, axis=0)
    assert condition_number(A.T @ A) == pytest.approx(np.linalg.cond(unit), rel=1e-9)


@pytest.mark.parametrize("m", [BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5])
def test_blocks_hold_every_sample_once_and_the_gram_matrix_is_of_all(m: int) -> None:
    data = samples(m)
    problem = Regression(data, coulomb=True, sign_velocity=0.2)
    whole = np.array([data.torque, data.velocity, sign_beyond(data.velocity, 0.2), data.offset])
    seen = np.full((4, m), np.nan)
    for part, block in problem.blocks():
        assert np.isnan(seen[:, part]).all()
        seen[:, part] = block
    assert np.array_equal(seen, whole)
    assert problem.gram() == pytest.approx(whole @ whole.T, rel=1e-11)


def test_the_sign_is_zero_below_its_threshold_and_at_rest() -> None:
    velocity = np.array([-0.2, -0.1, -0.09, 0.0, 0.09, 0.1, 0.2])
    assert sign_beyond(velocity, 0.1).tolist() == [-1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 1.0]
    assert sign_beyond(velocity, 0.0).tolist() == [-1.0, -1.0, -1.0, 0.0, 1.0, 1.0, 1.0]


def test_thinned_samples_are_evenly_picked_and_stay_together() -> None:
    data = samples(1003)
    data = dataclasses.replace(data, torque=np.arange(1003.0), offset=np.arange(1003.0))
    thin = data.thinned(100)
    assert len(thin) == 100
    assert set(np.diff(thin.torque)) <= {10.0, 11.0}
    assert np.array_equal(thin.offset, thin.torque)
    assert np.array_equal(thin.velocity, data.velocity[thin.torque.astype(int)])
    assert data.thinned(5000) is data
