"""What a sensor carries: exact without noise, right in its statistics, data that cannot tell it refused."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest

from controller_service.ft_calibration import (
    MAXIMUM_CONDITION,
    CalibrationError,
    Payload,
    gravity_in_sensor,
    identify_payload,
    payload_difference,
    static_poses,
)
from controller_service.model import Array, RobotModel
from schemas.errors import ConfigurationError
from schemas.load import Robot

TRUE = Payload(1.7, np.array([0.05, -0.02, -0.11]), np.array([3.0, -2.0, 5.0, 0.4, -0.1, 0.2]))


def directions(count: int, seed: int = 0, spread: float = 0.6) -> Array:
    """Gravity in a sensor that is turned about two horizontal axes, (count, 3)."""
    angles = np.random.default_rng(seed).uniform(-spread, spread, (count, 2))
    turns = [pin.rpy.rpyToMatrix(roll, pitch, 0.0) for roll, pitch in angles]
    return np.array([turn.T @ [0.0, 0.0, -9.81] for turn in turns])


def readings(gravity: Array, payload: Payload = TRUE) -> Array:
    """Weight at the centre of mass, carried by the sensor: what it exerts holds the body up."""
    held = [-payload.mass * g for g in gravity]
    rows = [np.concatenate((f, np.cross(payload.centre_of_mass, f))) for f in held]
    return np.array(rows) + payload.wrench_offset


def test_the_body_and_the_offsets_are_recovered_without_noise() -> None:
    for count in (4, 12):
        gravity = directions(count)
        fit = identify_payload(gravity, readings(gravity))
        assert fit.payload.mass == pytest.approx(TRUE.mass, abs=1e-11)
        assert fit.payload.first_moment == pytest.approx(TRUE.first_moment, abs=1e-11)
        assert fit.payload.wrench_offset == pytest.approx(TRUE.wrench_offset, abs=1e-10)
        assert fit.payload.centre_of_mass == pytest.approx(TRUE.first_moment / TRUE.mass)
        assert max(fit.residual_force_rms, fit.residual_torque_rms, fit.mass_deviation) < 1e-11
        assert 1.0 <= fit.condition < MAXIMUM_CONDITION


def test_the_stated_deviations_are_those_of_many_noisy_calibrations() -> None:
    gravity, rng = directions(10, seed=2), np.random.default_rng(5)
    exact, noise = readings(gravity), np.repeat([0.2, 0.01], 3)
    fits = [identify_payload(gravity, exact + noise * rng.normal(size=(10, 6))) for _ in range(600)]
    values = np.array([[f.payload.mass, *f.payload.first_moment, *f.payload.wrench_offset] for f in fits])
    stated = np.array([[f.mass_deviation, *f.first_moment_deviation, *f.offset_deviation] for f in fits])
    expected = np.sqrt(np.mean(stated**2, axis=0))
    assert np.std(values, axis=0) == pytest.approx(expected, rel=0.12)
    truth = np.array([TRUE.mass, *TRUE.first_moment, *TRUE.wrench_offset])
    assert (np.abs(values.mean(axis=0) - truth) < 4.0 * expected / math.sqrt(600)).all()
    # Residuals lose a degree of freedom an unknown: four of the forces', six of the moments'
    force, moment = (
        np.sqrt(np.mean([getattr(f, f"residual_{name}_rms") ** 2 for f in fits])) for name in ("force", "torque")
    )
    assert force == pytest.approx(0.2 * math.sqrt(26 / 30), rel=0.05)
    assert moment == pytest.approx(0.01 * math.sqrt(24 / 30), rel=0.05)


def test_the_condition_is_that_of_the_problem_and_worse_for_poses_alike() -> None:
    conditions = []
    for spread in (1.0, 0.3, 0.1):
        gravity = directions(8, spread=spread)
        conditions.append(identify_payload(gravity, readings(gravity)).condition)
    assert conditions == sorted(conditions)
    assert conditions[2] > 3.0 * conditions[0]


@pytest.mark.parametrize(
    ("gravity", "words"),
    [
        (directions(3), "3 poses at rest, at least 4"),
        (np.tile(directions(1), (8, 1)), "too alike"),
        (np.repeat(directions(2), 4, axis=0), "too alike"),
        (directions(20, spread=0.01), "too alike.*Turn the sensor"),
        (np.zeros((5, 3)), "gravity is zero"),
        (np.vstack((directions(5), [[np.nan, 0.0, 0.0]])), "not finite"),
        (directions(5)[:, :2], r"expected \(P, 3\)"),
    ],
)
def test_data_that_cannot_tell_weight_from_offset_are_refused(gravity: Array, words: str) -> None:
    poses = len(gravity)
    with pytest.raises(CalibrationError, match=words) as caught:
        identify_payload(gravity, np.ones((poses, 6)))
    assert caught.value.poses == poses
    assert caught.value.condition > MAXIMUM_CONDITION


def test_readings_of_the_wrong_sign_are_refused() -> None:
    gravity = directions(6)
    with pytest.raises(CalibrationError, match="check the sign") as caught:
        identify_payload(gravity, -readings(gravity))
    assert caught.value.condition < MAXIMUM_CONDITION
    bad = readings(gravity)
    bad[2, 3] = np.inf
    with pytest.raises(CalibrationError, match="not finite"):
        identify_payload(gravity, bad)


def test_a_payload_is_checked() -> None:
    with pytest.raises(ConfigurationError, match="mass"):
        Payload(0.0, np.zeros(3), np.zeros(6))
    with pytest.raises(ConfigurationError, match="finite"):
        Payload(1.0, np.array([0.0, np.nan, 0.0]), np.zeros(6))
    with pytest.raises(ConfigurationError, match="expected first_moment"):
        Payload(1.0, np.zeros(3), np.zeros(3))


def test_the_difference_to_the_described_body() -> None:
    body = pin.Inertia(1.5, np.array([0.03, 0.0, -0.07]), np.eye(3) * 0.01)
    off = payload_difference(TRUE, body)
    assert off.mass == pytest.approx(0.2)
    assert off.centre_of_mass == pytest.approx(TRUE.first_moment / 1.7 - body.lever)
    assert off.first_moment == pytest.approx(TRUE.first_moment - 1.5 * body.lever)


def recording(period: float = 0.001) -> tuple[Array, Array, Array, list[tuple[float, float]]]:
    """Two joints that stand for 0.5 s and 0.8 s between moves, then stand too briefly; last counts flicker."""
    time = np.arange(0.0, 3.0, period)
    knots = [(0.0, 0.0), (0.4, 0.3), (0.9, 0.3), (1.3, -0.2), (2.1, -0.2), (2.5, 0.1), (2.6, 0.1), (3.0, 0.5)]
    angle = np.interp(time, *zip(*knots, strict=True))
    position = np.column_stack((angle, -0.5 * angle))
    rng = np.random.default_rng(1)
    position = np.round(position / 1e-5) * 1e-5 + 1e-5 * rng.integers(0, 2, position.shape)
    wrench = np.column_stack([angle * k for k in range(1, 7)]) + 0.01 * rng.normal(size=(len(time), 6))
    return time, position, wrench, [(0.4, 0.9), (1.3, 2.1)]


def test_stretches_at_rest_are_found_and_averaged() -> None:
    time, position, wrench, stretches = recording()
    poses = static_poses(time, position, wrench, speed_limit=0.005, least_s=0.25)
    assert len(poses) == len(stretches)
    for pose, (start, end), angle in zip(poses, stretches, (0.3, -0.2), strict=True):
        # A window's edge may reach into the move by the span allowed, over the move's speed
        assert pose.start_s == pytest.approx(start, abs=0.003)
        assert pose.end_s == pytest.approx(end, abs=0.003)
        assert pose.samples == round((pose.end_s - pose.start_s) / 0.001) + 1
        assert pose.position == pytest.approx([angle, -0.5 * angle], abs=3e-5)
        assert pose.wrench == pytest.approx(angle * np.arange(1, 7), abs=0.01 * 5 / math.sqrt(500))
    assert len(static_poses(time, position, wrench, speed_limit=0.005, least_s=0.6)) == 1
    assert static_poses(time, position, wrench, speed_limit=0.005, least_s=10.0) == ()


def test_one_count_an_encoder_flickers_by_is_no_speed_but_a_slow_move_is() -> None:
    time, wrench = np.arange(0.0, 1.0, 0.001), np.zeros((1000, 6))
    flicker = 1e-5 * (np.arange(1000) % 2)[:, None]  # 0.01 rad/s from sample to sample
    assert len(static_poses(time, flicker, wrench, speed_limit=0.002, least_s=0.1)) == 1
    creep = 0.003 * time[:, None]
    assert static_poses(time, creep, wrench, speed_limit=0.002, least_s=0.1) == ()
    assert len(static_poses(time, creep, wrench, speed_limit=0.004, least_s=0.1)) == 1


def test_lost_samples_part_a_stretch() -> None:
    time, position, wrench, _ = recording()
    kept = (time < 1.6) | (time > 1.65)
    poses = static_poses(time[kept], position[kept], wrench[kept], speed_limit=0.005, least_s=0.2)
    assert [pose.samples > 200 for pose in poses] == [True, True, True]
    assert poses[1].end_s < 1.601
    assert poses[2].start_s > 1.649
    # So does a jump from one sample to the next
    jump = np.where(time < 1.5, 0.0, 0.1)[:, None]
    poses = static_poses(time, jump, wrench, speed_limit=0.005, least_s=0.2)
    assert [pose.start_s for pose in poses] == pytest.approx([0.0, 1.5])
    assert [pose.end_s for pose in poses] == pytest.approx([1.499, 2.999])


def test_a_bad_recording_is_refused() -> None:
    time, position, wrench, _ = recording()
    bad = position.copy()
    bad[7, 1] = np.nan
    for arguments, words in (
        ((time[::-1], position, wrench), "increase"),
        ((time[:5], position, wrench), "expected"),
        ((time, bad, wrench), "not finite"),
    ):
        with pytest.raises(CalibrationError, match=words):
            static_poses(*arguments, speed_limit=0.005, least_s=0.2)
    with pytest.raises(CalibrationError, match="above 0"):
        static_poses(time, position, wrench, speed_limit=0.0, least_s=0.2)


def test_the_poses_of_a_robot_give_gravity_in_the_sensor(arm: Robot) -> None:
    """The arm's own torque at rest is that of the weight: a body on the hand shows in both alike."""
    model, gravity = RobotModel(arm, ("hand",)), np.array([0.0, 0.0, -9.81])
    positions = np.random.default_rng(4).uniform(-1.0, 1.0, (6, 9))
    rows = gravity_in_sensor(model, positions, "hand", gravity)
    assert rows.shape == (6, 3)
    for row, position in zip(rows, positions, strict=True):
        frame = model.configure(position, np.zeros(9)).frames["hand"]
        assert frame.rotation @ row == pytest.approx(gravity, abs=1e-12)
    fit = identify_payload(rows, readings(rows))
    assert fit.payload.mass == pytest.approx(TRUE.mass)
