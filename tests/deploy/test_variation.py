from __future__ import annotations

from pathlib import Path

from deploy.experiment import seed_requests
from deploy.variation import FRICTION_ERROR, MASS_ERROR, TORQUE_SCALE, varied, vary
from schemas.load import load_run

SCALES = [vary(seed)["plant.torque_scale"] for seed in range(300)]


def test_torque_scales_fill_their_range_and_do_not_leave_it() -> None:
    low, high = TORQUE_SCALE
    assert low <= min(SCALES) < low + 0.05 * (high - low)
    assert high - 0.05 * (high - low) < max(SCALES) <= high
    assert abs(sum(SCALES) / len(SCALES) - 0.5 * (low + high)) < 0.05 * (high - low)


def test_every_seed_has_its_own_and_always_the_same_plant() -> None:
    assert len(set(SCALES)) == len(SCALES)
    assert [vary(seed) for seed in range(20)] == [vary(seed) for seed in range(20)]


def test_the_plant_of_a_seed_does_not_depend_on_how_many_there_are(tmp_path: Path) -> None:
    many = seed_requests(range(10), {}, tmp_path, vary=True)
    few = seed_requests(range(5, 7), {}, tmp_path, vary=True)
    one = seed_requests([6], {}, tmp_path, vary=True, apart=False)
    assert many[5:7] == few
    assert one[0].overrides == few[1].overrides == vary(6)
    assert one[0].directory == tmp_path
    assert few[1].directory == tmp_path / "seed-6"


def test_nominal_requests_hold_the_users_overrides_alone(tmp_path: Path) -> None:
    assert [request.overrides for request in seed_requests(range(2), {"a": 1}, tmp_path, vary=False)] == [{"a": 1}] * 2


def test_the_plant_that_is_loaded_is_the_varied_one() -> None:
    plant = load_run("arm9-transition", varied({}, 3)).scenario.plant
    assert (plant.torque_scale, plant.friction_error, plant.mass_error) == (SCALES[3], FRICTION_ERROR, MASS_ERROR)


def test_what_the_user_sets_wins_over_the_variation() -> None:
    field = load_run("arm9-transition", varied({"plant.torque_scale": 0.5}, 3)).scenario.plant
    assert (field.torque_scale, field.friction_error) == (0.5, FRICTION_ERROR)
    nominal = load_run("arm9-transition", {"plant": {"mass_error": 0.05}}).scenario.plant
    whole = load_run("arm9-transition", varied({"plant": {"mass_error": 0.05}}, 3)).scenario.plant
    assert whole == nominal
    later = {"plant": {"mass_error": 0.05}, "plant.torque_scale": 0.5}
    assert load_run("arm9-transition", varied(later, 3)).scenario.plant.torque_scale == 0.5
