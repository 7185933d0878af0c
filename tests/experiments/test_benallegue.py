"""The experiments of [Benallegue 2021] whole, with the bars they must keep, on plants that differ from the model."""

from __future__ import annotations

import pytest

from deploy.experiment import ExperimentRequest, find_experiment
from deploy.variation import varied

NAMES = ["anti-windup", "null-space", "dual-compliance", "obstacle-track"]


def check(name: str, seed: int) -> None:
    result = find_experiment(name)(ExperimentRequest(seed, varied({}, seed)))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
    assert (result.experiment, result.robot, result.versions["seed"]) == (name, "arm9", str(seed))


@pytest.mark.parametrize("name", NAMES)
def test_every_bar_holds(name: str) -> None:
    check(name, 21)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(22, 32))
@pytest.mark.parametrize("name", NAMES)
def test_every_bar_holds_on_many_plants(name: str, seed: int) -> None:
    check(name, seed)
