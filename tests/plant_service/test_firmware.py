"""Drive firmware: the law in its closed form, interpolation, asymmetry, limits, holding, encoder, reported torque."""

from __future__ import annotations

import numpy as np
import pytest

from hal.profile import firmware as law
from hal.profile.units import DriveUnits
from plant_service.axis import AxisGains
from plant_service.errors import PlantError
from plant_service.firmware import Firmware
from plant_service.joint_axis import JointAxis
from schemas.load import load_robot
from schemas.robot import RobotDescription
from schemas.scenario import DriveAsymmetry, PlantConfig, SensorNoise

NO_LIMIT = 60000
PLAIN = PlantConfig()


def mirrored() -> RobotDescription:
    """arm9 with every other joint's drive turned round and encoders that do not start at zero."""
    description = load_robot("arm9").description
    joints = tuple(
        joint.model_copy(update={"direction": -1 if index % 2 else 1, "zero_offset": 0.1 * index})
        for index, joint in enumerate(description.joints)
    )
    return description.model_copy(update={"joints": joints})


ROBOT = mirrored()
UNITS = DriveUnits.of(ROBOT)
GAINS = law.FirmwareGains.of(ROBOT)


class Bench:
    """Firmware on joints that stand where the test puts them."""

    def __init__(self, config: PlantConfig = PLAIN, seed: int = 0, robot: RobotDescription | None = None) -> None:
        self.firmware = Firmware(robot or ROBOT, config, seed)
        self.axes = [JointAxis(self.firmware, joint) for joint in range(9)]
        generator = np.random.default_rng(1)
        self.position, self.velocity = generator.uniform(-1.0, 1.0, 9), generator.normal(scale=0.01, size=9)
        self.firmware.sample(self.position, self.velocity)

    @property
    def encoder(self) -> np.ndarray:
        return UNITS.position_from_counts(UNITS.counts_from_position(self.position))

    def period(self) -> np.ndarray:
        """Torques of each substep, shape (4, 9)."""
        self.firmware.begin_period()
        rows = [self.firmware.step(index, self.position, self.velocity).copy() for index in range(4)]
        self.firmware.end_period(self.position, self.velocity)
        return np.array(rows)

    def follow(self, target: np.ndarray, limit: int = NO_LIMIT) -> np.ndarray:
        """Command positions; returns them as the drives see them."""
        counts = UNITS.counts_from_position(target)
        for axis, count in zip(self.axes, counts.tolist(), strict=True):
            axis.follow_position(count, limit)
        return UNITS.position_from_counts(counts)


def test_position_law_is_the_profiles_on_encoder_counts() -> None:
    bench = Bench()
    target = bench.follow(bench.position + np.linspace(-0.004, 0.004, 9))
    expected = law.position_torque(target, np.zeros(9), bench.encoder, bench.velocity, GAINS)
    assert bench.period() == pytest.approx(np.tile(expected, (4, 1)), abs=1e-9)
    assert bench.firmware.mode.tolist() == [8] * 9


def test_entry_jumps_then_targets_are_interpolated() -> None:
    """First target at once; the next is approached linearly over one period with its slope as target velocity."""
    bench = Bench()
    first = bench.follow(bench.position + 0.001)
    bench.period()
    second = bench.follow(bench.position + 0.0012)
    slope = (second - first) / ROBOT.period_s
    rows = bench.period()
    for index, row in enumerate(rows):
        target = first + (second - first) * index / 4.0
        assert row == pytest.approx(law.position_torque(target, slope, bench.encoder, bench.velocity, GAINS), abs=1e-9)
    stale = bench.period()
    assert stale[0] == pytest.approx(
        law.position_torque(second, np.zeros(9), bench.encoder, bench.velocity, GAINS), abs=1e-9
    )


