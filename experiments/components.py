"""Parts of the control, section 5.5 and Fig. 6 of [Del Prete 2016]: what each term of (13) and (14) adds to Δq.

The stairs-climbing swing with K₆ = 1 and 0.1, and the sinusoidal force, with motors identified on the same plant. The
terms are those that the controller logged: feed-forward torque and friction, feedback of position, velocity,
acceleration and force, and of the integral where K_i is not zero. They are measured over the swing, and over whole
periods of the sine, by root mean square and maximum; a term's share is its root mean square over the sum of all.

The paper's conclusions are the bars: friction's feed-forward contributes the most in motion, the torque's in force
control, on the joints of its figure. A bar's value is the term's root mean square over the largest other's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, OffsetSeries, RunSeries
from experiments.figures import components_figure, save
from experiments.hand_runs import load, perform, workplace
from experiments.leg_runs import identified_motors
from experiments.leg_signals import CONFIG, in_span, phase_span, rms, sine_spans
from schemas.fingerprint import fingerprint
from schemas.load import Run

STAIRS: Final = "leg6-stairs"
FORCE: Final = "leg6-force-sine"
SWING: Final = "swing"
CASES: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "motion_k6_1": (STAIRS, {f"{CONFIG}.position_gain": 1.0}),
    "motion_k6_0.1": (STAIRS, {f"{CONFIG}.position_gain": 0.1}),
    "force": (FORCE, {f"{CONFIG}.position_gain": 0.1, "plant.world.events": []}),
}
TERMS: Final = ("torque", "friction", "position", "velocity", "acceleration", "force", "integral")
"""Fields of `OffsetSeries`."""
LEADING: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "motion_k6_1": ("friction", ("R_HIP_P", "R_KNEE")),
    "motion_k6_0.1": ("friction", ("R_HIP_P", "R_KNEE")),
    "force": ("torque", ("R_KNEE",)),
}
"""What contributes the most in the paper's figure, and on which joints."""
OWN_FIELDS: Final = (
    *(f"{CONFIG}.{name}" for name in ("motors", "motors_from", "position_gain")),
    "controller.phases",
    "plant.world",
    "plant.initial_posture",
    "plant.truth_frames",
    "duration_s",
)
"""Two scenarios are run: what belongs to the motion of one is not for the other."""
FORCE_S: Final = 8.5
"""Length of the run with the sine: three whole periods."""


@dataclass(frozen=True, slots=True)
class Components:
    """Terms of Δq over the K cycles of a case that are judged, n joints."""

    time_s: Array
    terms: dict[str, Array]
    """(K, n) [rad] of each of `TERMS`, the integral where it acted."""

    @property
    def rms(self) -> dict[str, Array]:
        """(n,) [rad] of each."""
        return {name: rms(values) for name, values in self.terms.items()}


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed.

    Raises:
        UsageError: an override of what the experiment sets itself.
        RunStoppedError: the HAL stopped a run.
        ControllerError: a joint became too fast under torque control.
        IdentificationError: the motors cannot be identified.

    """
    scenario = load(request, STAIRS, OWN_FIELDS)
    with workplace(request) as directory:
        request.progress(0.0, "identifying the motors")
        motors = identified_motors(request, directory)
        cases: dict[str, Components] = {}
        for number, (name, (of, overrides)) in enumerate(CASES.items()):
            request.progress(0.6 + 0.4 * number / len(CASES), name)
            own = {f"{CONFIG}.motors": motors, **overrides}
            if of == FORCE:
                own["duration_s"] = FORCE_S
            cases[name] = components_of(perform(request, of, directory / name, own))
        if request.directory is not None:
            save(components_figure(cases, scenario.robot.description.joint_names), directory / "components")
    return evaluate(request, scenario, cases)


def components_of(series: RunSeries) -> Components:
    """Take the terms of what is judged out of a run: the swing, or whole periods of a sinusoidal force."""
    run_ = series.run
    names = [phase.name for phase in run_.scenario.controller.phases]
    span = phase_span(run_, SWING) if SWING in names else sine_spans(run_).before
    return judged(series.trace.time_s, series.trace.offset, span)


def judged(time_s: Array, offset: OffsetSeries, span: tuple[float, float]) -> Components:
    """Choose the cycles of a span (first and last time [s]) that were under torque control."""
    chosen = in_span(time_s, span) & np.isfinite(offset.torque).all(axis=1)
    terms = {name: np.asarray(getattr(offset, name)[chosen], np.float64) for name in TERMS}
    if not terms["integral"].any():
        del terms["integral"]
    return Components(time_s[chosen], terms)


def lead(components: Components, term: str, joint: int) -> float:
    """Root mean square of a term over the largest of the others."""
    of = {name: float(values[joint]) for name, values in components.rms.items()}
    return of.pop(term) / max(of.values())


def ranking(components: Components, joint: int) -> str:
    """Name the terms, the largest root mean square first, with their shares in percent; empty where there are none."""
    of = {name: float(values[joint]) for name, values in components.rms.items()}
    total = sum(of.values())
    if total == 0.0:
        return ""
    ordered = sorted(of, key=lambda name: -of[name])
    return ", ".join(f"{name} {100.0 * of[name] / total:.0f}" for name in ordered)


def evaluate(request: ExperimentRequest, scenario: Run, cases: dict[str, Components]) -> ExperimentResult:
    """Measure all cases."""
    names = scenario.robot.description.joint_names
    metrics: dict[str, Any] = {}
    bars = []
    for case, components in cases.items():
        total = np.sum([*components.rms.values()], axis=0)
        for term, values in components.terms.items():
            own = components.rms[term]
            largest = np.abs(values).max(axis=0)
            metrics[f"{case}_{term}_rms_rad"] = dict(zip(names, own.tolist(), strict=True))
            metrics[f"{case}_{term}_max_rad"] = dict(zip(names, largest.tolist(), strict=True))
            metrics[f"{case}_{term}_share"] = {
                name: float(one / all_) if all_ > 0.0 else 0.0
                for name, one, all_ in zip(names, own, total, strict=True)
            }
        metrics[f"{case}_ranking"] = {name: ranking(components, joint) for joint, name in enumerate(names)}
        term, joints = LEADING[case]
        for joint in joints:
            value = lead(components, term, names.index(joint))
            bars.append(Bar(f"{case}_{term}_lead_{joint}", value, 1.0, at_least=True))
    robot = scenario.robot.description.name
    return ExperimentResult("components", robot, request.seed, fingerprint(scenario), metrics, tuple(bars))
