"""Force control, section 5.4 and Fig. 5 of [Del Prete 2016]: a sinusoidal vertical force of the foot on a rigid block.

All other components of the wrench are to be zero. The same run is made with the force's feedback and without (K_p and
K_f zero), where feed-forward and K₆ act alone. Motors are those identified on the same plant.

All forces are the plant's: of the block on the foot, moments about the hand frame's origin, smoothed by the mean over
the paper's filter window about each sample, without its delay (`leg_signals.WINDOW`); `raw` marks what is not smoothed.
The sine is judged over whole periods before the foot is lifted off the block:

    overshoot   largest F_z beyond the reference's apex, or below its trough, over the amplitude
    coupling    largest |F_x| or |F_y| over the amplitude
    lag         of F_z by the best-fitting shift; negative is ahead
    cop         largest |M_y|/F_z or |M_x|/F_z: how far the pressure's centre is from below the origin

Then somebody lifts the foot and lets go. Force control does not stop for this: the leg follows its force reference in
the air against its position feedback, and lands where it comes down, some centimetres off: friction of the block keeps
it there, so that the position feedback has another share of the force from then on. That is an offset
(`error_ratio_after_landing`, `coupling_after_landing` tell it) and no instability. Stable is a force that swings about
offset and fundamental by no more than before, without leaving the block, in the last whole period after the landing;
and a first period whose error is that of all. Without feedback the force stays where stiction holds it, before and
after with other plateaus: its swing is told and not judged.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deploy.errors import UsageError
from deploy.experiment import Bar, ExperimentRequest, ExperimentResult
from deploy.series import Array, stretches
from experiments.figures import force_sine_figure, save
from experiments.hand_runs import end_of, event_of, load, perform, settling_time, workplace
from experiments.leg_runs import identified_motors
from experiments.leg_signals import (
    CONFIG,
    Contact,
    Mask,
    SineSpans,
    best_shift,
    contact,
    in_span,
    phase_span,
    rms,
    sine_spans,
    wrench_phase,
)
from schemas.fingerprint import fingerprint
from schemas.load import Run

SCENARIO: Final = "leg6-force-sine"
EVENT: Final = "lifted"
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "with": {},
    "without": {f"{CONFIG}.torque_gain": 0.0, f"{CONFIG}.force_gain": 0.0, f"{CONFIG}.torque_integral": 0.0},
}
OWN_FIELDS: Final = (f"{CONFIG}.motors", f"{CONFIG}.motors_from")
OWN_WHOLE: Final = tuple(VARIANTS["without"])
OVERSHOOT: Final = 0.10
COUPLING: Final = 0.10
COUPLING_AIM: Final = 0.05
AMPLITUDE_RATIO: Final = 0.8
"""Of the force's fundamental: a force that hardly follows has no overshoot either."""
ERROR_RATIO: Final = 1.5
"""Of the force's swing after and before the event, and of the errors of the first period and all."""
LEAST_SWING_N: Final = 1.0
"""A force that swings by less than this before the event counts as one that swings by this."""
SETTLED: Final = 0.3
"""Of the amplitude: the smoothed force is settled when it stays this near its reference."""
GAP_S: Final = 0.005
"""A rebound has no contact for longer than this."""
SHIFT_S: Final = 0.25
"""Largest lag that is looked for."""


def run(request: ExperimentRequest) -> ExperimentResult:
    """Run the experiment for one seed, with and without force feedback.

    Raises:
        UsageError: an override of what the experiment sets itself, or takes away what it needs.
        RunStoppedError: the HAL stopped a run.
        ControllerError: a joint became too fast under torque control.
        IdentificationError: the motors cannot be identified.

    """
    scenario = load(request, SCENARIO, OWN_FIELDS, own_whole=OWN_WHOLE)
    spans = sine_spans(scenario, EVENT)
    phase_span(scenario, wrench_phase(scenario)[0].name)
    if not scenario.scenario.plant.world.obstacles:
        raise UsageError("plant.world.obstacles: none; the experiment needs the block that the foot presses on")
    with workplace(request) as directory:
        request.progress(0.0, "identifying the motors")
        motors = identified_motors(request, directory)
        contacts: dict[str, Contact] = {}
        for number, (name, overrides) in enumerate(VARIANTS.items()):
            request.progress(0.5 + 0.25 * number, f"{name} force feedback")
            series = perform(request, SCENARIO, directory / name, {f"{CONFIG}.motors": motors, **overrides})
            contacts[name] = contact(series)
        if request.directory is not None:
            save(force_sine_figure(contacts, scenario, spans), directory / "force-sine")
    return evaluate(request, scenario, contacts, spans)


