"""The backend `wasm`: modules in a host, and batches of worlds in their memory.

Worlds stay packed between calls; arrays are made when they are read.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from math import prod
from threading import RLock

from powderdsl.ir.ops import Program
from powderdsl.ir.text import structure
from powderdsl.system.cache import Memo, persistent
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.targets.job import Job, Like, OwnedBatch, like_of, shape_of
from powderdsl.targets.layout import layout_of, pieces
from powderdsl.targets.wasm.host import GROUPS, HEADER, Compiled, aligned, numbers_of, this_host

ROOM = 1 << 30
"""Bytes of memory beyond which an instance takes no new batches. Its batches need the rest for steps and reads."""

_MODULES = Memo(versions=1, things=64)
"""The compiled modules of this process: tests, tasks and environments reuse rules and widths."""


class WasmProgram:
    """A program as WebAssembly, run on one thread: a module for each width of grids; those below a word share one, except 32.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
        kind: the arrays of its jobs.
        memo: stores schedules of passes.
    """

    def __init__(self, program: Program, planes: Program, kind: ArrayKind, memo: Memo | None = None):
        self.kind, self.pieces, self.planes = kind, pieces(program), planes
        self.layout, self._compile = layout_of(planes), this_host()
        self._memo = Memo() if memo is None else memo  # the schedules are the same for all widths
        passes = tuple(structure(pass_, places=False) for pass_ in planes.passes)
        self._digest = planes.slots, planes.params, planes.streams, passes
        self._instances: dict[tuple[int, int, bool], Instance] = {}

    def module(self, width: int) -> Compiled:
        """The module for a width. Many small widths share one: tests and examples run too briefly to justify their own."""
        fixed = width if width == 32 or width >= 64 else None

        def code() -> bytes:
            from powderdsl.targets.wasm.source import wasm_module

            return wasm_module(self.planes, fixed, memo=self._memo).code

        def make() -> Compiled:
            name = f"WebAssembly of width {fixed}" if fixed else "WebAssembly of narrow grids"
            return self._compile(persistent(name, repr((self._digest, fixed)), code))

        return _MODULES.of((self._digest, fixed), "", make)

    def instance(self, worlds: int, rows: int, width: int) -> Instance:
        """The instance for new batches of a shape: a new instance when the memory of the last one is full."""
        key = (rows, width, worlds == 1)  # with one world, lanes may be strips
        instance = self._instances.get(key)
        if instance is None or instance.running.memory_size() > ROOM:
            instance = self._instances[key] = Instance(self, width)
        return instance

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        state = job.state
        shape = shape_of(state)
        if isinstance(state, WasmState) and state.instance.program is self and job.reuse:
            instance = state.instance
        else:
            instance = self.instance(*shape)
        if isinstance(state, WasmState) and state.instance is not instance:
            state = dict(state)
        with instance:
            if isinstance(state, WasmState):
                batch = state.take() if job.reuse else instance.copy(state)
            else:
                batch = instance.pack(state)
            instance.run(batch, job, shape[0])
        return WasmState(instance, batch, like_of(state))


class Instance:
    """An instance of a module, for one number of rows. As a context manager, it lets one thread call functions.

    Its memory is freed when no batch in it is used any more.
    """

    def __init__(self, program: WasmProgram, width: int):
        self.program, self.kind, self.layout = program, program.kind, program.layout
        self.width, self.running = width, program.module(width)()
        self.call = self.running.call
        self.gone: list[tuple[int, int]] = []
        """Unused batches, with their numbers of worlds."""
        self._free: defaultdict[int, list[int]] = defaultdict(list)
        """Batches to reuse, by number of worlds."""
        self._lock = RLock()
        self._inputs: tuple[Mapping[str, Array], int, bytes] | None = None
        """The last parameters, the number of worlds, and the parameters as bytes of the module."""

    def __enter__(self) -> Callable[..., int]:
        self._lock.acquire()
        while self.gone:
            worlds, batch = self.gone.pop()
            self.call("release", batch)
            self._free[worlds].append(batch)
        return self.call

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def transfers(
        self, name: str, size: int, shape: tuple[int, ...], at: int
    ) -> Iterator[tuple[int, int, int, int, int, int]]:
        """The arguments of `load` and `store`, after the batch, for each piece of an array of cells of `size` bytes."""
        plane = shape[-2] * shape[-1] * size
        for piece in self.program.pieces[name]:
            first, apart = (0, 1) if piece.component is None else (piece.component, 2)
            yield *numbers_of(piece, self.layout, size), at + first * plane, apart * plane

    def new(self, state: Mapping[str, Array]) -> int:
        """A batch of zeros of a state's shape."""
        worlds, rows, _ = shape_of(state)
        free = self._free[worlds]
        return free.pop() if free else self.call("allocate", worlds, rows, self.width)

    def copy(self, state: WasmState) -> int:
        batch = self.new(state)
        self.call("copy", state.handle, batch)
        return batch

    def pack(self, state: Mapping[str, Array]) -> int:
        batch = self.new(state)
        for name, array in state.items():
            value = self.kind.contiguous(array)
            if self.kind.holds_any(value):  # a new batch holds zeros
                data = self.kind.bytes_of(value)
                at = self.call("scratch", len(data))
                self.running.write(at, data)
                for numbers in self.transfers(name, value.dtype.itemsize, value.shape, at):
                    self.call("load", batch, *numbers)
        return batch

    def read(self, batch: int, name: str, like: Like) -> Array:
        """One slot as a new array of its storage dtype."""
        dtype, shape = like[name]
        size = prod(shape) * dtype.itemsize
        with self as call:
            at = call("scratch", size)
            for numbers in self.transfers(name, dtype.itemsize, shape, at):
                call("store", batch, *numbers)
            return self.kind.from_bytes(self.running.read(at, size), dtype, shape)

    def input_bytes(self, params: Mapping[str, Array], worlds: int) -> bytes:
        """The bytes after the clocks: bits of parameters, and their values at a multiple of 16 bytes."""
        layout = self.layout
        bits, reals = layout.parameters(self.kind.xp, params, worlds)
        head = bytes(self.kind.bytes_of(bits))[: worlds * len(layout.param_planes)]
        values = bytes(self.kind.bytes_of(reals))[: 4 * worlds * len(layout.param_reals)]
        return bytes(-24 * worlds & 15) + head.ljust(aligned(len(head)), b"\0") + values

    def run(self, batch: int, job: Job, worlds: int) -> None:
        """Run a batch, and measure the time of passes if the job asks for it."""
        if self._inputs is None or self._inputs[0] is not job.params or self._inputs[1] != worlds:
            self._inputs = (job.params, worlds, self.input_bytes(job.params, worlds))
        clocks = [self.kind.contiguous(clock) for clock in (job.clock.seed, job.clock.world, job.clock.step)]
        self.running.write(batch + HEADER, b"".join((*map(self.kind.bytes_of, clocks), self._inputs[2])))
        if job.timing is None:
            self.call("run", batch, job.steps)
            return
        groups = int.from_bytes(self.running.read(batch + GROUPS, 4), "little")
        for group in range(groups):
            self.call("enter", batch, group)
            for step in range(job.steps):
                self.call("begin", batch, group, step)
                for number, pass_ in enumerate(self.program.planes.passes):
                    before = time.perf_counter()
                    self.call(str(number))
                    job.timing.add(pass_.name, time.perf_counter() - before)


class WasmState(OwnedBatch):
    """A batch's state in the memory of an instance."""

    def __init__(self, instance: Instance, handle: int, like: Like):
        self.instance = instance
        super().__init__(handle, like)

    def release(self, handle: int) -> None:
        # The garbage collector may run during a call, in this or another thread, so the next call releases the batch.
        self.instance.gone.append((shape_of(self)[0], handle))

    def __copy__(self) -> WasmState:
        with self.instance:
            return WasmState(self.instance, self.instance.copy(self), self.like)

    def unpack(self, name: str) -> Array:
        return self.instance.read(self.handle, name, self.like)
