"""The oracle behind the signature of all programs."""

from __future__ import annotations

from collections.abc import Mapping

from powderdsl.model import reference
from powderdsl.model.types import Ruleset
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.targets.job import Job


class ReferenceProgram:
    """Runs the rules on arrays of `powderdsl.arrays`, whatever kind those of its jobs are of."""

    def __init__(self, ruleset: Ruleset, kind: ArrayKind):
        self.ruleset, self.kind = ruleset, kind
        self._bits = {stream.name: stream.bits for stream in ruleset.streams}

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later. The time before a step's first pass counts for that pass."""
        host = self.kind.to_numpy
        seed, index, start = map(host, (*job.clock[:2], job.clock.step))
        arrays = {name: host(value) for name, value in job.state.items()}
        given_params = {name: host(value) for name, value in job.params.items()}
        numbers = reference.parameters(self.ruleset, len(seed), given_params)
        given = {name: (host(value) + 0.5) / 2.0 ** self._bits[name] for name, value in job.draws.items()}
        for i in range(job.steps):
            at = reference.Clock(seed, index, start + i)
            job.tick("")
            arrays = reference.step(
                self.ruleset, arrays, at, numbers, passes=job.passes, draws=given, tick=job.tick
            )
        return {name: self.kind.from_numpy(value.copy()) for name, value in arrays.items()}
