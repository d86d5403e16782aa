"""Programs of several parts that take turns within each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from powderdsl.targets.job import Array, Job, Runnable


class MixedProgram:
    """Parts that take turns. The whole state is unpacked and packed again between them."""

    def __init__(self, parts: Sequence[Runnable]):
        self.parts = tuple(parts)

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        clock, state = job.clock, job.state
        for i in range(job.steps):
            for part in self.parts:
                state = part.run(
                    job._replace(state=state, clock=clock._replace(since=clock.since + i), steps=1)
                )
        return state
