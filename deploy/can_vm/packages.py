"""The packages the machine is built from: found, installed by apt, or kept in a cache folder.

Cache: `linux-image-*.deb` as downloaded, and for each a folder of the kernel and the modules unpacked from it.
"""

from __future__ import annotations

import lzma
import os
import re
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.can_vm.config import QEMU
from deploy.can_vm.errors import MachineUnavailableError
from deploy.can_vm.modules import WANTED, dependencies, load_order, module_name

CACHE_VARIABLE = "COSIM_CACHE_DIR"
PROGRAMS = {QEMU: "qemu-system-x86", "busybox": "busybox-static", "ip": "iproute2", "candump": "can-utils"}
"""Programs of the host and Debian's packages that hold them."""
KERNEL = "linux-image-amd64"
SEARCH = os.pathsep.join(["/usr/sbin", "/sbin", "/usr/bin", "/bin"])
APT_SECONDS = 900.0
PT_INTERP = (3).to_bytes(4, "little")


@dataclass(frozen=True, slots=True)
class BootParts:
    """Kernel, busybox and the modules (name → content) in load order."""

    kernel: Path
    busybox: Path
    modules: Mapping[str, bytes]
    order: tuple[str, ...]


def default_cache(environment: Mapping[str, str] = os.environ) -> Path:
    """Give the folder for downloads: `COSIM_CACHE_DIR`, or `hrp-cosim` in the user's cache folder."""
    if chosen := environment.get(CACHE_VARIABLE):
        return Path(chosen).absolute()
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hrp-cosim"


def missing_packages() -> tuple[str, ...]:
    """Name the packages whose programs this host lacks."""
    return tuple(package for program, package in PROGRAMS.items() if _program(program) is None)


def prepare(cache: Path) -> BootParts:
    """Find the machine's parts; what is missing is installed (as root) or downloaded by apt.

    Raises:
        MachineUnavailableError: something is missing and apt cannot or may not get it.

    """
    if missing := missing_packages():
        _install(missing)
    busybox = _program("busybox")
    if busybox is None or (missing := missing_packages()):
        raise unavailable(missing)
    if not is_static(Path(busybox).read_bytes()):
        raise MachineUnavailableError(
            f"{busybox} needs shared libraries; install Debian's package busybox-static instead"
        )
    folder = _unpacked_kernel(cache)
    modules = {path.stem: path.read_bytes() for path in folder.glob("*.ko")}
    order = tuple((folder / "order").read_text().split())
    return BootParts(folder / "vmlinuz", Path(busybox), modules, order)


def is_static(program: bytes) -> bool:
    """Tell whether a 64-bit ELF program runs without a dynamic loader: it has no program header PT_INTERP."""
    start = int.from_bytes(program[0x20:0x28], "little")
    size, count = (int.from_bytes(program[at : at + 2], "little") for at in (0x36, 0x38))
    types = (program[start + index * size :][:4] for index in range(count))
    return program.startswith(b"\x7fELF\x02\x01") and PT_INTERP not in types


def _program(name: str) -> str | None:
    return shutil.which(name, path=SEARCH)


def unavailable(packages: Sequence[str], reason: str = "") -> MachineUnavailableError:
    """Say which packages are missing and how to get them."""
    names = " ".join(packages)
    return MachineUnavailableError(
        f"the CAN machine needs the Debian packages {names}{f': {reason}' if reason else ''}\n"
        f"install them: apt-get install {names}"
    )


def _install(packages: Sequence[str]) -> None:
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        raise unavailable(packages)
    _apt(["update", "-q"], Path("/"), packages)
    _apt(["install", "-qy", "--no-install-recommends", *packages], Path("/"), packages)


def _apt(arguments: Sequence[str], directory: Path, packages: Sequence[str]) -> None:
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        ["apt-get", *arguments],
        cwd=directory,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=APT_SECONDS,
        check=False,
    )
    if done.returncode != 0:
        last = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()][-1:]
        raise unavailable(packages, f"apt-get {arguments[0]} failed: {' '.join(last)}")


