from __future__ import annotations

import subprocess
from pathlib import Path

from deploy.can_vm.config import PAIRS, VCAN, MachineConfig
from deploy.can_vm.guest import boot_files, command_script, guest_environment, interface_commands

VENV = Path("/work tree/.venv")


def test_all_interfaces_are_brought_up() -> None:
    lines = interface_commands(MachineConfig(bitrate=500_000, restart_ms=7, txqueuelen=99)).splitlines()
    controllers = [name for pair in PAIRS for name in pair]
    up = [line.split()[2] for line in lines if line.startswith("link set") and line.endswith(" up")]
    assert up == ["lo", *VCAN, *controllers]
    for name in controllers:
        assert f"link set {name} type can bitrate 500000 restart-ms 7" in lines
        assert f"link set {name} txqueuelen 99 up" in lines


def test_the_virtual_environment_comes_first_in_path() -> None:
    environment = guest_environment({"PATH": "/elsewhere"}, VENV, {})
    assert environment["PATH"].startswith("/work tree/.venv/bin:")
    assert "/elsewhere" not in environment["PATH"]
    assert environment["VIRTUAL_ENV"] == str(VENV)


def test_only_chosen_variables_of_the_caller_are_passed() -> None:
    caller = {"CI": "1", "PYTHONHASHSEED": "3", "SECRET": "x", "OMP_NUM_THREADS": "2"}
    environment = guest_environment(caller, VENV, {"SEEN": "yes"})
    assert environment["CI"] == "1"
    assert environment["PYTHONHASHSEED"] == "3"
    assert environment["OMP_NUM_THREADS"] == "2"
    assert environment["SEEN"] == "yes"
    assert "SECRET" not in environment


def test_numeric_libraries_use_one_thread_unless_told() -> None:
    environment = guest_environment({}, VENV, {})
    assert environment["OMP_NUM_THREADS"] == environment["OPENBLAS_NUM_THREADS"] == "1"
    assert guest_environment({}, VENV, {"OMP_NUM_THREADS": "2"})["OMP_NUM_THREADS"] == "2"


def test_the_script_keeps_words_directory_and_environment_as_they_are(tmp_path: Path) -> None:
    place = tmp_path / "a 'folder' $HOME"
    place.mkdir()
    words = ["sh", "-c", 'pwd; printf "%s\\n" "$0" "$1" "$TEXT"', "a  b", "$(id) 'x'"]
    script = command_script(words, place, {"PATH": "/usr/bin:/bin", "TEXT": "1 'two' \n three"})
    done = subprocess.run(["sh"], input=script, capture_output=True, text=True, check=True)
    assert done.stdout == f"{place}\na  b\n$(id) 'x'\n1 'two' \n three\n"


def test_a_missing_directory_and_a_missing_command_have_the_shells_codes(tmp_path: Path) -> None:
    missing = command_script(["true"], tmp_path / "none", {})
    assert subprocess.run(["sh", "-c", missing], capture_output=True, check=False).returncode == 126
    unknown = command_script(["no-such-command"], tmp_path, {"PATH": "/bin"})
    assert subprocess.run(["sh", "-c", unknown], capture_output=True, check=False).returncode == 127


def test_the_initramfs_holds_all_it_boots_from() -> None:
    packed = boot_files(b"BUSYBOX", {"can": b"C", "vcan": b"V"}, ("can", "vcan"), "link set lo up\n", "true\n")
    for name in (b"init", b"bin/sh", b"bin/busybox", b"modules/can.ko", b"modules/vcan.ko", b"command", b"interfaces"):
        assert name + b"\0" in packed
    assert b"can\nvcan\n" in packed


def test_the_init_script_is_valid_shell() -> None:
    script = Path(__file__).parents[3] / "deploy" / "can_vm" / "init.sh"
    subprocess.run(["sh", "-n", str(script)], check=True)
