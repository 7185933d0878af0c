"""Figures of the experiments, laid out like those of the papers."""

from experiments.figures.anti_windup import anti_windup_figure
from experiments.figures.drawing import save
from experiments.figures.dual_compliance import dual_compliance_figure
from experiments.figures.null_space import null_space_figure
from experiments.figures.obstacle_track import obstacle_track_figure

__all__ = [
    "anti_windup_figure",
    "dual_compliance_figure",
    "null_space_figure",
    "obstacle_track_figure",
    "save",
]
