from __future__ import annotations

import lzma
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy.can_vm.errors import MachineUnavailableError
from deploy.can_vm.modules import WANTED
from deploy.can_vm.packages import PROGRAMS, default_cache, is_static, unavailable, unpack_kernel

debian = pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="needs dpkg-deb")
CONTROL = "Package: linux-image-9-amd64\nVersion: 9\nArchitecture: amd64\n"
CONTROL += "Maintainer: Nobody <n@example.org>\nDescription: kernel\n"


def package(place: Path, modules: dict[str, str], built_in: tuple[str, ...] = (), kernel: str = "KERNEL") -> Path:
    """A package as Debian's kernel comes: `modules` maps each to what it needs; the first one is compressed."""
    root = place / "root"
    tree = root / "lib" / "modules" / "9-amd64"
    (tree / "kernel").mkdir(parents=True)
    (root / "boot").mkdir()
    (root / "DEBIAN").mkdir()
    (root / "DEBIAN" / "control").write_text(CONTROL)
    if kernel:
        (root / "boot" / "vmlinuz-9-amd64").write_text(kernel)
    (tree / "modules.builtin").write_text("".join(f"kernel/{name}.ko\n" for name in built_in))
    for index, (name, needs) in enumerate(modules.items()):
        content = f"{name}\0depends={needs}\0".encode()
        file = tree / "kernel" / (f"{name.replace('_', '-')}.ko" + (".xz" if index == 0 else ""))
        file.write_bytes(lzma.compress(content) if index == 0 else content)
    archive = place / "linux-image-9-amd64_9_amd64.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", "-b", str(root), str(archive)], check=True, capture_output=True)
    return archive


@debian
def test_kernel_and_needed_modules_are_unpacked_in_load_order(tmp_path: Path) -> None:
    modules = dict.fromkeys(WANTED[1:], "") | {"vcan": "can-dev", "can_dev": "", "unused": "", WANTED[-1]: "can-dev"}
    archive = package(tmp_path, modules, built_in=(WANTED[0],))
    unpack_kernel(archive, tmp_path / "out")
    order = (tmp_path / "out" / "order").read_text().split()
    assert (tmp_path / "out" / "vmlinuz").read_text() == "KERNEL"
    assert set(order) == {*WANTED[1:], "can_dev"}
    assert order.index("can_dev") < order.index("vcan")
    assert {path.stem for path in (tmp_path / "out").glob("*.ko")} == set(order)
    assert all((tmp_path / "out" / f"{name}.ko").read_bytes().startswith(name.encode()) for name in order)


@debian
def test_a_kernel_without_a_module_is_refused_by_name(tmp_path: Path) -> None:
    archive = package(tmp_path, dict.fromkeys(WANTED[:-1], ""))
    with pytest.raises(MachineUnavailableError, match=WANTED[-1]):
        unpack_kernel(archive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@debian
@pytest.mark.parametrize("content", [b"", b"no package at all"])
def test_a_broken_package_is_refused(tmp_path: Path, content: bytes) -> None:
    archive = tmp_path / "linux-image-broken.deb"
    archive.write_bytes(content)
    with pytest.raises(MachineUnavailableError, match="remove it"):
        unpack_kernel(archive, tmp_path / "out")


@debian
def test_a_package_without_a_kernel_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MachineUnavailableError, match="no package with a kernel"):
        unpack_kernel(package(tmp_path, dict.fromkeys(WANTED, ""), kernel=""), tmp_path / "out")


def test_the_cache_is_where_the_variables_say() -> None:
    assert default_cache({"COSIM_CACHE_DIR": "/cache"}) == Path("/cache")
    assert default_cache({"COSIM_CACHE_DIR": "here"}) == Path.cwd() / "here"
    assert default_cache({"XDG_CACHE_HOME": "/var/c"}) == Path("/var/c/hrp-cosim")
    assert default_cache({}) == Path(os.path.expanduser("~/.cache/hrp-cosim"))


def test_a_missing_package_is_named_with_the_remedy() -> None:
    message = str(unavailable(tuple(PROGRAMS.values()), "no network"))
    assert "no network" in message
    assert message.splitlines()[-1] == "install them: apt-get install qemu-system-x86 busybox-static iproute2 can-utils"


def test_a_program_with_a_loader_is_not_static() -> None:
    assert not is_static(Path("/bin/sh").read_bytes())
    assert not is_static(b"#!/bin/sh\n")
    header = bytearray(64 + 56)
    header[:6] = b"\x7fELF\x02\x01"
    header[0x20], header[0x36], header[0x38], header[64] = 64, 56, 1, 1
    assert is_static(bytes(header))
    header[64] = 3
    assert not is_static(bytes(header))
