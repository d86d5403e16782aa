"""Time by name, for programs that say what each of their passes costs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import torch

from powderdsl.targets.job import Job


class Laps:
    """A clock that is called after each piece of work with its name. What comes before a pass goes under ``""``."""

    def __init__(self, device: torch.device):
        self._device = device
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._last = self._now()

    def __call__(self, name: str) -> None:
        now = self._now()
        self._seconds[name] += now - self._last
        self._last = now

    def passes(self) -> dict[str, float]:
        """Seconds by pass."""
        return {name: seconds for name, seconds in self._seconds.items() if name}

    def _now(self) -> float:
        # Work on a GPU is only handed in, so the time would be somebody else's.
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def unwatched(name: str) -> None:
    """In place of `Laps` where nobody asks."""


@runtime_checkable
class Profiled(Protocol):
    """A program that can say what its passes cost."""

    def profile(self, job: Job) -> Mapping[str, float]:
        """Seconds by pass over `job.steps`."""
        ...


def profile_of(program: object, job: Job) -> Mapping[str, float]:
    """Seconds by pass over `job.steps`; nothing from a program that cannot say."""
    return program.profile(job) if isinstance(program, Profiled) else {}
