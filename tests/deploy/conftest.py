from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from deploy.can_vm import MachineUnavailableError, default_cache, prepare
from deploy.golden import write_golden
from schemas.load import Run, load_run

GOLDEN = Path(__file__).parents[1] / "data" / "golden.mcap"
ARM9 = Path(__file__).parents[2] / "deploy" / "robots" / "arm9"


@pytest.fixture(scope="session")
def fresh_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden run, made now: position mode, torque mode along a path, position mode; must not be changed."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    write_golden(path)
    return path


@pytest.fixture
def run() -> Run:
    return load_run("arm9-transition", {"duration_s": 1.0})


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run directory of the test's own."""
    monkeypatch.setenv("COSIM_RUN_DIR", str(tmp_path / "run"))
    return tmp_path / "run"


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    """A copy of arm9 that may be spoiled."""
    return Path(shutil.copytree(ARM9, tmp_path / "arm9")) / "arm9.yaml"


@pytest.fixture(scope="session")
def can_machine() -> None:
    """The CAN machine can be booted; for tests marked `can_machine`, which call `deploy.can_vm.run_in_machine`."""
    try:
        prepare(default_cache())
    except MachineUnavailableError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
