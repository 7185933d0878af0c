from __future__ import annotations

from pathlib import Path

import pytest

from deploy.can_vm import packages
from deploy.cli import main


def test_help_names_the_interfaces(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["can-vm", "--help"]) == 0
    assert "can0/can1" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["--prepare", "--", "true"]])
def test_either_a_command_or_prepare(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["can-vm", *arguments]) == 2
    assert "either a command after `--` or --prepare" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["NAME", "=value"])
def test_a_variable_needs_name_and_value(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["can-vm", "--env", text, "--", "true"]) == 2
    assert f"--env {text}: expected NAME=VALUE" in capsys.readouterr().err


def test_missing_packages_are_named_and_the_exit_code_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "SEARCH", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["can-vm", "--cache", str(tmp_path / "cache"), "--", "true"]) == 2
    error = capsys.readouterr().err
    assert "apt-get install qemu-system-x86 busybox-static iproute2 can-utils" in error
    assert "Traceback" not in error
