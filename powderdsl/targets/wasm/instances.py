"""Modules in a host, and batches of worlds in their memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from math import prod
from threading import RLock
from typing import Any

from powderdsl.ir.ops import Program
from powderdsl.ir.text import structure
from powderdsl.system.memo import Memo
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.targets.codec import parameters, pieces
from powderdsl.targets.job import Job, PassClock
from powderdsl.targets.layout import Layout
from powderdsl.targets.wasm.host import Host
from powderdsl.targets.wasm.source import wasm_module

ROOM = 1 << 30
"""Bytes of memory from which an instance takes no new batches. What it has can be stepped and read: there is as much again."""

_MODULES = Memo(versions=1, things=64)
"""The compiled modules of this process: tests, tasks and environments run the same rules on the same widths again."""

Like = Mapping[str, tuple[Any, tuple[int, ...]]]
"""The dtype and shape of each array of a state."""


def digest_of(planes: Program) -> Hashable:
    """A value that is equal for two programs only if their modules are the same."""
    passes = tuple(structure(one, places=False) for one in planes.passes)
    return planes.slots, planes.params, planes.streams, passes


class Loaded:
    """A module for grids of one width, ready to be instantiated, and its numbers."""

    def __init__(
        self,
        host: Host,
        kind: ArrayKind,
        program: Program,
        planes: Program,
        width: int,
        digest: Hashable,
        *,
        memo: Memo | None = None,
    ):
        def make() -> tuple[Any, Layout]:
            made = wasm_module(planes, width, memo=memo)
            return host.compile(made.code), made.layout

        self.module, self.layout = _MODULES.of((host, digest, width), "", make)
        self.host, self.kind, self.pieces = host, kind, pieces(program)
        self.passes = tuple(one.name for one in planes.passes)
        self._instances: dict[tuple[int, bool], Instance] = {}

    def instance(self, worlds: int, rows: int) -> Instance:
        """The instance for new batches of a shape: another one when the memory of the last is full.

        Whether lanes are strips depends on the rows and on whether there is one world.
        """
        key = (rows, worlds == 1)
        found = self._instances.get(key)
        if found is None or found.running.memory_size() > ROOM:
            found = self._instances[key] = Instance(self)
        return found


class Instance:
    """An instance of a module, for worlds of one number of rows. As a context, it lets one thread call functions.

    Its memory goes when no batch in it is used any more.
    """

    def __init__(self, loaded: Loaded):
        self.loaded, self.kind = loaded, loaded.kind
        self.running = loaded.host.instantiate(loaded.module)
        self.call = self.running.call
        self.gone: list[int] = []
        """Batches that nobody uses any more."""
        self._lock = RLock()
        self._inputs_at = self.call("inputs", 0)  # from the beginning of a batch
        self._inputs: tuple[Mapping[str, Array], int, bytes] | None = None
        """The last parameters, the number of worlds, and what the module takes for them."""

    def __enter__(self) -> Callable[..., int]:
        self._lock.acquire()
        while self.gone:
            self.call("release", self.gone.pop())
        return self.call

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def transfers(self, name: str, size: int, shape: tuple[int, ...]) -> Iterator[dict[str, int]]:
        """How the pieces of a slot get in and out of a contiguous array of cells of `size` bytes: the number of the
        field, the bytes from its beginning and from one world to the next; or that of the first plane, how many there
        are, and the size of a cell.
        """
        layout = self.loaded.layout
        plane = shape[-2] * shape[-1] * size
        for piece in self.loaded.pieces[name]:
            begin = (piece.component or 0) * plane
            if piece.is_real:
                apart = plane * (1 if piece.component is None else 2)
                yield {"number": layout.reals[piece.slot], "planes": 0, "begin": begin, "apart": apart}
            else:
                first, count = layout.planes[piece.planes[0]], len(piece.planes)
                found = {"number": first, "planes": count, "signed": int(piece.signed), "size": size}
                yield found | {"begin": begin}

    def pack(self, state: Mapping[str, Array]) -> tuple[int, Like]:
        """A new batch with the state."""
        worlds, rows, _ = state["element"].shape
        batch = self.call("allocate", worlds, rows)
        like: dict[str, tuple[Any, tuple[int, ...]]] = {}
        for name, given in state.items():
            value = self.kind.contiguous(given)
            like[name] = (value.dtype, tuple(value.shape))
            if not bool(value.any()):  # a new batch holds zeros
                continue
            data = self.kind.bytes_of(value)
            at = self.call("scratch", len(data))
            self.running.write(at, data)
            for one in self.transfers(name, value.dtype.itemsize, like[name][1]):
                begin = at + one["begin"]
                if one["planes"]:
                    self.call("load", batch, one["number"], one["planes"], one["size"], begin)
                else:
                    self.call("load_real", batch, one["number"], begin, one["apart"])
        return batch, like

    def read(self, batch: int, name: str, like: Like) -> Array:
        """One slot as a new array of its storage dtype."""
        dtype, shape = like[name]
        memory = bytearray(prod(shape) * dtype.itemsize)
        with self as call:
            at = call("scratch", len(memory))
            for one in self.transfers(name, dtype.itemsize, shape):
                begin = at + one["begin"]
                if one["planes"]:
                    call("store", batch, one["number"], one["planes"], one["signed"], one["size"], begin)
                else:
                    call("store_real", batch, one["number"], begin, one["apart"])
            self.running.read(at, memory)
        return self.kind.from_bytes(memory, dtype, shape)

    def input_bytes(self, params: Mapping[str, Array], worlds: int) -> bytes:
        """Parameters as the module takes them, after the clocks."""
        layout = self.loaded.layout
        bits, reals = parameters(self.kind.xp, params, layout.param_planes, layout.param_reals, worlds)
        head = bytes(self.kind.bytes_of(bits))[: worlds * len(layout.param_planes)]
        padding = bytes(-len(head) - 8 * worlds & 15)  # the values begin at a multiple of 16 bytes
        return head + padding + bytes(self.kind.bytes_of(reals))[: 4 * worlds * len(layout.param_reals)]

    def set_inputs(self, batch: int, job: Job, worlds: int) -> None:
        """The clocks and parameters of a job."""
        if self._inputs is None or self._inputs[0] is not job.params or self._inputs[1] != worlds:
            self._inputs = (job.params, worlds, self.input_bytes(job.params, worlds))
        clocks = [self.kind.contiguous(one) for one in (job.clock.seed, job.clock.world, job.clock.step)]
        data = b"".join((*map(self.kind.bytes_of, clocks), self._inputs[2]))
        self.running.write(batch + self._inputs_at, data)

    def run(self, batch: int, job: Job, worlds: int) -> None:
        """Run a batch, and measure the time of passes if the job asks for it."""
        self.set_inputs(batch, job, worlds)
        if job.timing is None:
            self.call("run", batch, job.steps)
            return
        groups = self.call("groups", batch)
        for group in range(groups):
            self.call("enter", batch, group)
            for step in range(job.steps):
                self.call("begin", batch, group, step)
                self._timed(job.timing)
            self.call("leave")

    def _timed(self, clock: PassClock) -> None:
        for number, name in enumerate(self.loaded.passes):
            before = time.perf_counter()
            self.call(str(number))
            clock.add(name, time.perf_counter() - before)


class WasmState(Mapping[str, Array]):
    """A batch's state in the memory of an instance. Slots are unpacked into arrays one by one, on first access."""

    _batch: int | None = None  # of the class: a signal may end `__init__` before its first line

    def __init__(self, instance: Instance, batch: int, like: Like):
        self.instance, self.like = instance, like
        self._batch = batch
        self._arrays: dict[str, Array] = {}

    def __del__(self) -> None:
        # The collector may come in the middle of a call, of this or another thread: the next call releases it.
        if self._batch is not None:
            self.instance.gone.append(self._batch)

    @property
    def batch(self) -> int:
        """The batch's address. Raises RuntimeError after `take`."""
        if self._batch is None:
            raise RuntimeError(
                "these worlds were stepped with `reuse`: only those that came of it can be used"
            )
        return self._batch

    def take(self) -> int:
        """The batch, for a new owner. This state must not be used afterwards."""
        batch, self._batch = self.batch, None
        self._arrays.clear()
        return batch

    def __copy__(self) -> WasmState:
        with self.instance as call:
            return WasmState(self.instance, call("copy", self.batch), self.like)

    def __deepcopy__(self, memo: Any) -> WasmState:
        return self.__copy__()

    def __getitem__(self, name: str) -> Array:
        if name not in self._arrays:
            self._arrays[name] = self.instance.read(self.batch, name, self.like)
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.like)

    def __len__(self) -> int:
        return len(self.like)
