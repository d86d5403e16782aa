"""What programs are given and what they are: jobs, clocks, runnables, and the time that each pass takes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from powderdsl.diagnostics import CompileError
from powderdsl.system.writing import failure
from powderdsl.targets.array_kind import Array


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


class Clock(NamedTuple):
    """Seed and world index of each world, int64 [B], and its step: `since` steps after `start`, int64 [B].

    Whoever needs the sum computes it: a step of one small world takes no longer than a few operations of torch.
    """

    seed: Array
    world: Array
    start: Array
    since: int = 0

    @property
    def step(self) -> Array:
        """The step of each world: int64 [B]."""
        return self.start + self.since if self.since else self.start


def shape_of(state: Mapping[str, Array]) -> tuple[int, int, int]:
    """(worlds, rows, columns) of a state, without unpacking anything."""
    like = getattr(state, "like", None)  # what packed states know of their tensors
    batch, height, width = state["element"].shape if like is None else like["element"][1]
    return batch, height, width


class Job(NamedTuple):  # made faster than a frozen dataclass, at each call
    """Steps of a batch of worlds.

    `state` has one array per slot, in storage dtypes, and is not changed unless `reuse`. `params` are float64 [B], in a
    mapping that nobody changes: programs recognize it. `draws`, int64 [B, H, W] below 2^bits, replace a stream's own
    numbers; `passes` names the passes to run, None for all.
    """

    state: Mapping[str, Array]
    clock: Clock
    steps: int
    params: Mapping[str, Array]
    draws: Mapping[str, Array]
    passes: frozenset[str] | None
    reuse: bool = False
    """Whether `state` may be overwritten because nothing reads it afterwards."""
    timing: PassClock | None = None
    """Measures the time of passes, in programs that can report it."""

    def tick(self, name: str) -> None:
        """Called by programs after each pass, and with ``""`` before the first one of a step."""
        if self.timing is not None:
            self.timing.tick(name)


def unavailable(backend: str, problem: str, help: str) -> CompileError:
    """The error (PD701) for a backend that does not run here."""
    notes = tuple(problem.splitlines())
    return failure("PD701", f"the {backend} backend is not available", notes=notes, helps=(help,))


class Runnable(Protocol):
    """A ruleset, or some of its passes, made executable."""

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        ...
