"""Time a callable; sum up samples."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Timing:
    """Wall-clock samples of one stage [s]."""

    name: str
    samples: npt.NDArray[np.float64]

    def percentile(self, q: float) -> float:
        """Percentile [s]; 50 is the median."""
        return float(np.percentile(self.samples, q))

    def as_json(self) -> dict[str, float | int | str]:
        """Plain values."""
        return {
            "name": self.name,
            "count": len(self.samples),
            "median_s": self.percentile(50.0),
            "p99_s": self.percentile(99.0),
            "p99_9_s": self.percentile(99.9),
        }


def measure(name: str, call: Callable[[], object], n: int, warm_up: int = 20) -> Timing:
    """Time n calls after some that do not count."""
    for _ in range(warm_up):
        call()
    samples = np.empty(n)
    for i in range(n):
        begun = time.perf_counter()
        call()
        samples[i] = time.perf_counter() - begun
    return Timing(name, samples)


class Stopwatch:
    """Replaces a method of one object by itself with a clock around it."""

    def __init__(self, name: str, owner: object, method: str) -> None:
        self.name = name
        self._samples: list[float] = []
        original: Callable[..., Any] = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            begun = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                self._samples.append(time.perf_counter() - begun)

        setattr(owner, method, timed)

    def clear(self) -> None:
        """Forget the warm-up."""
        self._samples.clear()

    def timing(self) -> Timing:
        """Sum up what was sampled."""
        return Timing(self.name, np.array(self._samples))