def test_where_the_law_knows_no_slope_targets_still_move_linearly_but_the_target_velocity_is_zero() -> None:
    """Every third drive: τ of the moving target with q̇_t = 0; the others as ever."""
    zero = np.arange(9) % 3 == 0
    joints = tuple(
        joint.model_copy(update={"drive": joint.drive.model_copy(update={"velocity_reference": "zero"})})
        if each
        else joint
        for joint, each in zip(ROBOT.joints, zero, strict=True)
    )
    bench = Bench(robot=ROBOT.model_copy(update={"joints": joints}))
    first = bench.follow(bench.position + 0.001)
    bench.period()
    second = bench.follow(bench.position + 0.0015)
    slope = np.where(zero, 0.0, (second - first) / ROBOT.period_s)
    for index, row in enumerate(bench.period()):
        target = first + (second - first) * index / 4.0
        assert row == pytest.approx(law.position_torque(target, slope, bench.encoder, bench.velocity, GAINS), abs=1e-9)


ALPHA_P, ALPHA_D = -0.3, 0.4
ASYMMETRIC = PlantConfig(drive_asymmetry=DriveAsymmetry(position_gain=ALPHA_P, velocity_gain=ALPHA_D))


def at_sigma(sigma: np.ndarray) -> law.FirmwareGains:
    """k_p (1 + α_p σ) and k_d (1 + α_d σ)."""
    return law.FirmwareGains(
        GAINS.position_gain * (1.0 + ALPHA_P * sigma),
        GAINS.velocity_gain * (1.0 + ALPHA_D * sigma),
        GAINS.dead_zone,
        GAINS.torque_limit,
    )


def test_asymmetric_gains_follow_the_true_velocity_of_every_step() -> None:
    bench = Bench(ASYMMETRIC)
    first = bench.follow(bench.position + 0.0002)
    bench.period()
    second = bench.follow(bench.position + 0.00022)
    slope = (second - first) / ROBOT.period_s
    bench.firmware.begin_period()
    for index in range(4):
        velocity = np.linspace(-0.05, 0.05, 9) * (index + 1) / 4.0
        target = first + (second - first) * index / 4.0
        gains = at_sigma(np.tanh(velocity / 0.02))
        expected = law.position_torque(target, slope, bench.encoder, velocity, gains)
        assert np.abs(expected).max() < GAINS.torque_limit.min()
        assert bench.firmware.step(index, bench.position, velocity) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_far_from_rest_the_gains_are_those_of_the_direction_and_at_rest_the_described_ones(sign: float) -> None:
    bench = Bench(ASYMMETRIC)
    bench.velocity[:] = 0.5 * sign  # 25 v₀
    target = bench.follow(bench.position + 0.001)
    expected = law.position_torque(target, np.zeros(9), bench.encoder, bench.velocity, at_sigma(np.full(9, sign)))
    assert bench.period()[0] == pytest.approx(expected, abs=1e-9)


def test_without_asymmetry_the_bits_are_those_of_the_plain_law() -> None:
    other = PlantConfig(drive_asymmetry=DriveAsymmetry(smoothing_velocity=3.0))
    rows = []
    for config in (PLAIN, other, ASYMMETRIC):
        bench = Bench(config)
        bench.follow(bench.position + 0.0003)
        first = bench.period()
        bench.follow(bench.position + 0.0004)
        rows.append((first.tobytes(), bench.period().tobytes()))
    assert rows[0] == rows[1]
    assert rows[0] != rows[2]


def test_asymmetry_leaves_torque_mode_alone_beside_a_position_loop() -> None:
    rows = []
    for config in (PLAIN, ASYMMETRIC):
        bench = Bench(config)
        bench.follow(bench.position + 0.0003)
        for axis in bench.axes[:6]:
            axis.follow_torque(123, NO_LIMIT)
        rows.append(bench.period())
    assert rows[0][:, :6].tobytes() == rows[1][:, :6].tobytes()
    assert (np.abs(rows[0] - rows[1])[:, 6:].max(axis=0) > 1e-3).all()


@pytest.mark.parametrize("per_mille", [-700, 40, 900])
def test_an_asymmetric_drive_holds_by_its_own_law(per_mille: int) -> None:
    """No jump at the start, where the gains of the velocity count; at the end the law about the position."""
    bench = Bench(ASYMMETRIC)
    gains = at_sigma(np.tanh(bench.velocity / 0.02))
    for axis in bench.axes:
        axis.follow_torque(per_mille, NO_LIMIT)
    last = bench.period()[-1]
    for axis in bench.axes:
        axis.hold()
    assert bench.period()[0] == pytest.approx(last, abs=1e-9)
    rest = [bench.period() for _ in range(110)][-1]
    expected = law.position_torque(bench.encoder, np.zeros(9), bench.encoder, bench.velocity, gains)
    assert rest[-1] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1.5])
