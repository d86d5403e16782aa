"""Programs of several parts that take turns within each step: bit planes where they can represent a pass, else torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import Segment, segments
from powderdsl.system.memory import collection_paused
from powderdsl.targets.job import Job, Runnable
from powderdsl.targets.torch.program import TorchProgram

MakePacked = Callable[[Program, Program], Runnable]
"""Makes a runnable part from a program on numbers and the same program on bit planes."""


class MixedProgram:
    """Parts that take turns. The whole state is unpacked and packed again between them."""

    def __init__(self, parts: Sequence[Runnable]):
        self.parts = tuple(parts)

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        clock, state = job.clock, job.state
        for i in range(job.steps):
            for part in self.parts:
                state = part.run(
                    job._replace(state=state, clock=clock._replace(since=clock.since + i), steps=1)
                )
        return state


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
