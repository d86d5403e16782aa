"""The native backend: worlds stay packed between calls; tensors are created when they are read."""

from __future__ import annotations

import ctypes
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from powderdsl.ir.ops import Program, SlotType
from powderdsl.system import cache
from powderdsl.system.reading import read_bytes
from powderdsl.targets.cpp.build import Source, build, current, load_library
from powderdsl.targets.cpp.source import native_source
from powderdsl.targets.job import Job, Like, OwnedBatch, like_of, shape_of
from powderdsl.targets.layout import Layout, pieces

KEPT_INPUTS = 16
"""The number of parameter mappings whose inputs a program caches."""


@dataclass(frozen=True)
class NativeCode:
    """A program as compiled C++, with everything to run it again without lowering.

    `width`: of grids (`source.known_width`); `pieces`: of each state tensor; `passes`: their names.
    """

    library: Path
    driver: Path
    width: int
    layout: Layout
    pieces: Mapping[str, tuple[SlotType, ...]]
    passes: tuple[str, ...]


def compile_program(program: Program, planes: Program, width: int) -> NativeCode:
    """Write a program as C++ and compile it.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
        width: of grids, see `source.known_width`.

    Raises:
        NoCompiler: there is no C++ compiler, or it failed.
    """
    source = native_source(planes, width)
    passes = Source(source.passes, program.name, source.units)
    library, driver = build(passes, Source(source.driver, "driver"))
    names = tuple(pass_.name for pass_ in planes.passes)
    return NativeCode(library, driver, width, source.layout, pieces(program), names)


def recall(key: str) -> NativeCode | None:
    """The code stored under a key, if its libraries still exist. Raises NoCompiler if there is no cache folder."""
    folder = current().place()
    path = cache.find(folder, key)
    if path is None:
        return None
    # Whoever can write into the folder can also replace libraries, so a pickle is as safe as they are.
    code: NativeCode = pickle.loads(read_bytes(path, cache.LIMIT))
    library, driver = (cache.find(folder, path.name.split("-")[0]) for path in (code.library, code.driver))
    return None if library is None or driver is None else replace(code, library=library, driver=driver)


def remember(key: str, code: NativeCode) -> None:
    """Store the rest of a compiled program under a key. If the cache cannot be written, only time is lost."""
    with suppress(OSError):
        cache.add(current().place(), key, pickle.dumps(code), f"{code.library.name.split('-')[2]}.layout")


class ParameterArrays(NamedTuple):
    """The parameters of a batch as generated code reads them: bits uint8 [B, n], floats float32 [B, m]; or [1, …]."""

    params: Mapping[str, Tensor]
    bits: Tensor
    reals: Tensor

    @property
    def own(self) -> bool:
        """True if each world has parameters of its own."""
        return len(self.bits) > 1


class View(ctypes.Structure):
    """`View` of views.hpp: one part of an observation. `first` and `second` are addresses of tables."""

    _fields_ = (
        ("kind", ctypes.c_int),
        ("numbers", ctypes.c_int * 9),
        ("number", ctypes.c_float),
        ("first", ctypes.c_void_p),
        ("second", ctypes.c_void_p),
        ("offset", ctypes.c_int64),
    )


VIEWS = ("values", "colors", "ramp", "tint", "channels", "codes", "planes")
"""The kinds of views."""


class Views:
    """The parts of an observation that native code writes."""

    def __init__(self) -> None:
        self.parts: list[View] = []
        self.tables: list[list[Tensor]] = []
        """The parts."""

    def add(
        self, kind: str, *numbers: int, number: float = 0, tables: Sequence[Tensor] = (), offset: int = 0
    ) -> None:
        """Add a part that begins at the byte `offset` of each world's memory."""
        self.tables.append([*tables])
        places = [table.data_ptr() for table in tables] + [None] * (2 - len(tables))
        whole = (ctypes.c_int * 9)(*numbers)
        self.parts.append(View(VIEWS.index(kind), whole, number, *places, offset))

    @cached_property
    def array(self) -> Any:
        """All parts, in the form that the library reads."""
        return (View * len(self.parts))(*self.parts)