def evaluate(
    request: ExperimentRequest, scenario: Run, contacts: dict[str, Contact], spans: SineSpans
) -> ExperimentResult:
    """Measure both runs."""
    metrics: dict[str, Any] = {}
    for name, force in contacts.items():
        of = {**sine(scenario, force, spans), **event(scenario, force, spans)}
        metrics |= {f"{name}_{key}": value for key, value in of.items()}
    metrics["coupling_aim_reached"] = metrics["with_coupling"] <= COUPLING_AIM
    bars = (
        Bar("with_overshoot", metrics["with_overshoot"], OVERSHOOT),
        Bar("with_coupling", metrics["with_coupling"], COUPLING),
        Bar("with_amplitude_ratio", metrics["with_amplitude_ratio"], AMPLITUDE_RATIO, at_least=True),
        Bar("with_error_ratio_first_touch", metrics["with_error_ratio_first_touch"], ERROR_RATIO),
        Bar("with_swing_ratio_after_landing", metrics["with_swing_ratio_after_landing"], ERROR_RATIO),
        *(
            Bar(f"{name}_airborne_after_landing_s", metrics[f"{name}_airborne_after_landing_s"], 0.0)
            for name in VARIANTS
        ),
    )
    robot = scenario.robot.description.name
    return ExperimentResult("force-sine", robot, request.seed, fingerprint(scenario), metrics, bars)


def sine(scenario: Run, force: Contact, spans: SineSpans) -> dict[str, Any]:
    """Measure how the sine is followed, over whole periods before the event."""
    amplitude, mean = _vertical(scenario)
    chosen = in_span(force.time_s, spans.before)
    first = in_span(force.time_s, (spans.before[0], spans.before[0] + spans.period_s))
    smooth, raw, reference = force.smooth[chosen], force.raw[chosen], force.reference[chosen]
    error = smooth[:, 2] - reference[:, 2]
    lowest, highest = mean - amplitude, mean + amplitude
    over = (smooth[:, 2].max() - highest) / amplitude
    under = (lowest - smooth[:, 2].min()) / amplitude
    sideways, sideways_raw = np.abs(smooth[:, :2]).max(axis=0), np.abs(raw[:, :2]).max(axis=0)
    pressure = np.maximum(smooth[:, 2], 1e-9)
    rms_error = float(rms(error))
    of_first = float(rms(force.smooth[first, 2] - force.reference[first, 2]))
    return {
        "periods": round((spans.before[1] - spans.before[0]) / spans.period_s),
        "overshoot": float(max(over, under)),
        "overshoot_apex": float(over),
        "overshoot_trough": float(under),
        "overshoot_raw": float(max(raw[:, 2].max() - highest, lowest - raw[:, 2].min()) / amplitude),
        "coupling": float(sideways.max() / amplitude),
        "coupling_x": float(sideways[0] / amplitude),
        "coupling_y": float(sideways[1] / amplitude),
        "coupling_raw": float(sideways_raw.max() / amplitude),
        "moment_max_nm": {
            axis: float(value) for axis, value in zip("xyz", np.abs(smooth[:, 3:]).max(axis=0), strict=True)
        },
        "cop_shift_max_m": float((np.abs(smooth[:, 3:5]).max(axis=1) / pressure).max()),
        "lag_s": _lag(force, scenario, spans),
        "amplitude_ratio": harmonic(smooth[:, 2], spans.period_s, scenario) / amplitude,
        "rms_error_ratio": rms_error / amplitude,
        "max_error_ratio": float(np.abs(error).max() / amplitude),
        "error_ratio_first_touch": of_first / rms_error,
    }


