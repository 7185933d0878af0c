"""Time a callable; sum up samples."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Figures:
    """What is reported of one stage [s]."""

    name: str
    count: int
    median_s: float
    p99_s: float
    p99_9_s: float

    def as_json(self) -> dict[str, float | int | str]:
        """Plain values."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Timing:
    """Wall-clock samples of one stage [s]."""

    name: str
    samples: npt.NDArray[np.float64]

    def figures(self) -> Figures:
        """Sum up."""
        median, p99, p99_9 = np.percentile(self.samples, (50.0, 99.0, 99.9)).tolist()
        return Figures(self.name, len(self.samples), median, p99, p99_9)


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
