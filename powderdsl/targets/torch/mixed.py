"""Programs on bit planes where they can represent a pass, and on torch tensors elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import Segment, segments
from powderdsl.system.memo import collection_paused
from powderdsl.targets.job import Runnable
from powderdsl.targets.mixed import MixedProgram
from powderdsl.targets.torch.program import TorchProgram

MakePacked = Callable[[Program, Program], Runnable]
"""Makes a runnable part from a program on numbers and the same program on bit planes."""


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
