"""What was identified, as YAML files: motors and payloads that a scenario names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from controller_service.ft_calibration import Payload
from deploy.errors import ReportError, UsageError
from deploy.identify import Identification, weight_of
from schemas.control_law import SensorPayload

DIGITS = 5
"""Significant digits of a written value: more than any of them is known to."""


def write_motors(result: Identification, path: Path) -> None:
    """Write models that `controller.position_torque.motors_from` names.

    Raises:
        ReportError: the file cannot be written.

    """
    options = result.options
    logs = ", ".join(result.logs) or "a log"
    lines = [
        f"Motors of {result.robot.name}, identified by `cosim identify motors` from {logs}:",
        f"method {options.method.value}, weight {weight_of(options):g}, window {options.filter.window}, at rest below"
        f" {options.still_velocity:g} rad/s.",
        "Units: torque_gain rad/(N·m), velocity_gain s, coulomb rad, (6) of [Del Prete 2016].",
    ]
    motors = {
        joint: {name: rounded(value) for name, value in model.items()} for joint, model in result.motors().items()
    }
    _write(lines, {"motors": motors}, path)


def write_payload(payload: SensorPayload, header: Sequence[str], path: Path) -> None:
    """Write a payload that a scenario's `controller.position_torque.payload` may hold.

    Raises:
        ReportError: the file cannot be written.

    """
    values = payload.model_dump()
    body = {
        name: rounded(value) if isinstance(value, float) else [rounded(each) for each in value]
        for name, value in values.items()
    }
    _write(header, {"payload": body}, path)


def read_payload(path: Path) -> Payload:
    """Read what `write_payload` wrote.

    Raises:
        UsageError: no such file, or not of this form.

    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        payload = SensorPayload.model_validate(data["payload"])
    except OSError as error:
        raise UsageError(f"--payload {path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"--payload {path}: expected a mapping `payload:` as `cosim identify ft --out` writes it"
        ) from error
    return payload_of(payload)


def payload_of(payload: SensorPayload) -> Payload:
    """Turn the configuration's form into the estimator's."""
    moment = [payload.mass * component for component in payload.centre_in_sensor]
    return Payload(payload.mass, np.array(moment), np.array(payload.force_offset + payload.torque_offset))


def rounded(value: float) -> float:
    """Round to `DIGITS` significant digits."""
    return float(f"{value:.{DIGITS}g}")


def _write(header: Sequence[str], data: dict[str, Any], path: Path) -> None:
    text = "".join(f"# {line}\n" for line in header)
    text += yaml.safe_dump(data, default_flow_style=None, sort_keys=False, allow_unicode=True, width=120)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ReportError(f"--out {path}: cannot be written: {error.strerror}") from error
