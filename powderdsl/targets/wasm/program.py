"""The backend `wasm`: a module in a host. Worlds stay packed between calls; arrays are made when they are read."""

from __future__ import annotations

from collections.abc import Mapping

from powderdsl.ir.ops import Program
from powderdsl.system.memo import Memo
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.targets.job import Job, shape_of
from powderdsl.targets.wasm.host import this_host
from powderdsl.targets.wasm.instances import Loaded, WasmState, digest_of


class WasmProgram:
    """A program as WebAssembly, run on one thread: a module for each width of grids.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
        kind: the arrays of its jobs.
        memo: where the schedules of passes are kept.
    """

    def __init__(self, program: Program, planes: Program, kind: ArrayKind, memo: Memo | None = None):
        self._program, self._planes, self._kind = program, planes, kind
        self._memo = Memo() if memo is None else memo  # the schedules are the same for all widths
        self._digest = digest_of(planes)
        self._host = this_host()
        self._modules: dict[int, Loaded] = {}

    def loaded(self, width: int) -> Loaded:
        """The module for a width."""
        if width not in self._modules:
            self._modules[width] = Loaded(
                self._host,
                self._kind,
                self._program,
                self._planes,
                width,
                self._digest,
                memo=self._memo,
            )
        return self._modules[width]

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        assert not job.draws
        assert job.passes is None
        state = job.state
        worlds, rows, width = shape_of(state)
        loaded = self.loaded(width)
        if isinstance(state, WasmState) and state.instance.loaded is loaded and job.reuse:
            instance = state.instance
        else:
            instance = loaded.instance(worlds, rows)
        if isinstance(state, WasmState) and state.instance is not instance:
            state = dict(state)
        with instance as call:
            if isinstance(state, WasmState):
                batch, like = state.take() if job.reuse else call("copy", state.batch), state.like
            else:
                batch, like = instance.pack(state)
            instance.run(batch, job, worlds)
        return WasmState(instance, batch, like)