def test_torque_mode_loses_the_true_dead_zone(scale: float) -> None:
    bench = Bench(PlantConfig(dead_zone_scale=scale))
    for axis in bench.axes:
        axis.follow_torque(100, NO_LIMIT)
    expected = law.dead_zone(100 * UNITS.newton_metre_per_mille, scale * GAINS.dead_zone)
    assert bench.period() == pytest.approx(np.tile(expected, (4, 1)), abs=1e-12)


def test_inside_the_dead_zone_there_is_no_torque() -> None:
    bench = Bench()
    for axis in bench.axes:
        axis.follow_torque(3, NO_LIMIT)
    assert (bench.period() == 0.0).all()


def test_torque_is_limited_by_command_and_by_the_drive() -> None:
    bench = Bench()
    for axis in bench.axes:
        axis.follow_torque(2000, 500)
    assert bench.period()[0] == pytest.approx(500 * UNITS.newton_metre_per_mille)
    for axis in bench.axes:
        axis.follow_torque(-32000, NO_LIMIT)
    assert np.abs(bench.period()[0]) == pytest.approx(GAINS.torque_limit)
    bench.follow(bench.position + 1.0, 200)
    assert bench.period()[-1] == pytest.approx(200 * np.abs(UNITS.newton_metre_per_mille))


def test_power_off_gives_nothing_and_brakes() -> None:
    bench = Bench()
    assert bench.firmware.braked.all()
    bench.follow(bench.position + 0.01)
    assert not bench.firmware.braked.any()
    bench.period()
    for axis in bench.axes:
        axis.power_off()
    assert bench.firmware.braked.all()
    assert (bench.period() == 0.0).all()
    assert bench.firmware.mode.tolist() == [0] * 9
    assert [axis.torque_per_mille() for axis in bench.axes] == [0] * 9


@pytest.mark.parametrize("per_mille", [-700, -5, 0, 40, 900])
def test_holding_from_torque_starts_with_the_same_torque_and_ends_at_the_position(per_mille: int) -> None:
    bench = Bench()
    for axis in bench.axes:
        axis.follow_torque(per_mille, NO_LIMIT)
    last = bench.period()[-1]
    for axis in bench.axes:
        axis.hold()
    first = bench.period()
    assert first[0] == pytest.approx(last, abs=1e-9)
    # The ramp is steepest in its middle, 1.5 times a linear one's slope; it starts with none.
    offset = law.holding_offset(last, bench.velocity, GAINS)
    step = GAINS.position_gain * np.abs(offset) * 1.5 * ROBOT.period_s / ROBOT.safety.hold_ramp_s / 4.0
    assert (np.abs(np.diff(first, axis=0)) <= step + 1e-9).all()
    middle = [bench.period() for _ in range(49)][-1]
    held = bench.encoder + offset / 2.0
    assert middle[-1] == pytest.approx(
        law.position_torque(held, np.zeros(9), bench.encoder, bench.velocity, GAINS), abs=1.5 * step.max()
    )
    rest = [bench.period() for _ in range(60)][-1]
    assert rest[-1] == pytest.approx(
        law.position_torque(bench.encoder, np.zeros(9), bench.encoder, bench.velocity, GAINS), abs=1e-9
    )


def test_holding_again_changes_nothing() -> None:
    bench = Bench()
    bench.axes[0].follow_torque(500, NO_LIMIT)
    bench.period()
    bench.axes[0].hold()
    bench.period()
    before = bench.firmware.torque.copy()
    bench.axes[0].hold()
    assert abs(bench.period()[0] - before)[0] < 2.0


