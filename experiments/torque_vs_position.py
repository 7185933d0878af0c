"""Motion control, section 5.3, Tables 2 and 3 and Fig. 4 of [Del Prete 2016]: torque control against the drives' own.

The leg makes a stairs-climbing swing under the plain position control and under torque control with position feedback
K₆ = 1, 0.5, 0.25 and 0.1 of the drives' gain, with motors identified on the same plant. Errors are q^d − q over the
swing, q the plant's truth and q^d the phase's motion at the same time, the same for all; position control follows its
QP's open-loop integral of it (`reference_difference_rad` says how far that is from q^d). Table 2's average is
N⁻¹ √Σe². Joints that q^d does not move are left out; the paper's ratios are those of its own five joints.

The position control's error is that of drives whose targets arrive late, on a robot whose torque control knows the
delay: `position_delay_error_rad` is what the delay alone makes of the largest speed, the rest is the drives' law.

Beside these: K₆ = 1 as the paper has it, its friction fed forward from the late velocity alone; and twice in open loop
(all feedback gains zero), where what the motors' models over-estimate would drive the leg on. The first run gets the
same motion: without feedback it hardly follows, but must not be faster than what is asked, and rest after. In the
second nothing is asked and a kick gives the leg speed, which must die away (the paper's unstable model accelerated
"as soon as a certain velocity was reached"). A joint that coasts to its range is stopped by the command's limit.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.errors import UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import RunSeries
from experiments.figures import save, torque_vs_position_figure
from experiments.hand_runs import load, perform, phase_named, workplace
from experiments.leg_runs import identified_motors
from experiments.leg_signals import CONFIG, Motion, in_span, motion, phase_span
from experiments.leg_tables import (
    GAINS,
    PAPER_TABLES,
    POSITION,
    gain_name,
    measures,
    paper_ratio,
    paper_ratios,
    ratios,
    tables,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "leg6-stairs"
SWING: Final = "swing"
REST: Final = "rest"
JUDGED: Final = (1.0, 0.5)
"""K₆ whose ratios are to be no worse than the paper's."""
MOVES_RAD: Final = 0.02
"""A joint whose q^d changes by less is not compared."""
OPEN: Final[dict[str, Any]] = {
    f"{CONFIG}.position_gain": 0.0,
    f"{CONFIG}.velocity_gain": 0.0,
    f"{CONFIG}.torque_gain": 0.0,
    f"{CONFIG}.force_gain": 0.0,
    f"{CONFIG}.predict_velocity": False,
}
KICK_S: Final = 0.3
KICK: Final[dict[str, Any]] = {
    "kind": "push",
    "name": "kicked",
    "link": "R_ANKLE_P_S",
    "force_in_world": [-400.0, 0.0, 300.0],
    "duration_s": KICK_S,
    "shape": "half_sine",
}
"""Backwards and up; hip and knee then turn at more than 2 rad/s."""
KICK_AFTER_S: Final = 0.2
"""From the swing's start."""
OWN_FIELDS: Final = (
    *(f"{CONFIG}.{name}" for name in ("motors", "motors_from", "position_gain", "velocity_gain", "torque_gain")),
    *(f"{CONFIG}.{name}" for name in ("torque_integral", "force_gain", "predict_velocity")),
    "controller.phases",
    "plant.world.events",
)
SPEED_RATIO: Final = 1.0
ENERGY_LEFT: Final = 0.1
ENERGY_GROWTH: Final = 1.05


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what the experiment sets itself, or takes away what it needs.
        RunStoppedError: the HAL stopped a run.
        ControllerError: a joint became too fast under torque control.
        IdentificationError: the motors cannot be identified.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS)
    phase_span(scenario, REST)
    with workplace(request) as directory:
        variants = overrides_of(scenario)
        request.progress(0.0, "identifying the motors")
        motors = identified_motors(request, directory)
        runs: dict[str, RunSeries] = {}
        for number, (name, overrides) in enumerate(variants.items()):
            request.progress(0.5 + 0.5 * number / len(variants), name)
            runs[name] = perform(request, SCENARIO, directory / name, {f"{CONFIG}.motors": motors, **overrides})
        result = evaluate(request, scenario, runs)
        if request.directory is not None:
            motions, joints = motions_of(runs), compared_joints(runs)
            (directory / "tables-2-3.md").write_text(tables(scenario, motions, joints), encoding="utf-8")
            of, paper = ratios(scenario, motions, joints), paper_ratios(scenario, joints)
            save(torque_vs_position_figure(runs, motions, of, paper), directory / "torque-vs-position")
    return result


