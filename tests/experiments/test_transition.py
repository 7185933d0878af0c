"""The whole experiment, with the bars it must keep."""

from __future__ import annotations

import pytest

from deploy.experiment import ExperimentRequest
from experiments import transition


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 11])
def test_every_bar_holds(seed: int) -> None:
    result = transition.run(ExperimentRequest(seed))
    assert result.passed, [bar for bar in result.bars if not bar.holds]
    assert result.versions["seed"] == str(seed)
