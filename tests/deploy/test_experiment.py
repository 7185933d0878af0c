from __future__ import annotations

import datetime
import json
import math
from pathlib import Path

import pytest

import experiments
from deploy.errors import RunStoppedError, UsageError
from deploy.experiment import (
    Bar,
    ExperimentRequest,
    ExperimentResult,
    FailedRun,
    attempt,
    combine,
    experiment_names,
    find_experiment,
    seed_requests,
    summarize,
)
from schemas.errors import ConfigurationError


def result(*bars: Bar, seed: int = 0, value: float = 0.001) -> ExperimentResult:
    return ExperimentResult("transition", "arm9", seed, {"hrp-cosim": "0.1.0"}, {"torque_step_max": value}, bars)


def seeds(*values: float, at_least: bool = False) -> list[ExperimentResult]:
    return [result(Bar("x", value, 10.0, at_least), seed=seed) for seed, value in enumerate(values)]


def test_a_bar_holds_on_its_side_of_the_limit_and_never_for_nan() -> None:
    assert Bar("step", 0.01, 0.01).holds
    assert not Bar("step", 0.011, 0.01).holds
    assert Bar("ratio", 10.0, 10.0, at_least=True).holds
    assert not Bar("ratio", 9.9, 10.0, at_least=True).holds
    assert not Bar("step", math.nan, 0.01).holds
    assert not Bar("ratio", math.nan, 10.0, at_least=True).holds


@pytest.mark.parametrize("at_least", [False, True])
@pytest.mark.parametrize("value", [-math.inf, -1.0, 10.0, 11.0, math.inf, math.nan])
def test_a_bar_holds_exactly_where_its_margin_is_not_negative(value: float, at_least: bool) -> None:
    bar = Bar("x", value, 10.0, at_least)
    assert bar.holds is (bar.margin >= 0.0)


def test_json_holds_what_is_promised() -> None:
    given = result(Bar("step", math.nan, 0.01), value=math.inf)
    content = json.loads(json.dumps(given.as_json(), allow_nan=False))
    assert set(content) == {"experiment", "robot", "seed", "versions", "overrides", "metrics", "bars", "passed"}
    assert content["passed"] is False
    assert content["metrics"] == {"torque_step_max": None}


def test_seeds_are_counted() -> None:
    good, bad = result(Bar("step", 0.0, 0.01)), result(Bar("step", 1.0, 0.01))
    combined = combine("transition", [good, bad, good])
    assert set(combined) == {"experiment", "robot", "seeds", "seeds_passed", "passed", "bars", "runs"}
    assert (combined["seeds"], combined["seeds_passed"], combined["passed"]) == (3, 2, False)
    assert len(combined["runs"]) == 3


@pytest.mark.parametrize(
    ("at_least", "worst", "worst_seed", "holds"), [(False, 12.0, 2, 3), (True, 3.0, 1, 1)], ids=["at most", "at least"]
)
def test_the_worst_is_the_one_farthest_to_the_wrong_side(
    at_least: bool, worst: float, worst_seed: int, holds: int
) -> None:
    (summary,) = summarize(seeds(9.0, 3.0, 12.0, 7.0, at_least=at_least))
    assert (summary.worst, summary.worst_seed) == (worst, worst_seed)
    assert (summary.holds_count, summary.median) == (holds, 8.0)
    assert (summary.name, summary.limit, summary.at_least) == ("x", 10.0, at_least)


@pytest.mark.parametrize("at_least", [False, True])
def test_no_number_is_worse_than_any_number(at_least: bool) -> None:
    (one,) = summarize(seeds(11.0, math.nan, 9.0, at_least=at_least))
    assert math.isnan(one.worst)
    assert (one.worst_seed, one.holds_count) == (1, 1)
    assert one.median == (9.0 if at_least else 11.0)
    (most,) = summarize(seeds(math.nan, 9.0, math.nan, at_least=at_least))
    assert json.loads(json.dumps(most.as_json(), allow_nan=False)) == {
        "name": "x", "limit": 10.0, "at_least": at_least, "holds_count": int(not at_least),
        "worst": None, "worst_seed": 0, "median": None,
    }  # fmt: skip