def test_a_drive_that_followed_positions_holds_its_last_target() -> None:
    bench = Bench()
    bench.velocity[:] = 0.0
    target = bench.follow(bench.position + 0.002)
    last = bench.period()[-1]
    for axis in bench.axes:
        axis.hold()
    for _ in range(150):
        rows = bench.period()
    assert rows[-1] == pytest.approx(last, abs=1e-9)
    assert rows[-1] == pytest.approx(
        law.position_torque(target, np.zeros(9), bench.encoder, bench.velocity, GAINS), abs=1e-9
    )


def test_encoder_rounds_to_the_nearest_count() -> None:
    bench = Bench()
    counts = np.array([axis.position_counts() for axis in bench.axes])
    assert counts.tolist() == UNITS.counts_from_position(bench.position).tolist()
    error = UNITS.position_from_counts(counts) - bench.position
    assert (np.abs(error) <= 0.5 * np.abs(UNITS.radian_per_count) * (1.0 + 1e-9)).all()
    # A movement below half a count from a count's centre is not seen.
    bench.position = bench.encoder
    bench.firmware.sample(bench.position + 0.49 * UNITS.radian_per_count, bench.velocity)
    assert [axis.position_counts() for axis in bench.axes] == counts.tolist()
    bench.firmware.sample(bench.position + 0.51 * UNITS.radian_per_count, bench.velocity)
    assert [axis.position_counts() for axis in bench.axes] == (counts + 1).tolist()


def test_reported_torque_is_the_nominal_one() -> None:
    bench = Bench(PlantConfig(torque_scale=0.5))
    for axis in bench.axes:
        axis.follow_torque(300, NO_LIMIT)
    nominal = bench.period()[-1]
    assert [axis.torque_per_mille() for axis in bench.axes] == UNITS.per_mille_from_torque(nominal).tolist()
    assert 280 < bench.axes[0].torque_per_mille() < 300


def test_reported_torque_is_noisy_by_the_seed() -> None:
    noisy = PlantConfig(noise=SensorNoise(motor_torque=2.0))

    def reports(seed: int) -> list[list[int]]:
        bench = Bench(noisy, seed)
        rows = []
        for _ in range(50):
            bench.period()
            rows.append([axis.torque_per_mille() for axis in bench.axes])
        return rows

    assert reports(1) == reports(1) != reports(2)
    spread = np.std(np.array(reports(1)) * UNITS.newton_metre_per_mille, axis=0)
    assert spread == pytest.approx(np.full(9, 2.0), rel=0.35)


def test_parameters_can_be_set() -> None:
    bench = Bench()
    bench.velocity[:] = 0.0
    target = bench.follow(bench.position + 0.001)
    bench.axes[0].configure(AxisGains(position_gain=5e4, velocity_gain=0.0))
    expected = 5e4 * (target - bench.encoder)[0] - GAINS.dead_zone[0]
    assert bench.period()[0, 0] == pytest.approx(expected, abs=1e-9)
    bench.axes[1].configure(AxisGains(rated_motor_torque=1.0, torque_limit=100.0))
    bench.axes[1].follow_torque(100, NO_LIMIT)
    assert bench.period()[0, 1] == pytest.approx(-(30.0 - GAINS.dead_zone[1]))
    assert bench.axes[1].torque_per_mille() == round((30.0 - GAINS.dead_zone[1]) / 0.3)
    bench.axes[1].follow_torque(-1000, NO_LIMIT)
    assert bench.period()[0, 1] == pytest.approx(100.0)
    for axis in bench.axes:
        axis.configure(AxisGains(hold_ramp_s=0.01))
    bench.axes[2].follow_torque(500, NO_LIMIT)
    bench.period()
    bench.axes[2].hold()
    assert bench.period()[-1, 2] != 0.0
    assert [bench.period() for _ in range(5)][-1][-1, 2] == 0.0


@pytest.mark.parametrize(
    "gains", [AxisGains(position_gain=0.0), AxisGains(velocity_gain=-1.0), AxisGains(rated_motor_torque=-0.1)]
)
def test_senseless_parameters_are_refused(gains: AxisGains) -> None:
    with pytest.raises(PlantError, match=r"scapula_roll: .* is not above zero"):
        Bench().axes[1].configure(gains)
