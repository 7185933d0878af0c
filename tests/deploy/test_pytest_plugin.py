"""`pytest --cosim-log` in somebody else's project."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from schemas.log import LogReader, LogWriter
from schemas.messages import JointCommand
from schemas.topics import decode


def _pytest(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(folder), *options]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def test_each_part_of_each_log_is_a_test(fresh_log: Path, tmp_path: Path) -> None:
    reader = LogReader(fresh_log)
    bad = tmp_path / "bad.mcap"
    with LogWriter(bad, reader.run, reader.fingerprint) as writer:
        for record in reader.records():
            data = record.data
            if record.topic == "command" and record.sequence == 7:
                command = decode(JointCommand, data)
                assert command.position is not None
                data = data.replace(str(command.position[2]).encode(), b"0.123")
            writer.write_bytes(record.topic, data, record.sequence, record.time_ns)
    done = _pytest(tmp_path, "--cosim-log", str(fresh_log), "--cosim-log", str(bad), "-v")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "2 failed, 4 passed" in done.stdout  # the HAL sent what the command asked, so its replay differs too
    assert "controller: tick 7, command.position[2]: logged 0.123" in done.stdout
    assert "Traceback" not in done.stdout


def test_one_part_beside_the_projects_own_tests(fresh_log: Path, tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text("def test_own():\n    assert True\n")
    done = _pytest(tmp_path, "--cosim-log", str(fresh_log), "--cosim-part", "hal")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout


def test_missing_log_is_a_usage_error(tmp_path: Path) -> None:
    done = _pytest(tmp_path, "--cosim-log", "none.mcap")
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "--cosim-log none.mcap: no such file" in done.stderr


def test_plugin_imports_nothing_heavy() -> None:
    code = (
        "import sys, deploy.pytest_plugin; print(sorted({'numpy', 'pydantic', 'zenoh', 'mujoco'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
