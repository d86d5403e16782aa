"""Programs of several parts that take turns within each step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import Segment
from powderdsl.targets.array_kind import Array
from powderdsl.targets.job import Job, Runnable


class MixedProgram:
    """Parts that take turns. The whole state is unpacked and packed again between them."""

    def __init__(self, parts: Sequence[Runnable]):
        self.parts = parts

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        clock, state = job.clock, job.state
        for i in range(job.steps):
            for part in self.parts:
                state = part.run(
                    job._replace(state=state, clock=clock._replace(since=clock.since + i), steps=1)
                )
        return state


def mixed_program(
    segments: Sequence[Segment],
    packed: Callable[[Program, Program], Runnable],
    cells: Callable[[Program], Runnable],
) -> Runnable:
    """The program of some segments. A single one needs no wrapper.

    Args:
        packed: makes the program of a segment from its numeric program and the same on bit planes.
        cells: makes that of a segment which bit planes cannot represent.
    """
    parts = [
        cells(segment.program) if segment.planes is None else packed(segment.program, segment.planes)
        for segment in segments
    ]
    return parts[0] if len(parts) == 1 else MixedProgram(parts)
