"""Experiments of a moment for the tests of sweeps; in a module, because workers import what they run."""

from __future__ import annotations

import os
import time
from typing import Any

from deploy.errors import RunStoppedError, UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.supervisor import ONE_THREAD


def run(request: ExperimentRequest) -> ExperimentResult:
    """Do what the overrides say of this seed: `stop`, `refuse`, `bug`, `die` and `miss` hold lists of seeds.

    `sleep_s` holds seconds by seed. The value of the bar is the seed.
    """
    seed, what = request.seed, request.overrides
    request.progress(0.5, "half")
    if request.directory is not None:
        (request.directory / "pid").write_text(str(os.getpid()))
        for place in ("pose", "pose-naive"):
            (request.directory / place).mkdir(exist_ok=True)
            (request.directory / place / "run.mcap").write_bytes(b"log")
            (request.directory / place / "plot.png").write_bytes(b"plot")
    time.sleep(what.get("sleep_s", {}).get(seed, 0.0))
    if seed in what.get("stop", ()):
        raise RunStoppedError("stopped at sequence 7: joint too fast")
    if seed in what.get("refuse", ()):
        raise UsageError("--set seed: the experiment sets it itself")
    if seed in what.get("bug", ()):
        raise ValueError("shapes do not match")
    if seed in what.get("die", ()):
        os._exit(9)
    metrics: dict[str, Any] = {
        "threads": [float(os.environ.get(name, "nan")) for name in ONE_THREAD],
        "torque_scale": what.get("plant.torque_scale"),
    }
    limit = -1.0 if seed in what.get("miss", ()) else 1000.0
    return ExperimentResult("tiny", "arm9", seed, {}, metrics, (Bar("seed", float(seed), limit),))


SHORT: dict[str, Any] = {
    "RANGE_SHARES": {"middle": 0.5}, "REACH_S": 0.6, "SETTLE_S": 0.3, "TORQUE_S": 0.4, "POSITION_S": 0.4,
}  # fmt: skip


def short_transition(request: ExperimentRequest) -> ExperimentResult:
    """Run the real experiment for half the time in one pose instead of three; its module is changed by `SHORT`."""
    from experiments import transition  # heavy; the other experiments here do without

    vars(transition).update(SHORT)
    return transition.run(request)