def _unpacked_kernel(cache: Path) -> Path:
    try:
        cache.mkdir(parents=True, exist_ok=True)
        archives = sorted(cache.glob("linux-image-*.deb"), key=lambda path: path.stat().st_mtime)
        archive = archives[-1] if archives else _download_kernel(cache)
        folder = archive.with_suffix("")
        if not folder.exists():
            unpack_kernel(archive, folder)
    except OSError as error:
        raise MachineUnavailableError(f"cache folder {cache}: {error}; choose another by --cache") from error
    return folder


def _download_kernel(cache: Path) -> Path:
    if shutil.which("apt-get") is None:
        raise MachineUnavailableError(
            f"the CAN machine needs Debian's kernel and there is no apt-get here to fetch it:\n"
            f"put the file linux-image-…_amd64.deb that the package {KERNEL} depends on into {cache}"
        )
    package = _kernel_package()
    if package is None and os.geteuid() == 0:
        _apt(["update", "-q"], cache, [KERNEL])
        package = _kernel_package()
    if package is None:
        raise unavailable([KERNEL], "apt knows no such package; try apt-get update as root")
    with tempfile.TemporaryDirectory(prefix="download-", dir=cache) as place:
        _apt(["download", "-q", package], Path(place), [package])
        found = next(Path(place).glob(f"{package}_*.deb"))
        return found.replace(cache / found.name)


def _kernel_package() -> str | None:
    done = subprocess.run(["apt-cache", "depends", KERNEL], capture_output=True, text=True, check=False)
    found = re.search(r"Depends: (linux-image-\S+)", done.stdout)
    return found.group(1) if found else None


def unpack_kernel(archive: Path, folder: Path) -> None:
    """Take the kernel (`vmlinuz`), the modules needed and their load order (`order`) out of a Debian package.

    Raises:
        MachineUnavailableError: it holds no kernel, or one without a module that the machine needs.

    """
    kernel, modules, built_in = _read_package(archive)

    def needs(name: str) -> tuple[str, ...] | None:
        if name in built_in:
            return None
        if name not in modules:
            raise MachineUnavailableError(f"{archive}: its kernel has no module {name}; the machine needs Debian's")
        return dependencies(modules[name])

    order = load_order(WANTED, needs)
    with tempfile.TemporaryDirectory(prefix="unpack-", dir=folder.parent) as place:
        part = Path(place, "kernel")
        part.mkdir()
        (part / "vmlinuz").write_bytes(kernel)
        (part / "order").write_text("".join(f"{name}\n" for name in order))
        for name in order:
            (part / f"{name}.ko").write_bytes(modules[name])
        if not folder.exists():  # another process may have been faster
            part.rename(folder)


def _read_package(archive: Path) -> tuple[bytes, dict[str, bytes], set[str]]:
    """Read the kernel, its modules and the names of those built in."""
    kernel = b""
    modules: dict[str, bytes] = {}
    built_in: set[str] = set()
    command = ["dpkg-deb", "--fsys-tarfile", str(archive)]
    broken = MachineUnavailableError(f"{archive} is no package with a kernel; remove it and run again")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as unpacker:
        assert unpacker.stdout is not None
        try:
            with tarfile.open(fileobj=unpacker.stdout, mode="r|") as members:
                for member in members:
                    name = member.name.rsplit("/", 1)[-1]
                    content = members.extractfile(member) if member.isfile() else None
                    if content is None:
                        continue
                    if name.endswith(".ko"):
                        modules[module_name(name)] = content.read()
                    elif name.endswith(".ko.xz"):
                        modules[module_name(name)] = lzma.decompress(content.read())
                    elif name.startswith("vmlinuz-"):
                        kernel = content.read()
                    elif name == "modules.builtin":
                        built_in = {module_name(line) for line in content.read().decode().split()}
        except tarfile.TarError as error:
            raise broken from error
    if unpacker.returncode != 0 or not kernel:
        raise broken
    return kernel, modules, built_in
