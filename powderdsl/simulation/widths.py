"""Native code by the width of grids: each width has a library of its own, or shares one with others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

from torch import Tensor

from powderdsl.targets.cpp.build import building, current
from powderdsl.targets.cpp.source import known_width
from powderdsl.targets.job import Job, Runnable, shape_of

Program_ = TypeVar("Program_", bound=Runnable)


class ByWidth(Generic[Program_]):
    """A program for each known width of grids, and one for all others (`known_width`), made when the first such grid comes.

    It is built with the settings that are in effect now.
    """

    def __init__(self, make: Callable[[int], Program_]):
        self._make, self._how = make, current()
        self._made: dict[int, Program_] = {}

    def of(self, width: int) -> Program_:
        """The program for a known width; 0 for all others."""
        made = self._made.get(width)
        if made is None:
            with building(self._how):
                made = self._made.setdefault(width, self._make(width))
        return made

    def for_job(self, job: Job) -> Program_:
        """The program that runs a job."""
        return self.of(known_width(shape_of(job.state)[-1]))

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        return self.for_job(job).run(job)
