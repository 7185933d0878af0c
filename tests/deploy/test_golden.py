"""The committed log comes out the same: exactly on the kind of machine that wrote it, within tolerances on others."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from deploy.replay import PARTS, replay_log
from schemas.base import ControlMode
from schemas.fingerprint import ARITHMETIC, differences, fingerprint
from schemas.log import LogReader, LogWriter
from schemas.messages import JointCommand
from tests.deploy.conftest import GOLDEN

REMEDY = "if results changed on purpose: `make golden`, and say so in CHANGELOG.md"


@pytest.mark.parametrize("part", PARTS)
def test_the_golden_log_comes_out_the_same(part: str) -> None:
    reader = LogReader(GOLDEN)
    result = replay_log(GOLDEN, part)
    assert result.exact == (not differences(reader.fingerprint, fingerprint(reader.run)))
    assert result.passed, f"{result.describe()}\n{REMEDY}"
    assert result.compared >= reader.run.cycles


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("entry", ["cpu_features", "mujoco"])
def test_on_another_machine_it_is_compared_within_tolerances(tmp_path: Path, part: str, entry: str) -> None:
    reader = LogReader(GOLDEN)
    here = fingerprint(reader.run)
    assert entry in ARITHMETIC
    foreign = tmp_path / "foreign.mcap"
    with LogWriter(foreign, reader.run, {**here, entry: "another"}) as writer:
        for record in reader.records():
            writer.write_bytes(record.topic, record.data, record.sequence, record.time_ns)
    result = replay_log(foreign, part)
    assert result.reasons == (f"{entry}: another → {here[entry]}",)
    assert not result.exact
    assert result.passed, result.describe()
    assert result.compared >= reader.run.cycles


def test_it_is_small_and_holds_both_changes_of_mode() -> None:
    assert GOLDEN.stat().st_size < 400_000
    reader = LogReader(GOLDEN)
    assert reader.complete
    commands = list(reader.messages(JointCommand))
    assert len(commands) == reader.run.cycles
    changes = [(a.mode, b.mode) for a, b in pairwise(commands) if a.mode != b.mode]
    assert changes == [
        (ControlMode.POSITION, ControlMode.TORQUE),
        (ControlMode.TORQUE, ControlMode.POSITION),
    ]