def event(scenario: Run, force: Contact, spans: SineSpans) -> dict[str, Any]:
    """Measure what happens when the foot is lifted off and lands.

    Returns:
        `airborne_s`: time without contact from the event's start to the end of the sine.
        `rebounds`: flights longer than `GAP_S` after the first one.
        `landing_force_max_n`: the largest raw force after the event's end, `landing_force_ratio` over the apex.
        `settling_s`: from the event's end until the smoothed force stays near its reference; NaN: never.
        `swing_ratio_after_landing`: what F_z swings about its mean and fundamental in the last whole period, root mean
            square, over that in the last one before the event; raw forces, so that nothing is smoothed away.
        `airborne_after_landing_s`: time without contact in that period.
        `error_ratio_after_landing`: error of the last whole period over that before the event.
        `coupling_after_landing`: of the last whole period.

    """
    assert spans.after is not None
    lifted = event_of(scenario, EVENT)
    amplitude, mean = _vertical(scenario)
    period_s = scenario.robot.description.period_s
    errors = np.abs(force.smooth[:, 2] - force.reference[:, 2])
    rest = in_span(force.time_s, (lifted.start_s, spans.after[1]))
    touching = np.abs(force.raw[rest]).max(axis=1) > 0.0
    landed = in_span(force.time_s, (end_of(lifted), spans.after[1]))
    last, before = in_span(force.time_s, spans.after), in_span(force.time_s, spans.before)
    recent = in_span(force.time_s, (spans.before[1] - spans.period_s, spans.before[1]))
    swings = [swing(force.raw[chosen, 2], spans.period_s, period_s) for chosen in (last, recent)]
    largest = float(np.linalg.norm(force.raw[landed, :3], axis=1).max())
    return {
        "airborne_s": float(np.count_nonzero(~touching) * period_s),
        "rebounds": max(0, flights(touching, period_s) - 1),
        "landing_force_max_n": largest,
        "landing_force_ratio": largest / (mean + amplitude),
        "settling_s": settling_time(
            force.time_s[: int(np.flatnonzero(rest)[-1]) + 1],
            errors[: int(np.flatnonzero(rest)[-1]) + 1],
            end_of(lifted),
            SETTLED * amplitude,
        ),
        "swing_before_n": swings[1],
        "swing_after_landing_n": swings[0],
        "swing_ratio_after_landing": swings[0] / max(swings[1], LEAST_SWING_N),
        "airborne_after_landing_s": float(np.count_nonzero(~force.raw[last].any(axis=1)) * period_s),
        "error_ratio_after_landing": float(rms(errors[last]) / rms(errors[before])),
        "coupling_after_landing": float(np.abs(force.smooth[last, :2]).max() / amplitude),
    }


def flights(touching: Mask, period_s: float) -> int:
    """Count the stretches without contact that are longer than `GAP_S`, in (K,) cycles."""
    return sum((last - first) * period_s > GAP_S for first, last in stretches(~touching))


def swing(signal: Array, period_s: float, step_s: float) -> float:
    """Root mean square of a signal (K,) without its mean and fundamental, over a whole period."""
    phase = 2.0 * np.pi * np.arange(len(signal)) * step_s / period_s
    basis = np.column_stack((np.ones_like(phase), np.cos(phase), np.sin(phase)))
    fitted = basis @ np.linalg.lstsq(basis, signal, rcond=None)[0]
    return float(rms(signal - fitted))


def harmonic(signal: Array, period_s: float, scenario: Run) -> float:
    """Amplitude of a signal (K,) at a period, over whole periods of it."""
    phase = 2.0 * np.pi * np.arange(len(signal)) * scenario.robot.description.period_s / period_s
    return float(2.0 * np.abs(np.mean(signal * np.exp(-1j * phase))))


def _lag(force: Contact, scenario: Run, spans: SineSpans) -> float:
    chosen = in_span(force.time_s, spans.before)
    period_s = scenario.robot.description.period_s
    return best_shift(force.smooth[chosen, 2:3], force.reference[chosen, 2:3], period_s, SHIFT_S)


def _vertical(scenario: Run) -> tuple[float, float]:
    """Amplitude and mean [N] of the vertical force."""
    wrench = wrench_phase(scenario)[1]
    return wrench.amplitude[2], wrench.mean[2]