def overrides_of(scenario: Run) -> dict[str, dict[str, Any]]:
    """Give what each run has otherwise than the scenario."""
    phases = scenario.scenario.controller.phases
    start_s, _ = phase_span(scenario, SWING)
    phase_named(scenario, REST)
    plain = {f"controller.phases.{phase.name}.torque_control": False for phase in phases if phase.torque_control}
    kick = {**KICK, "start_s": start_s + KICK_AFTER_S}
    return {
        POSITION: plain,
        **{gain_name(gain): {f"{CONFIG}.position_gain": gain} for gain in GAINS},
        "late": {f"{CONFIG}.position_gain": 1.0, f"{CONFIG}.predict_velocity": False},
        "open": OPEN,
        "kicked": {**OPEN, f"controller.phases.{SWING}.joint_path": None, "plant.world.events": [kick]},
    }


def motions_of(runs: dict[str, RunSeries]) -> dict[str, Motion]:
    """Take the swing of the compared runs against the q^d of the one with K₆ = 1."""
    asked = runs[gain_name(GAINS[0])]
    span = phase_span(asked.run, SWING)
    return {name: motion(runs[name], span, asked) for name in (POSITION, *map(gain_name, GAINS), "late")}


def compared_joints(runs: dict[str, RunSeries]) -> list[int]:
    """Give the indices of the joints that the swing moves.

    Raises:
        UsageError: one that the paper does not have.

    """
    series = runs[gain_name(GAINS[0])]
    names = series.run.robot.description.joint_names
    moved = np.ptp(motion(series, phase_span(series.run, SWING)).desired, axis=0) >= MOVES_RAD
    joints: list[int] = np.flatnonzero(moved).tolist()
    if others := [names[joint] for joint in joints if names[joint] not in PAPER_TABLES["avg"]]:
        raise UsageError(f"the swing moves {', '.join(others)}, for which Tables 2 and 3 of the paper have no row")
    return joints


def evaluate(request: ExperimentRequest, scenario: Run, runs: dict[str, RunSeries]) -> ExperimentResult:
    """Measure all runs."""
    description = scenario.robot.description
    names = description.joint_names
    motions, joints = motions_of(runs), compared_joints(runs)

    def by_joint(values: Any) -> dict[str, float]:
        return {names[joint]: float(values[joint]) for joint in joints}

    metrics: dict[str, Any] = {}
    of = ratios(scenario, motions, joints)
    for name, each in motions.items():
        for measure, values in measures(each.error).items():
            metrics[f"{name}_{measure}_rad"] = by_joint(values)
            if name != POSITION:
                metrics[f"{name}_{measure}_ratio"] = of[measure][name]
    worse = {}
    for gain in GAINS:
        pairs = [
            (measure, joint, of[measure][gain_name(gain)][joint], paper_ratio(measure, joint, gain))
            for measure in PAPER_TABLES
            for joint in by_joint(np.zeros(len(names)))
        ]
        for measure in PAPER_TABLES:
            metrics[f"paper_{gain_name(gain)}_{measure}_ratio"] = {j: paper for m, j, _, paper in pairs if m == measure}
        worse[gain] = [f"{measure} of {joint}" for measure, joint, ours, paper in pairs if ours > paper]
        metrics[f"{gain_name(gain)}_worse_than_paper"] = len(worse[gain])
        metrics[f"{gain_name(gain)}_worse_than_paper_which"] = ", ".join(worse[gain])
        metrics[f"{gain_name(gain)}_worse_than_position"] = sum(ours > 1.0 for _, _, ours, _ in pairs)
    metrics["late_worse_than_paper"] = sum(
        ratio > paper_ratio(measure, joint, 1.0)
        for measure in PAPER_TABLES
        for joint, ratio in of[measure]["late"].items()
    )
    metrics |= _references(runs, motions, by_joint) | _near_limits(runs, by_joint)
    stability = open_loop(runs)
    metrics |= stability
    first = gain_name(GAINS[0])
    bars = [
        *(Bar(f"{first}_{measure}_ratio_max", max(of[measure][first].values()), 1.0) for measure in PAPER_TABLES),
        *(Bar(f"{gain_name(gain)}_worse_than_paper", float(len(worse[gain])), 0.0) for gain in JUDGED),
        Bar("open_speed_ratio", stability["open_speed_ratio"], SPEED_RATIO),
        Bar("open_energy_left", stability["open_energy_left"], ENERGY_LEFT),
        Bar("kicked_energy_growth", stability["kicked_energy_growth"], ENERGY_GROWTH),
        Bar("kicked_energy_left", stability["kicked_energy_left"], ENERGY_LEFT),
    ]
    return ExperimentResult(
        "torque-vs-position", description.name, request.seed, fingerprint(scenario), metrics, tuple(bars)
    )


