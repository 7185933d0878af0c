"""In the CAN machine, too long for the normal suite: separate processes on the virtual bus, drives of another maker,
and tests of interfaces that go down and come back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.messages import JointCommand, RobotState
from tests.deploy.can_logs import check_tests, log, messages, run_inside, said

pytestmark = [pytest.mark.can_machine, pytest.mark.nightly, pytest.mark.timeout(2400)]


@pytest.fixture(scope="module")
def folder(can_machine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_inside(tmp_path_factory.mktemp("can"), "direct", "virtual", "visitor", "port_tests", "outage_tests")


@pytest.mark.parametrize("kind", [RobotState, JointCommand])
def test_states_and_commands_on_the_virtual_bus_are_those_of_one_process(folder: Path, kind: Any) -> None:
    (result,) = said(folder, "virtual")
    assert result["code"] == 0, result["out"]
    assert messages(folder, "virtual", kind) == messages(folder, "direct", kind)


def test_drives_of_another_maker_are_booted_and_moved(folder: Path) -> None:
    (result,) = said(folder, "visitor")
    assert result["code"] == 0, result["out"]
    positions = np.array([state.position_measured for state in log(folder, "visitor").messages(RobotState)])
    assert positions[49] == pytest.approx([0.4, -0.5, 0.6], abs=0.01)
    assert positions[-1] == pytest.approx([0.0, 0.0, 0.0], abs=0.01)


def test_trouble_of_the_kernels_can_is_told_of_and_recovered_from(folder: Path) -> None:
    check_tests(folder, "outage_tests")


def test_ports_and_plant_on_the_kernels_can(folder: Path) -> None:
    check_tests(folder, "port_tests")
