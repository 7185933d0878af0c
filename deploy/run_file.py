"""The resolved run as one JSON file: what the launcher gives to every service, and what a log holds."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from schemas.check_run import check_run
from schemas.errors import ConfigurationError
from schemas.load import Run
from schemas.log import RunRecord


def write_run(run: Run, path: Path) -> None:
    """Write description, URDF text and scenario; equal runs give equal files."""
    path.write_text(RunRecord.of(run).model_dump_json(by_alias=True, indent=1), encoding="utf-8")


def read_run(path: Path) -> Run:
    """Read what `write_run` wrote.

    Raises:
        ConfigurationError: the file is missing, is not JSON, or does not fit the models.

    """
    try:
        run = RunRecord.model_validate_json(path.read_bytes()).run()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot read the run: {error.strerror}") from error
    except ValidationError as error:
        fault = error.errors()[0]
        field = ".".join(str(part) for part in fault["loc"]) or "the file"
        raise ConfigurationError(f"{path}: {field}: {fault['msg']}; expected a run as `cosim up` writes it") from error
    check_run(run.robot.description, run.scenario, path)
    return run
