"""pytest plugin: `pytest --cosim-log run.mcap …` replays each log and fails where it comes out differently.

One test item a file and part, named `run.mcap::controller`, `run.mcap::hal`, `run.mcap::plant`. Nothing of the project
is imported unless the option is given.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

PARTS = ("controller", "hal", "plant")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("cosim", "replay of hrp-cosim logs")
    group.addoption(
        "--cosim-log", action="append", default=[], metavar="FILE", help="log to replay as tests; repeatable"
    )
    group.addoption(
        "--cosim-part",
        action="append",
        choices=PARTS,
        default=[],
        help="replay this part of each log only; repeatable (default: all)",
    )


def pytest_collection(session: pytest.Session) -> None:
    """Refuse a log that does not exist before anything runs.

    Raises:
        pytest.UsageError: naming the file.

    """
    for name in session.config.getoption("--cosim-log"):
        if not Path(name).is_file():
            raise pytest.UsageError(f"--cosim-log {name}: no such file")


def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Add the replays to whatever else was collected."""
    parts = session.config.getoption("--cosim-part") or PARTS
    for name in session.config.getoption("--cosim-log"):
        log = LogFile.from_parent(session, path=Path(name).resolve(), parts=tuple(parts))
        items.extend(log.collect())


class LogFile(pytest.File):
    """A log as a collector of replays."""

    parts: tuple[str, ...]

    @classmethod
    def from_parent(cls, parent: pytest.Session, *, path: Path, parts: tuple[str, ...]) -> LogFile:  # type: ignore[override]  # pytest's is **kw
        """Make the collector."""
        file: LogFile = super().from_parent(parent, path=path)
        file.parts = parts
        return file

    def collect(self) -> Iterable[pytest.Item]:
        """One item a part."""
        return [Replay.from_parent(self, name=part) for part in self.parts]


class ReplayFailure(Exception):  # noqa: N818 what pytest shows as the reason
    """The log came out differently."""


class Replay(pytest.Item):
    """Replays one part of a log."""

    def runtest(self) -> None:
        """Replay.

        Raises:
            ReplayFailure: the first difference.
            CosimError: the log cannot be read or replayed.

        """
        from deploy.replay import replay_log

        result = replay_log(self.path, self.name)
        if not result.passed:
            raise ReplayFailure(result.describe())

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: object = None) -> str:
        """Show the message alone for what is no fault of the code."""
        from schemas.errors import CosimError

        if isinstance(excinfo.value, ReplayFailure | CosimError):
            return str(excinfo.value)
        return str(super().repr_failure(excinfo))

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Name the item in reports."""
        return self.path, None, f"{self.path.name}::{self.name}"
