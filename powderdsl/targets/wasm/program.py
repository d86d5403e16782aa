"""The backend `wasm`: a module in wasmtime. Worlds stay packed between calls; tensors are made when they are read."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from typing import Any

import torch
import wasmtime
from torch import Tensor

from powderdsl.ir.ops import Program
from powderdsl.targets.codec import Piece, parameters, pieces
from powderdsl.targets.job import Job
from powderdsl.targets.wasm.source import wasm_module

Like = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]
"""The dtype and shape of each tensor of a state."""


class WasmState(Mapping[str, Tensor]):
    """A batch's state in the memory of an instance. Slots are unpacked into tensors one by one, on first access."""

    def __init__(self, instance: _Instance, batch: int, like: Like):
        self.instance, self.batch, self.like = instance, batch, like
        self._tensors: dict[str, Tensor] = {}

    def __del__(self) -> None:
        self.instance.call("release", self.batch)

    def __copy__(self) -> WasmState:
        return WasmState(self.instance, self.instance.call("copy", self.batch), self.like)

    def __deepcopy__(self, memo: Any) -> WasmState:
        return self.__copy__()

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._tensors:
            dtype, shape = self.like[name]
            self._tensors[name] = self.instance.read(self.batch, name, torch.empty(shape, dtype=dtype))
        return self._tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.like)

    def __len__(self) -> int:
        return len(self.like)


class _Instance:
    """An instance of a module, for worlds of one number of rows."""

    def __init__(self, module: _Loaded):
        self.module = module
        self.store = wasmtime.Store(module.engine)
        exports = wasmtime.Instance(self.store, module.module, []).exports(self.store)
        self.functions: dict[str, Any] = {name: exports[name] for name in exports}
        self.memory: Any = self.functions["memory"]

    def call(self, name: str, *args: float) -> Any:
        return self.functions[name](self.store, *args)

    def address(self, at: int) -> int:
        """An address in the module's memory as one of this process; memory moves when it grows."""
        found = ctypes.addressof(self.memory.data_ptr(self.store).contents)
        return found + at

    def write(self, at: int, tensor: Tensor) -> None:
        ctypes.memmove(self.address(at), tensor.data_ptr(), tensor.nbytes)

    def pack(self, state: Mapping[str, Tensor]) -> tuple[int, Like]:
        layout = self.module.layout
        worlds, rows, _ = state["element"].shape
        batch = self.call("allocate", worlds, rows)
        like: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {}
        for name, value in state.items():
            value = value.contiguous()
            like[name] = (value.dtype, tuple(value.shape))
            at = self.call("scratch", value.nbytes)
            self.write(at, value)
            for piece in self.module.pieces[name]:
                begin = at + piece.of(value).storage_offset() * value.element_size()
                if piece.is_real:
                    apart = value.stride(0) * value.element_size()
                    self.call("load_real", batch, layout.reals[piece.slot], begin, apart)
                else:
                    first = layout.planes[piece.planes[0]]
                    self.call("load", batch, first, len(piece.planes), value.element_size(), begin)
        return batch, like

    def read(self, batch: int, name: str, out: Tensor) -> Tensor:
        """One slot, written into a contiguous tensor of its storage dtype; returns it."""
        layout, size = self.module.layout, out.element_size()
        at = self.call("scratch", out.nbytes)
        for piece in self.module.pieces[name]:
            begin = at + piece.of(out).storage_offset() * size
            if piece.is_real:
                self.call("store_real", batch, layout.reals[piece.slot], begin, out.stride(0) * size)
            else:
                first = layout.planes[piece.planes[0]]
                self.call("store", batch, first, len(piece.planes), int(piece.signed), size, begin)
        ctypes.memmove(out.data_ptr(), self.address(at), out.nbytes)
        return out


class _Loaded:
    """A module, ready to be instantiated, and its numbers."""

    def __init__(self, engine: wasmtime.Engine, program: Program, planes: Program, width: int):
        made = wasm_module(planes, width)
        self.engine, self.module = engine, wasmtime.Module(engine, made.code)
        self.layout = made.layout
        self.pieces: dict[str, tuple[Piece, ...]] = pieces(program)
        self._instances: dict[tuple[int, bool], _Instance] = {}

    def instance(self, worlds: int, rows: int) -> _Instance:
        """The instance for a shape. Whether lanes are strips depends on the rows and on whether there is one world."""
        return self._instances.setdefault((rows, worlds == 1), _Instance(self))


class WasmProgram:
    """A program as WebAssembly, run by wasmtime on one thread: a module for each width of grids.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
    """

    def __init__(self, program: Program, planes: Program):
        self._program, self._planes = program, planes
        self._engine = wasmtime.Engine()
        self._modules: dict[int, _Loaded] = {}

    def module(self, width: int) -> _Loaded:
        if width not in self._modules:
            self._modules[width] = _Loaded(self._engine, self._program, self._planes, width)
        return self._modules[width]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        state, clock = job.state, job.clock
        element = state.like["element"][1] if isinstance(state, WasmState) else state["element"].shape
        worlds, rows, width = element
        module = self.module(width)
        instance = module.instance(worlds, rows)
        if isinstance(state, WasmState) and state.instance is instance:
            batch, like = instance.call("copy", state.batch), state.like
        else:
            batch, like = instance.pack(state)
        bits, values = parameters(
            job.params, module.layout.param_planes, module.layout.param_reals, worlds, torch.device("cpu")
        )
        at = instance.call("inputs", batch)
        for part in (clock.seed, clock.world, clock.step):
            instance.write(at, part.to(torch.int64).contiguous())
            at += 8 * worlds
        instance.write(at, bits[: len(module.layout.param_planes)].contiguous())
        at += worlds * len(module.layout.param_planes)
        instance.write((at + 15) & ~15, values[: len(module.layout.param_reals)].contiguous())
        instance.call("run", batch, job.steps)
        return WasmState(instance, batch, like)
