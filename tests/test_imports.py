"""The table of docs/architecture.md: which package may import which of ours, and what the controller may never see."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "schemas": (),
    "hal": ("schemas",),
    "plant_service": ("schemas", "hal.profile", "hal.bus"),
    "controller_service": ("schemas",),
}
"""Package → what of ours it may import beside itself; `deploy` and what is not listed may import all."""
OURS = {"schemas", "hal", "plant_service", "controller_service", "deploy", "experiments", "benchmarks", "tests"}
FOREIGN = {"controller_service": {"mujoco", "can", "canopen"}, "schemas": {"mujoco", "can", "canopen", "pinocchio"}}
"""Third-party packages that would let a package reach around its boundary."""


def imports(file: Path, package: str) -> Iterator[tuple[int, str]]:
    """(line, absolute dotted name) of every import in a file, also those inside functions and relative ones."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parts, base] if base else parts)
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"


def refused(package: str, name: str) -> bool:
    top = name.split(".")[0]
    if top in FOREIGN.get(package, ()):
        return True
    if top not in OURS or top == package:
        return False
    return not any(name == allowed or name.startswith(f"{allowed}.") for allowed in ALLOWED[package])


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_packages_import_only_what_the_architecture_allows(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    faults = [
        f"{file.relative_to(ROOT)}:{line}: {package} must not import {name}"
        for file in files
        for line, name in imports(file, ".".join(file.relative_to(ROOT).parent.parts))
        if refused(package, name)
    ]
    assert not faults, "\n".join(faults)


def test_the_check_sees_what_it_should(tmp_path: Path) -> None:
    file = tmp_path / "x.py"
    file.write_text("import mujoco\nfrom hal.bus import ports\ndef f():\n    from . import y\n    from ..z import w\n")
    assert [name for _, name in imports(file, "a.b")] == ["mujoco", "hal.bus.ports", "a.b.y", "a.z.w"]
    assert refused("controller_service", "mujoco")
    assert refused("controller_service", "hal.bus.ports")
    assert refused("plant_service", "hal.cycle")
    assert refused("plant_service", "hal.profile_of_another")
    assert not refused("plant_service", "hal.bus.ports")
    assert not refused("controller_service", "schemas.load")


def test_the_table_in_the_documentation_is_this_one() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = dict(
        (cells[1].strip(" `"), cells[2].strip().replace("`", ""))
        for line in text.splitlines()
        if line.startswith("| `") and len(cells := line.split("|")) > 3
    )
    for package, allowed in ALLOWED.items():
        assert rows[package] == (", ".join(allowed) or "none")