def test_limits_that_differ_between_seeds_are_compared_by_margin() -> None:
    near, far = result(Bar("x", 4.0, 5.0), seed=1), result(Bar("x", 6.0, 20.0), seed=2)
    (summary,) = summarize([far, near])
    assert (summary.worst, summary.limit, summary.worst_seed) == (4.0, 5.0, 1)


def test_a_failed_run_is_a_failure_without_values() -> None:
    combined = combine("transition", [*seeds(1.0, 2.0), FailedRun(7, "the HAL stopped")])
    assert (combined["seeds"], combined["seeds_passed"], combined["passed"]) == (3, 2, False)
    assert combined["runs"][2] == {"seed": 7, "error": "the HAL stopped", "overrides": {}}
    assert (combined["bars"][0]["holds_count"], combined["bars"][0]["median"]) == (2, 1.5)
    nothing = combine("transition", [FailedRun(7, "the HAL stopped")])
    assert (nothing["robot"], nothing["bars"], nothing["passed"]) == (None, [], False)


def test_transition_comes_with_the_package() -> None:
    assert "transition" in experiment_names()


def test_names_have_dashes_and_helpers_are_no_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dry_run.py").write_text("def run(request):\n    return 'ran'\n")
    (tmp_path / "dry_helper.py").write_text("X = 1\n")
    monkeypatch.setattr(experiments, "__path__", [*experiments.__path__, str(tmp_path)])
    names = experiment_names()
    assert "dry-run" in names
    assert not {"dry_run", "dry-helper", "dry_helper"} & set(names)
    assert find_experiment("dry-run")(None) == "ran"  # type: ignore[arg-type, comparison-overlap]
    for name in ("dry_run", "dry-helper", "", "transition.x"):
        with pytest.raises(UsageError, match=r"there are .*dry-run"):
            find_experiment(name)


def test_a_directory_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file/seed-0: cannot be made"):
        seed_requests([0], {}, tmp_path / "file", vary=False)


def test_outcomes_say_what_was_set() -> None:
    def stop(_: ExperimentRequest) -> ExperimentResult:
        raise RunStoppedError("joint too fast")

    def refuse(_: ExperimentRequest) -> ExperimentResult:
        raise ConfigurationError("no field x")

    request = ExperimentRequest(7, {"plant.torque_scale": 0.87})
    assert attempt(lambda _: result(seed=7), request).as_json()["overrides"] == {"plant.torque_scale": 0.87}
    assert attempt(stop, request) == FailedRun(7, "joint too fast", {"plant.torque_scale": 0.87})
    with pytest.raises(UsageError, match="no field x"):
        attempt(refuse, request)


def test_any_override_that_yaml_knows_has_a_place_in_json() -> None:
    given = {
        "a": math.inf, "b": [math.nan, 1, True, None], "c": {1: datetime.date(2024, 5, 6)}, "d": {"only"}, "e": 0.1,
    }  # fmt: skip
    for outcome in (attempt(lambda _: result(), ExperimentRequest(0, given)), FailedRun(0, "stopped", given)):
        assert json.loads(json.dumps(outcome.as_json(), allow_nan=False))["overrides"] == {
            "a": "inf", "b": ["nan", 1, True, None], "c": {"1": "2024-05-06"}, "d": "{'only'}", "e": 0.1,
        }  # fmt: skip


OLD = (
    "metrics.json", "sweep.png", "null-space.png", "null-space.svg", "transition.png", "bent/to_torque.png",
    "bent/to_position.png", "seed-1/metrics.json", "seed-1/null-space.svg", "seed-1/bent/to_torque.png",
)  # fmt: skip
KEPT = ("holiday.png", "notes/plan.svg", "metrics.json.old", "bent/run.mcap", "seed-2/metrics.json")


def test_results_of_an_earlier_run_are_deleted_and_nothing_else(tmp_path: Path) -> None:
    for name in (*OLD, *KEPT):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text("old")
    seed_requests(range(2), {}, tmp_path, vary=False)
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == set(KEPT)


def test_an_old_result_that_cannot_be_deleted_is_named(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").mkdir()
    with pytest.raises(UsageError, match=r"metrics\.json: an old result, cannot be deleted"):
        seed_requests([0], {}, tmp_path, vary=False, apart=False)
