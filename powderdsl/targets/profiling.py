"""Measures the time that each pass takes, for programs that can report it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import torch

from powderdsl.targets.job import Job


class PassClock:
    """A clock that is called with a name after each piece of work. Work before the first pass has the name ``""``."""

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
        # A GPU works asynchronously: without waiting, the time would count for a later pass.
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def no_clock(name: str) -> None:
    """Replaces `PassClock` where time is not measured."""


@runtime_checkable
class Profiled(Protocol):
    """A program that can report the time of its passes."""

    def profile(self, job: Job) -> Mapping[str, float]:
        """Seconds by pass over `job.steps`."""
        ...


def profile_of(program: object, job: Job) -> Mapping[str, float]:
    """Seconds by pass over `job.steps`; empty if a program cannot report them."""
    return program.profile(job) if isinstance(program, Profiled) else {}
