from __future__ import annotations

import json
import math

from deploy.experiment import Bar, ExperimentResult, combine, experiment_names


def result(*bars: Bar) -> ExperimentResult:
    return ExperimentResult("transition", "arm9", 0, {"hrp-cosim": "0.1.0"}, {"torque_step_max": 0.001}, bars)


def test_a_bar_holds_on_its_side_of_the_limit_and_never_for_nan() -> None:
    assert Bar("step", 0.01, 0.01).holds
    assert not Bar("step", 0.011, 0.01).holds
    assert Bar("ratio", 10.0, 10.0, at_least=True).holds
    assert not Bar("ratio", 9.9, 10.0, at_least=True).holds
    assert not Bar("step", math.nan, 0.01).holds
    assert not Bar("ratio", math.nan, 10.0, at_least=True).holds


def test_json_holds_what_is_promised() -> None:
    content = json.loads(json.dumps(result(Bar("step", math.nan, 0.01)).as_json(), allow_nan=False))
    assert set(content) == {"experiment", "robot", "seed", "versions", "metrics", "bars", "passed"}
    assert content["passed"] is False


def test_seeds_are_counted() -> None:
    good, bad = result(Bar("step", 0.0, 0.01)), result(Bar("step", 1.0, 0.01))
    combined = combine([good, bad, good])
    assert (combined["seeds"], combined["seeds_passed"], combined["passed"]) == (3, 2, False)
    assert len(combined["runs"]) == 3


def test_transition_comes_with_the_package() -> None:
    assert "transition" in experiment_names()
