"""Tables 2 and 3 of [Del Prete 2016]: errors of motion control beside those of the paper."""

from __future__ import annotations

from typing import Final

import numpy as np

from deploy.series import Array
from experiments.figures.torque_vs_position import joint_word
from experiments.leg_signals import Motion, rms
from schemas.load import Run

POSITION: Final = "position"
GAINS: Final = (1.0, 0.5, 0.25, 0.1)
"""K₆."""
PAPER_TABLES: Final[dict[str, dict[str, tuple[float, ...]]]] = {
    "avg": {
        "R_HIP_R": (0.020, 0.005, 0.008, 0.016, 0.040),
        "R_HIP_P": (0.056, 0.018, 0.035, 0.064, 0.139),
        "R_KNEE": (0.115, 0.060, 0.061, 0.067, 0.094),
        "R_ANKLE_P": (0.064, 0.017, 0.034, 0.063, 0.148),
        "R_ANKLE_R": (0.029, 0.015, 0.029, 0.059, 0.136),
    },
    "max": {
        "R_HIP_R": (4.79, 2.35, 2.95, 2.85, 5.76),
        "R_HIP_P": (17.01, 7.87, 7.83, 10.40, 22.78),
        "R_KNEE": (61.86, 39.64, 41.55, 41.19, 49.33),
        "R_ANKLE_P": (19.56, 4.84, 5.92, 10.39, 22.43),
        "R_ANKLE_R": (6.11, 2.55, 3.69, 6.80, 16.44),
    },
}
"""Tables 2 and 3 [mrad]: position control, then the K₆ of `GAINS`."""


def gain_name(gain: float) -> str:
    """Name of the run with a K₆."""
    return f"k6_{gain:g}"


def table_average(error: Array) -> Array:
    """N⁻¹ √Σe² (n,) of errors (N, n), the average of Table 2 of [Del Prete 2016]."""
    average: Array = np.sqrt(np.sum(error**2, axis=0)) / len(error)
    return average


def measures(error: Array) -> dict[str, Array]:
    """Average of Table 2, maximum of Table 3 and root mean square, each (n,) [rad], of errors (N, n)."""
    return {"avg": table_average(error), "max": np.abs(error).max(axis=0), "rms": rms(error)}


def ratios(scenario: Run, motions: dict[str, Motion], joints: list[int]) -> dict[str, dict[str, dict[str, float]]]:
    """Give measure → run → joint → error over that of the position control."""
    names = scenario.robot.description.joint_names
    plain = measures(motions[POSITION].error)
    return {
        measure: {
            name: {names[joint]: float(measures(each.error)[measure][joint] / base[joint]) for joint in joints}
            for name, each in motions.items()
            if name != POSITION
        }
        for measure, base in plain.items()
    }


def paper_ratio(measure: str, joint: str, gain: float) -> float:
    """Give the ratio of the paper's tables: `avg` of Table 2, `max` of Table 3."""
    row = PAPER_TABLES[measure][joint]
    return row[1 + GAINS.index(gain)] / row[0]


def paper_ratios(scenario: Run, joints: list[int]) -> dict[str, dict[str, dict[str, float]]]:
    """Give measure → run → joint → ratio of the paper, for joints by index."""
    names = [scenario.robot.description.joint_names[joint] for joint in joints]
    return {
        measure: {gain_name(gain): {name: paper_ratio(measure, name, gain) for name in names} for gain in GAINS}
        for measure in PAPER_TABLES
    }


def tables(scenario: Run, motions: dict[str, Motion], joints: list[int]) -> str:
    """Write Tables 2 and 3 with ratios to the position control, the paper's in brackets, as Markdown."""
    names = scenario.robot.description.joint_names
    of = ratios(scenario, motions, joints)
    text = []
    for measure, title in (("avg", "Table 2: N⁻¹ √Σe²"), ("max", "Table 3: largest error")):
        text += [f"{title} [mrad]; ratio to position control (the paper's)", ""]
        text += [f"| joint | position | {' | '.join(f'K₆ = {gain:g}' for gain in GAINS)} | K₆ = 1, late velocity |"]
        text += ["|---" * (len(GAINS) + 3) + "|"]
        for joint in joints:
            name = names[joint]
            cells = [joint_word(name)]
            cells.append(f"{1e3 * measures(motions[POSITION].error)[measure][joint]:.3g}")
            for gain in GAINS:
                value = 1e3 * measures(motions[gain_name(gain)].error)[measure][joint]
                ratio = of[measure][gain_name(gain)][name]
                cells.append(f"{value:.3g}; {ratio:.2f} ({paper_ratio(measure, name, gain):.2f})")
            late = 1e3 * measures(motions["late"].error)[measure][joint]
            cells.append(f"{late:.3g}; {of[measure]['late'][name]:.2f}")
            text.append(f"| {' | '.join(cells)} |")
        text.append("")
    return "\n".join(text)
