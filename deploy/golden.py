"""`make golden`: write the small log that the test suite replays, with both changes of mode in it."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from deploy.runner import run_to_log
from schemas.load import load_run

SCENARIO: Final = "arm9-transition"
OVERRIDES: Final[dict[str, Any]] = {
    "seed": 1,
    "duration_s": 0.3,
    "plant.initial_posture": {"shoulder_pitch": -0.6, "shoulder_roll": -0.35, "elbow_pitch": -1.3},
    "controller.phases": [
        {"name": "hold", "mode": "position", "duration_s": 0.06},
        {
            "name": "track",
            "mode": "torque",
            "duration_s": 0.16,
            "hand_path": {"shape": "circle", "plane": "yz", "diameter_m": 0.004, "lap_s": 0.16},
        },
        {"name": "back", "mode": "position", "duration_s": 0.08},
    ],
}
DEFAULT: Final = Path("tests/data/golden.mcap")


def write_golden(path: Path) -> None:
    """Run in this process and put the log at `path`."""
    with tempfile.TemporaryDirectory(prefix="cosim-golden-") as directory:
        log = run_to_log(load_run(SCENARIO, OVERRIDES), Path(directory))
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(log, path)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    write_golden(target)
    print(target)
