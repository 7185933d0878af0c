"""Fig. 6 of [Del Prete 2016]: the terms of Δq in motion and in force control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.series import Array
from experiments.figures.drawing import THIN, common_limits, describe, legend, line, tidy

PANELS: Final = (
    ("a", "R_HIP_P", "motion_k6_0.1", "Hip pitch, motion, K₆ = 0.1"),
    ("b", "R_HIP_P", "motion_k6_1", "Hip pitch, motion, K₆ = 1"),
    ("c", "R_KNEE", "motion_k6_0.1", "Knee, motion, K₆ = 0.1"),
    ("d", "R_KNEE", "motion_k6_1", "Knee, motion, K₆ = 1"),
    ("e", "R_KNEE", "force", "Knee, force"),
    ("f", "R_ANKLE_P", "force", "Ankle pitch, force"),
)
"""As the paper's, from left to right and down."""
STYLE: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "torque": ("feed-forward torque", {"color": "#2166ac", "linewidth": 1.6}),
    "friction": ("feed-forward friction", {"color": "#b2182b", "linewidth": 1.6}),
    "position": ("feedback position", {"color": "#1b7837", "linewidth": 1.2}),
    "velocity": ("feedback velocity", {"color": "#d95f02", "linewidth": 1.0}),
    "acceleration": ("feedback acceleration", {"color": "#7b3294", "linewidth": 1.0}),
    "force": ("feedback force", {"color": "black", "linewidth": 1.0, "linestyle": "--"}),
    "integral": ("feedback integral", {"color": "#888888", "linewidth": 1.0}),
}
LEAST_MRAD: Final = 1.0


class _Terms(Protocol):
    """What is drawn of a case: see `experiments.components.Components`."""

    @property
    def time_s(self) -> Array: ...
    @property
    def terms(self) -> dict[str, Array]: ...
    @property
    def rms(self) -> dict[str, Array]: ...


def components_figure(cases: Mapping[str, _Terms], joints: tuple[str, ...]) -> Figure:
    """Draw six panels: all terms over time; the titles name the two largest by root mean square.

    Args:
        cases: by the names of `experiments.components.CASES`.
        joints: names, in the order of the terms' columns.

    """
    figure = Figure(figsize=(11.0, 9.5), layout="constrained")
    figure.suptitle("Parts of the control input Δq")
    axes = figure.subplots(3, 2)
    for axis, (letter, joint, case, title) in zip(axes.flat, PANELS, strict=True):
        _panel(axis, cases[case], joints.index(joint), f"({letter}) {title}")
    for row in axes[:2]:
        limits = common_limits([drawn.get_ydata() for axis in row for drawn in axis.lines], LEAST_MRAD)
        for axis in row:
            axis.set_ylim(limits)
    tidy([*axes.flat])
    legend(figure, [*axes.flat], columns=3)
    return figure


def _panel(axis: Axes, terms: _Terms, joint: int, title: str) -> None:
    for name, values in terms.terms.items():
        label, style = STYLE[name]
        line(axis, terms.time_s, 1e3 * values[:, joint], label=label, **style)
    axis.axhline(0.0, **THIN | {"linewidth": 0.5})
    axis.set_xlim(float(terms.time_s[0]), float(terms.time_s[-1]))
    of = {name: 1e3 * float(values[joint]) for name, values in terms.rms.items()}
    first, second = sorted(of, key=lambda name: -of[name])[:2]
    describe(axis, f"{title}: rms {first} {of[first]:.2g}, {second} {of[second]:.2g} mrad", "part of Δq [mrad]")
    axis.set_ylim(common_limits([1e3 * np.asarray(values[:, joint]) for values in terms.terms.values()], LEAST_MRAD))
    axis.set_xlabel("time [s]")
