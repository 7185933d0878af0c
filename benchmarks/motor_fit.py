"""The motor fit of [Del Prete 2016] by Newton's method, on a synthetic joint."""

from __future__ import annotations

import numpy as np

from benchmarks.measure import Timing, measure
from controller_service.motor_fit import fit_asymmetric
from controller_service.motor_samples import MotorSamples

SAMPLES = 1_000_000
RUNS = 5


def motor_fit() -> Timing:
    """Fit k_τ and k_v to a million samples with w = 100."""
    generator = np.random.default_rng(0)
    torque, velocity = 40.0 * generator.standard_normal(SAMPLES), 2.0 * generator.standard_normal(SAMPLES)
    dry = 1e-3 * np.sign(velocity)
    offset = 5e-5 * torque + 1e-2 * velocity + dry + 1e-4 * generator.standard_normal(SAMPLES)
    samples = MotorSamples(offset, torque, velocity)
    return measure(f"motor fit, {SAMPLES:.0e} samples", lambda: fit_asymmetric(samples, joint="bench"), RUNS, warm_up=1)
