"""Worlds and a simulator without torch: arrays of `powderdsl.arrays`, stepped by WebAssembly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from powderdsl.compiler import lower, parts
from powderdsl.ir.ops import Program
from powderdsl.model.state import property_dtype, slot_name
from powderdsl.model.types import Ruleset
from powderdsl.simulation.any_arrays import AnySimulator, AnyWorld
from powderdsl.simulation.reference_program import ReferenceProgram
from powderdsl.simulation.state_checks import unknown_slot
from powderdsl.system.memo import Memo, collection_paused
from powderdsl.targets.array_kind import Array, PlainArrays
from powderdsl.targets.job import Job, Runnable
from powderdsl.targets.mixed import MixedProgram
from powderdsl.targets.wasm.host import this_host
from powderdsl.targets.wasm.program import WasmProgram


class ArrayWorld(AnyWorld):
    """A batch of worlds of one ruleset, as arrays of `powderdsl.arrays`."""

    sim: ArraySimulator

    def read(self, name: str) -> Array:
        """`world[name]`. Raises KeyError."""
        sim, ruleset = self.sim, self.sim.ruleset
        name = slot_name(ruleset, name) if name not in self.state else name
        if name in self.state:
            return self.state[name]
        prop = ruleset.property(name)
        if prop is None:
            raise unknown_slot(ruleset, name)
        return sim.table(name)[self.ids].astype(property_dtype(prop))


class ArraySimulator(AnySimulator[ArrayWorld]):
    """Runs one ruleset without torch: the same worlds as `simulator.Simulator`, bit for bit.

    Args:
        backend: ``wasm`` or ``reference``.
        memo: where passes are kept that other rulesets may have, too.
    """

    world_type = ArrayWorld
    device = "cpu"
    notes: tuple[str, ...] = ()

    def __init__(self, ruleset: Ruleset, backend: str = "wasm", memo: Memo | None = None):
        super().__init__(ruleset, PlainArrays())
        self.backend = self.running = backend
        self._memo = Memo() if memo is None else memo
        oracle = backend == "reference"
        self._program = ReferenceProgram(ruleset, self.kind) if oracle else WholeOrParts(ruleset, self._memo)

    def of(self, ruleset: Ruleset) -> ArraySimulator:
        return ArraySimulator(ruleset, self.backend, self._memo)


def wasm_problem() -> str:
    """Why no WebAssembly runs in this process; empty if it does."""
    try:
        this_host()
    except (ImportError, OSError, RuntimeError) as error:  # wasmtime can be installed where it does not run
        return " ".join(str(error).split())[:200] or type(error).__name__
    return ""


class WholeOrParts:
    """WebAssembly for whole steps and for chosen passes; the oracle for given draws and for what fits no bit planes."""

    def __init__(self, ruleset: Ruleset, memo: Memo):
        self._ruleset, self._kind, self._memo = ruleset, PlainArrays(), memo
        self._lowered = lower(ruleset, memo)  # what cannot be lowered is reported before the first step
        self._oracle = ReferenceProgram(ruleset, self._kind)
        self._made: dict[frozenset[str] | None, Runnable] = {}

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        if job.draws:
            return self._oracle.run(job)
        chosen = job.passes
        if chosen not in self._made:
            self._made[chosen] = self._make(chosen)
        return self._made[chosen].run(job if chosen is None else job._replace(passes=None))

    @collection_paused()
    def _make(self, chosen: frozenset[str] | None) -> Runnable:
        program = self._lowered
        if chosen is not None:
            program = replace(program, passes=tuple(one for one in program.passes if one.name in chosen))
        programs: list[Runnable] = []
        for segment in parts(program, self._memo):
            if segment.planes is not None:
                programs.append(WasmProgram(segment.program, segment.planes, self._kind, self._memo))
            else:
                programs.append(OracleOfPasses(self._ruleset, segment.program, first=not programs))
        return programs[0] if len(programs) == 1 else MixedProgram(programs)


class OracleOfPasses:
    """Some passes in a row, run by the oracle. Only the first ones of a step restart the fields that restart."""

    def __init__(self, ruleset: Ruleset, program: Program, *, first: bool):
        if not first:
            ruleset = replace(ruleset, fields=tuple(replace(one, resets=False) for one in ruleset.fields))
        self._oracle = ReferenceProgram(ruleset, PlainArrays())
        self._passes = frozenset(one.name for one in program.passes)

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        return self._oracle.run(job._replace(passes=self._passes))
