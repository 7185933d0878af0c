"""Figures of the experiments, laid out like those of the papers."""

from experiments.figures.anti_windup import anti_windup_figure
from experiments.figures.components import components_figure
from experiments.figures.drawing import save
from experiments.figures.dual_compliance import dual_compliance_figure
from experiments.figures.estimators import estimators_figure
from experiments.figures.force_sine import force_sine_figure
from experiments.figures.identify_leg import friction_figure, motor_figure
from experiments.figures.null_space import null_space_figure
from experiments.figures.obstacle_track import obstacle_track_figure
from experiments.figures.torque_vs_position import torque_vs_position_figure

__all__ = [
    "anti_windup_figure",
    "components_figure",
    "dual_compliance_figure",
    "estimators_figure",
    "force_sine_figure",
    "friction_figure",
    "motor_figure",
    "null_space_figure",
    "obstacle_track_figure",
    "save",
    "torque_vs_position_figure",
]
