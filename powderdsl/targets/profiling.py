"""Measures the time that each pass takes, for programs that can report it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from powderdsl.targets.job import Job, Runnable


class PassClock:
    """Seconds by pass. Work before the first pass has the name ``""``."""

    def __init__(self, device: Any = None):
        """`device`: that of the arrays, if they have one."""
        self._device = device
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._last = self._now()

    def tick(self, name: str) -> None:
        """Count the time since the last call for a pass."""
        now = self._now()
        self._seconds[name] += now - self._last
        self._last = now

    def add(self, name: str, seconds: float) -> None:
        """Count time that a program measured itself."""
        self._seconds[name] += seconds

    def passes(self) -> dict[str, float]:
        """Seconds by pass."""
        return {name: seconds for name, seconds in self._seconds.items() if name}

    def _now(self) -> float:
        # A GPU works asynchronously: without waiting, the time would count for a later pass.
        if getattr(self._device, "type", "") == "cuda":
            import torch

            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def profile_of(program: Runnable, job: Job) -> Mapping[str, float]:
    """Seconds by pass over `job.steps`; empty if a program cannot report them."""
    clock = PassClock(getattr(job.clock.seed, "device", None))
    program.run(job._replace(timing=clock))
    return clock.passes()
