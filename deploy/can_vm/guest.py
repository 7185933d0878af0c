"""What the guest runs: the interfaces it sets up, the command and its environment, the files it boots with."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from deploy.can_vm.config import PAIRS, VCAN, MachineConfig
from deploy.can_vm.initramfs import Entry, archive, character_device, directory, file

SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
PASSED = ("CI", "LANG", "HOME", "TZ", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables of the caller that the command sees, beside those that begin with `PYTHON`."""


def interface_commands(config: MachineConfig) -> str:
    """Lines for `ip -batch`: loopback, virtual CAN interfaces and emulated controllers, all up."""
    lines = ["link set lo up"]
    for name in VCAN:
        lines += [f"link add dev {name} type vcan", f"link set {name} txqueuelen {config.txqueuelen} up"]
    for name in (name for pair in PAIRS for name in pair):
        lines.append(f"link set {name} type can bitrate {config.bitrate} restart-ms {config.restart_ms}")
        lines.append(f"link set {name} txqueuelen {config.txqueuelen} up")
    return "\n".join(lines) + "\n"


def guest_environment(caller: Mapping[str, str], virtual_environment: Path, extra: Mapping[str, str]) -> dict[str, str]:
    """Choose the command's environment: some of the caller's, the virtual environment first in PATH, then `extra`.

    Output is unbuffered and numeric libraries use one thread unless the caller says otherwise. Sockets and temporary
    files live in the machine's own memory: the host's file tree cannot hold sockets there.
    """
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    environment |= {"HOME": "/root", "LANG": "C.UTF-8", "TMPDIR": "/dev/shm", "COSIM_RUN_DIR": "/run/cosim"}
    environment |= {name: text for name, text in caller.items() if name in PASSED or name.startswith("PYTHON")}
    environment |= {"VIRTUAL_ENV": str(virtual_environment), "PATH": f"{virtual_environment / 'bin'}:{SYSTEM_PATH}"}
    return environment | dict(extra)


def command_script(command: Sequence[str], directory: Path, environment: Mapping[str, str]) -> str:
    """Write the shell script that replaces itself by the command; exit code 127 when there is no such command."""
    words = ["exec", "env", "-i", *(f"{name}={text}" for name, text in environment.items()), *command]
    return f"cd {shlex.quote(str(directory))} || exit 126\nPATH={SYSTEM_PATH}\n{shlex.join(words)}\n"


def boot_files(
    busybox: bytes, modules: Mapping[str, bytes], order: Sequence[str], interfaces: str, command: str
) -> bytes:
    """Pack the initramfs: the init script, busybox, the modules in load order, the interfaces and the command."""
    init = resources.files(__package__).joinpath("init.sh").read_bytes()
    entries: list[Entry] = [directory("dev"), character_device("dev/console", 5, 1), directory("bin")]
    entries += [file("init", init, executable=True), directory("modules")]
    entries += [file(f"bin/{name}", busybox, executable=True) for name in ("busybox", "sh")]
    entries.append(file("modules/order", "".join(f"{name}\n" for name in order).encode()))
    entries += [file(f"modules/{name}.ko", modules[name]) for name in order]
    entries += [file("interfaces", interfaces.encode()), file("command", command.encode())]
    return archive(entries)