class PackedState(OwnedBatch):
    """A batch's state in native memory."""

    __slots__ = ("program",)

    def __init__(self, program: NativeProgram, handle: int, like: Like):
        self.program = program
        super().__init__(handle, like)

    def release(self, handle: int) -> None:
        self.program.library.pd_free(handle)

    def __copy__(self) -> PackedState:
        return PackedState(self.program, self.program.library.pd_copy(self.handle), self.like)

    def unpack(self, name: str) -> Tensor:
        dtype, shape = self.like[name]
        return self.write(name, torch.empty(shape, dtype=dtype))

    def write(self, name: str, out: Tensor) -> Tensor:
        """One slot, written into a tensor of its storage dtype whose worlds are contiguous; returns it."""
        store, size, stride = self.program.library.pd_store, out.element_size(), out.stride(0)
        for part, slot, bits, signed in self.program.parts(name, out):
            store(self.handle, slot, bits, signed, size, part.data_ptr(), stride)
        return out

    def show(self, views: Views, out: Tensor) -> Tensor:
        """Views of the worlds, written into a tensor whose worlds are contiguous; returns it."""
        apart = out.stride(0) * out.element_size()
        self.program.library.pd_show(self.handle, len(views.parts), views.array, out.data_ptr(), apart)
        return out

    def fill(self, boxes: Tensor, values: Mapping[str, Tensor], *, reuse: bool) -> PackedState:
        """The state with one box of cells in each world filled, without unpacking the rest.

        Args:
            boxes: int64 [B, 4]: first row, the one after the last, first column, the one after the last, all within
                the grid; empty where nothing changes.
            values: by slot: int64 [B], float32 [B] for reals, float32 [B, 2] for vectors.
            reuse: write to this state itself, and return it.
        """
        changed, boxes = self if reuse else self.__copy__(), boxes.contiguous()
        for name, value in values.items():
            changed._arrays.pop(name, None)
            for part, slot, bits, _ in self.program.parts(name, value):
                numbers = part.contiguous()
                self.program.library.pd_fill(changed.handle, slot, bits, numbers.data_ptr(), boxes.data_ptr())
        return changed

    def select(self, places: Tensor, running: int = 0) -> PackedState:
        """The worlds `places`, int64 [n], as a new state. `running`: see `NativeProgram.pack`."""
        rows, library, places = len(places), self.program.library, places.contiguous()
        like = {name: (dtype, (rows, *shape[1:])) for name, (dtype, shape) in self.like.items()}
        taken = PackedState(self.program, self.program.new(rows, *shape_of(self)[1:], running), like)
        library.pd_take(taken.handle, None, self.handle, places.data_ptr(), rows)
        return taken

    def put(self, places: Tensor, state: Mapping[str, Tensor], *, reuse: bool) -> PackedState:
        """The state with the worlds `places`, int64 [n], replaced by those of another state of n worlds.

        `reuse`: write to this state itself, and return it.
        """
        changed, places = self if reuse else self.__copy__(), places.contiguous()
        changed._arrays.clear()
        put, count, at = self.program.library.pd_put, len(places), places.data_ptr()
        if isinstance(state, PackedState) and state.program is self.program:
            self.program.library.pd_take(changed.handle, at, state.handle, None, count)
            return changed
        for name, value in state.items():
            for part, slot, bits, _ in self.program.parts(name, value):
                cells = part.contiguous()
                put(changed.handle, slot, bits, cells.element_size(), cells.data_ptr(), count, at)
        return changed


class Places:
    """The places of a state's pieces in generated code: `homes` are the results of `Layout.home`, by slot."""

    def __init__(self, layout: Layout, pieces: Mapping[str, tuple[SlotType, ...]]):
        self.layout, self.pieces = layout, pieces
        self.homes = {piece.name: layout.home(piece) for parts in pieces.values() for piece in parts}


class NativeProgram(Places):
    """A program as compiled C++. Passes are timed on one thread, in processor time."""

    def __init__(self, code: NativeCode, threads: int):
        super().__init__(code.layout, code.pieces)
        self.library = load_library(code.driver)
        self.address = load_library(code.library).pd_program(self.library.pd_shared())
        self.code, self.threads = code, threads
        self._inputs: dict[int, ParameterArrays] = {}
        """Keyed by the `id` of the mapping, which the inputs keep alive."""

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        state, (seed, index, start, since) = job.state, job.clock
        seed, index, start = seed.contiguous(), index.contiguous(), start.contiguous()
        inputs = self.inputs(job.params, len(start))
        packed = self.pack(state)
        reuse = job.reuse or packed is not state
        handle = packed.take() if reuse else packed.handle
        seconds = None if job.timing is None else (ctypes.c_double * len(self.code.passes))()
        handle = self.library.pd_run(
            handle, not reuse, job.steps, self.threads,
            seed.data_ptr(), index.data_ptr(), start.data_ptr(), since, inputs.own, inputs.bits.data_ptr(), inputs.reals.data_ptr(), seconds,
        )  # fmt: skip
        if job.timing is not None and seconds is not None:
            for name, spent in zip(self.code.passes, seconds, strict=True):
                job.timing.add(name, spent)
        return PackedState(self, handle, packed.like)

    def inputs(self, params: Mapping[str, Tensor], batch: int) -> ParameterArrays:
        """The inputs of some parameters, kept for the next call with the same mapping."""
        if (known := self._inputs.get(id(params))) is not None:
            return known
        if len(self._inputs) >= KEPT_INPUTS:
            self._inputs = {}  # not cleared: another thread may be reading it
        bits, floats = (part.T for part in self.layout.parameters(torch, params, batch))
        if bool((bits == bits[:1]).all()) and bool((floats == floats[:1]).all()):
            bits, floats = bits[:1], floats[:1]
        self._inputs[id(params)] = inputs = ParameterArrays(params, bits.contiguous(), floats.contiguous())
        return inputs

    def new(self, worlds: int, height: int, width: int, running: int) -> int:
        """The handle of a batch in which all cells are 0. `running`: see `pack`."""
        handle: int = self.library.pd_new(self.address, worlds, height, width, running)
        return handle

    def pack(self, state: Mapping[str, Tensor], running: int = 0) -> PackedState:
        """A state in this program's memory: the argument, if it already is.

        `running` returns a new state, laid out for about this number of worlds that are not idle.
        """
        if isinstance(state, PackedState) and state.program is self:
            return state.select(torch.arange(shape_of(state)[0]), running) if running else state
        handle = self.new(*shape_of(state), running)
        for name, value in state.items():
            if not any(value.stride(axis) for axis in (0, -2, -1)) and not value[0, ..., 0, 0].any():
                continue  # 0 in all cells, as in a new batch
            value = value.contiguous()
            for part, slot, bits, _ in self.parts(name, value):
                size, stride = value.element_size(), value.stride(0)
                self.library.pd_load(handle, slot, bits, size, part.data_ptr(), stride)
        return PackedState(self, handle, like_of(state))

    def parts(self, name: str, value: Tensor) -> Iterator[tuple[Tensor, int, int, bool]]:
        for piece in self.pieces[name]:
            yield piece.of(value), *self.homes[piece.name]
