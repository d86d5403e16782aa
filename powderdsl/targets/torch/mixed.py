"""Programs of several parts that take turns within each step: bit planes where they can represent a pass, else torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import Segment, segments
from powderdsl.system.memory import collection_paused
from powderdsl.targets.job import Job, Runnable
from powderdsl.targets.profiling import profile_of
from powderdsl.targets.torch.program import TorchProgram

MakePacked = Callable[[Program, Program], Runnable]
"""Makes a runnable part from a program on numbers and the same program on bit planes."""


class MixedProgram:
    """Parts that take turns. The whole state is unpacked and packed again between them."""

    def __init__(self, parts: Sequence[Runnable]):
        self.parts = tuple(parts)

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        seed, index, start = job.clock
        state = job.state
        for i in range(job.steps):
            for part in self.parts:
                state = part.run(replace(job, state=state, clock=(seed, index, start + i), steps=1))
        return state

    def profile(self, job: Job) -> Mapping[str, float]:
        """Seconds by pass over `job.steps`; packing and unpacking between the parts is not counted."""
        seed, index, start = job.clock
        state = job.state
        seconds: dict[str, float] = {}
        for i in range(job.steps):
            for part in self.parts:
                turn = replace(job, state=state, clock=(seed, index, start + i), steps=1)
                for name, spent in profile_of(part, turn).items():
                    seconds[name] = seconds.get(name, 0.0) + spent
                state = part.run(turn)
        return seconds


@collection_paused()
def packed_program(program: Program, device: torch.device, make: MakePacked) -> Runnable:
    """A program on bit planes by `make`, except for passes that they cannot represent."""
    return mixed_program(segments(program), device, make)


def mixed_program(found: Sequence[Segment], device: torch.device, make: MakePacked) -> Runnable:
    """The program of some segments. A single segment needs no wrapper."""
    parts = [
        TorchProgram(one.program, device) if one.planes is None else make(one.program, one.planes)
        for one in found
    ]
    return parts[0] if len(parts) == 1 else MixedProgram(parts)
