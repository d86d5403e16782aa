"""A job: the argument of every program's `run`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from powderdsl.targets.profiling import PassClock

Clock = tuple[Tensor, Tensor, Tensor]
"""Seed, world index and step of each world: int64 [B]."""


@dataclass(frozen=True)
class Job:
    """Steps of a batch of worlds.

    `state` has one tensor per slot, in storage dtypes, and is not changed unless `reuse`. `params` are float64 [B];
    `draws`, int64 [B, H, W] below 2^bits, replace a stream's own numbers; `passes` names the passes to run, None for all.
    """

    state: Mapping[str, Tensor]
    clock: Clock
    steps: int
    params: Mapping[str, Tensor]
    draws: Mapping[str, Tensor]
    passes: frozenset[str] | None
    reuse: bool = False
    """Whether `state` may be overwritten because nothing reads it afterwards."""
    timing: PassClock | None = None
    """Measures the time of passes, in programs that can report it."""

    def tick(self, name: str) -> None:
        """Called by programs after each pass, and with ``""`` before the first one of a step."""
        if self.timing is not None:
            self.timing.tick(name)


class Runnable(Protocol):
    """A ruleset, or some of its passes, made executable."""

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        ...
