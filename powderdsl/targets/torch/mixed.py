"""Programs on bit planes where they can represent a pass, and on torch tensors elsewhere."""

from __future__ import annotations

from collections.abc import Callable

import torch

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import segments
from powderdsl.system.memo import collection_paused
from powderdsl.targets.job import Runnable
from powderdsl.targets.mixed import mixed_program
from powderdsl.targets.torch.program import TorchProgram


@collection_paused()
def packed_program(
    program: Program, device: torch.device, make: Callable[[Program, Program], Runnable]
) -> Runnable:
    """A program on bit planes, see `mixed_program`; passes that they cannot represent run on torch tensors."""
    return mixed_program(segments(program), make, lambda cells: TorchProgram(cells, device))