def open_loop(runs: dict[str, RunSeries]) -> dict[str, float]:
    """Measure what the leg does without feedback.

    Returns:
        `open_speed_ratio`: the largest speed of any joint over the largest that q^d asks of any, while it asks.
        `open_energy_left`: kinetic energy at the end of the rest over the largest before; 0 if there was none.
        `open_drift_rad`: the largest q^d − q.
        `kicked_speed_max`: of any joint [rad/s] when the kick is over.
        `kicked_energy_growth`: the largest kinetic energy after the kick over that at its end.
        `kicked_energy_left`: the energy at the end of the rest over that at the kick's end.

    """
    series = runs["open"]
    swing, rest = phase_span(series.run, SWING), phase_span(series.run, REST)
    moved = motion(series, (swing[0], rest[1]))
    asked = np.abs(np.gradient(motion(series, swing).desired, series.run.robot.description.period_s, axis=0)).max()
    energy = series.truth.kinetic_energy
    time_s = series.truth.time_s
    largest = energy[in_span(time_s, (swing[0], rest[1]))].max()
    kicked = runs["kicked"]
    end_s = phase_span(kicked.run, SWING)[0] + KICK_AFTER_S + KICK_S
    after = kicked.truth.kinetic_energy[in_span(kicked.truth.time_s, (end_s, phase_span(kicked.run, REST)[1]))]
    speeds = np.abs(kicked.truth.velocity[in_span(kicked.truth.time_s, (end_s, float("inf")))][0])
    return {
        "open_speed_ratio": float(np.abs(moved.velocity).max() / asked),
        "open_energy_left": float(energy[in_span(time_s, rest)][-1] / largest) if largest > 0.0 else 0.0,
        "open_drift_rad": float(np.abs(moved.error).max()),
        "kicked_speed_max": float(speeds.max()),
        "kicked_energy_growth": float(after.max() / after[0]),
        "kicked_energy_left": float(after[-1] / after[0]),
    }


def _references(runs: dict[str, RunSeries], motions: dict[str, Motion], by_joint: Any) -> dict[str, Any]:
    """Compare what the controllers were asked to follow, and say what the position control's delay costs."""
    series = runs[POSITION]
    description = series.run.robot.description
    swing = motions[gain_name(GAINS[0])]
    followed = series.trace.position_reference[in_span(series.trace.time_s, phase_span(series.run, SWING))]
    delay_s = description.period_s * (description.command_delay_cycles + 1)
    speed = np.abs(np.gradient(swing.desired, description.period_s, axis=0)).max(axis=0)
    others = [motion(runs[gain_name(g)], phase_span(series.run, SWING)).desired for g in GAINS[1:]]
    return {
        "reference_difference_rad": by_joint(np.abs(followed - swing.desired).max(axis=0)),
        "reference_agreement_rad": float(max(np.abs(other - swing.desired).max() for other in others)),
        "position_delay_error_rad": by_joint(delay_s * speed),
    }


def _near_limits(runs: dict[str, RunSeries], by_joint: Any) -> dict[str, Any]:
    """Say how much of its drives' limits the swing needs with K₆ = 1."""
    series = runs[gain_name(GAINS[0])]
    joints = series.run.robot.description.joints
    chosen = in_span(series.truth.time_s, phase_span(series.run, SWING))
    speed = np.abs(series.truth.velocity[chosen]).max(axis=0)
    torque = np.abs(series.truth.motor_torque_substeps[chosen]).max(axis=(0, 1))
    return {
        "velocity_share": by_joint(speed / np.array([joint.velocity_limit for joint in joints])),
        "torque_share": by_joint(torque / np.array([joint.torque_limit for joint in joints])),
    }
