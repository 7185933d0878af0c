"""Figs. 1 and 3 of [Del Prete 2016]: how the models of a joint's motor meet its samples."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller_service.motor_fit import MotorFit, fit_least_squares
from controller_service.motor_samples import MotorSamples
from controller_service.piecewise_fit import PiecewiseModel
from deploy.identify import Identification, fit_pieces
from deploy.series import Array
from experiments.figures.drawing import describe, legend, tidy

POINTS: Final = 4000
"""Samples drawn of those that there are: more make the picture no fuller."""
SIGNS: Final[tuple[tuple[float, str, dict[str, Any]], ...]] = (
    (1.0, "samples, q̇ > 0", {"color": "#d6604d"}),
    (-1.0, "samples, q̇ < 0", {"color": "#4393c3"}),
)
MARKS: Final[dict[str, Any]] = {"linestyle": "none", "marker": ".", "markersize": 2.0, "alpha": 0.5, "rasterized": True}
SYMMETRIC: Final[dict[str, Any]] = {"color": "#555555", "linewidth": 1.8, "linestyle": "--"}
ASYMMETRIC: Final[dict[str, Any]] = {"color": "#1b7837", "linewidth": 1.8}
BINS: Final = 80


def motor_figure(result: Identification, joint: int) -> Figure:
    """Draw Δq over τ of a joint at rest, as Fig. 1: samples, symmetric line, piecewise models, the model identified.

    Args:
        result: models and samples.
        joint: its index.

    """
    identified, still = result.joints[joint], result.options.still_velocity
    samples = result.data.of(joint)
    symmetric = fit_least_squares(samples, joint=identified.joint)
    pieces = identified.piecewise or fit_pieces(result.robot.joints[joint], samples, result.options)
    resting = samples.where(np.abs(samples.velocity) < still)
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    name = identified.joint.replace("_", " ")
    figure.suptitle(f"{name} at rest, slower than {still:g} rad/s: Δq over joint torque")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for axis in axes.flat:
        _points(axis, resting.torque, resting.offset * 1e3, resting.velocity)
    torque = np.linspace(float(resting.torque.min()), float(resting.torque.max()), 400)
    zero = np.zeros_like(torque)
    describe(axes[0, 0], "(a) samples by the sign of the velocity", "Δq [mrad]")
    axes[0, 1].plot(torque, symmetric.offset(torque, zero) * 1e3, label="symmetric penalty (7)", **SYMMETRIC)
    describe(axes[0, 1], f"(b) least squares, 10³ k_τ = {1e3 * symmetric.torque_gain:.4g} rad/(N·m)", "")
    _pieces(axes[1, 0], pieces, torque)
    axes[1, 1].plot(torque, identified.fit.offset(torque, zero) * 1e3, label=_label(identified.fit), **ASYMMETRIC)
    describe(axes[1, 1], f"(d) {_label(identified.fit)}, 10³ k_τ = {1e3 * identified.fit.torque_gain:.4g}", "")
    for axis in axes[1]:
        axis.set_xlabel("τ, estimated [N·m]")
    tidy([*axes.flat])
    legend(figure, [*axes.flat], columns=3)
    return figure


def friction_figure(result: Identification, joint: int) -> Figure:
    """Draw Δq less its torque part over the velocity, and the residuals, as Fig. 3: symmetric above, identified below.

    Args:
        result: models and samples.
        joint: its index.

    """
    identified = result.joints[joint]
    samples = result.data.of(joint)
    moving = samples.where(np.abs(samples.velocity) >= result.options.still_velocity)
    fits = (fit_least_squares(samples, joint=identified.joint), identified.fit)
    figure = Figure(figsize=(10.0, 6.6), layout="constrained")
    figure.suptitle(
        f"{identified.joint.replace('_', ' ')} in motion: friction part of Δq, and what the model over-estimates"
    )
    axes = figure.subplots(2, 2, sharex="col", sharey="col", width_ratios=(3, 2))
    residuals = [fit.over_estimation(moving) * 1e3 for fit in fits]
    # The rarest thousandths at both ends would leave the rest of the histogram a line
    low, high = np.quantile(np.concatenate(residuals), (0.001, 0.999)).tolist()
    width = (high - low) / BINS
    edges = width * np.arange(math.floor(low / width), math.ceil(high / width) + 1)  # zero parts two bins
    for row, fit, residual in zip(axes, fits, residuals, strict=True):
        _friction(row[0], moving, fit)
        _residuals(row[1], residual, edges)
    axes[1, 0].set_xlabel("q̇, estimated [rad/s]")
    axes[1, 1].set_xlabel("|model| − |Δq| [mrad]")
    tidy([*axes.flat])
    legend(figure, [*axes.flat], columns=3)
    return figure


def _points(axis: Axes, x: Array, y: Array, velocity: Array) -> None:
    """Draw samples by the sign of the velocity, evenly picked."""
    chosen = np.arange(0, len(x), max(1, len(x) // POINTS))
    for sign, label, colour in SIGNS:
        part = chosen[sign * velocity[chosen] > 0.0]
        axis.plot(x[part], y[part], label=label, **MARKS, **colour)


def _pieces(axis: Axes, pieces: PiecewiseModel, torque: Array) -> None:
    states = []
    for fit, (sign, _, _), style in zip((pieces.positive, pieces.negative), SIGNS, ("-", "-."), strict=True):
        side = "q̇ > 0" if sign > 0.0 else "q̇ < 0"
        if fit.lines is not None:
            offset = fit.lines.offset(torque) * 1e3
            axis.plot(torque, offset, color="black", linewidth=1.3, linestyle=style, label=f"piecewise, {side}")
        states.append(f"{side} {'converged' if fit.converged else 'did not converge'}")
    describe(axis, f"(c) piecewise: {', '.join(states)}", "Δq [mrad]")


def _friction(axis: Axes, moving: MotorSamples, fit: MotorFit) -> None:
    part = (moving.offset - fit.torque_gain * moving.torque) * 1e3
    _points(axis, moving.velocity, part, moving.velocity)
    velocity = np.linspace(float(moving.velocity.min()), float(moving.velocity.max()), 401)
    style = SYMMETRIC if fit.weight == 1.0 else ASYMMETRIC
    axis.plot(velocity, fit.offset(np.zeros_like(velocity), velocity) * 1e3, label=_label(fit), **style)
    describe(axis, f"{_label(fit)}: 10³ k_v = {1e3 * fit.velocity_gain:.4g} s", "Δq − k_τ τ [mrad]")


def _residuals(axis: Axes, residual: Array, edges: Array) -> None:
    counts, _ = np.histogram(residual, edges)
    share = counts / len(residual)
    middle = 0.5 * (edges[:-1] + edges[1:])
    for is_over, colour, label in ((False, "#92c5de", "under-estimated"), (True, "#f4a582", "over-estimated")):
        chosen = (middle > 0.0) == is_over
        axis.bar(middle[chosen], share[chosen], edges[1] - edges[0], color=colour, label=label)
    axis.axvline(0.0, color="black", linewidth=0.8)
    rate, largest = float(np.mean(residual > 0.0)), max(float(residual.max()), 0.0)
    title = f"{rate:.1%} over-estimated, by up to {largest:.2g} mrad"
    describe(axis, title, "share of samples [1]")


def _label(fit: MotorFit) -> str:
    return "symmetric penalty (7)" if fit.weight == 1.0 else f"{fit.method.value}, w = {fit.weight:g}"
