"""The backend `wasm`: a module in wasmtime. Worlds stay packed between calls; tensors are made when they are read."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator, Mapping
from threading import RLock
from typing import Any

import torch
import wasmtime
from torch import Tensor
from wasmtime import _ffi

from powderdsl.ir.ops import Program
from powderdsl.targets.codec import parameters, pieces
from powderdsl.targets.job import Job
from powderdsl.targets.profiling import PassClock
from powderdsl.targets.wasm.source import wasm_module

Like = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]
"""The dtype and shape of each tensor of a state."""


class WasmState(Mapping[str, Tensor]):
    """A batch's state in the memory of an instance. Slots are unpacked into tensors one by one, on first access."""

    def __init__(self, instance: Instance, batch: int, like: Like):
        self.instance, self.like = instance, like
        self._batch: int | None = batch
        self._tensors: dict[str, Tensor] = {}

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
        self._tensors.clear()
        return batch

    def __copy__(self) -> WasmState:
        with self.instance as call:
            return WasmState(self.instance, call("copy", self.batch), self.like)

    def __deepcopy__(self, memo: Any) -> WasmState:
        return self.__copy__()

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._tensors:
            self._tensors[name] = self.instance.read(self.batch, name, self.like)
        return self._tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.like)

    def __len__(self) -> int:
        return len(self.like)


class Functions:
    """The functions of an instance. Arguments and results are i32, without checks: `Func` takes 20 µs a call."""

    def __init__(self, store: wasmtime.Store, exports: Mapping[str, Any]):
        self._context = store._context()
        self._functions = {name: one._func for name, one in exports.items() if isinstance(one, wasmtime.Func)}
        self._raw = (ctypes.c_uint64 * 32)()  # of 16 bytes each
        self._values = ctypes.cast(self._raw, ctypes.POINTER(_ffi.wasmtime_val_raw_t))
        self._trap = ctypes.POINTER(_ffi.wasm_trap_t)()

    def __call__(self, name: str, *args: int) -> int:
        raw = self._raw
        for i, arg in enumerate(args):
            raw[2 * i] = arg
        function, trap = ctypes.byref(self._functions[name]), ctypes.byref(self._trap)
        count = max(len(args), 1)
        error = _ffi.wasmtime_func_call_unchecked(self._context, function, self._values, count, trap)
        if bool(error) or bool(self._trap):
            raise MemoryError("the worlds do not fit into the memory of a WebAssembly module")
        return raw[0] & 0xFFFFFFFF


class Instance:
    """An instance of a module, for worlds of one number of rows. As a context, it lets one thread call functions."""

    def __init__(self, loaded: Loaded):
        self.loaded = loaded
        self.store = wasmtime.Store(loaded.module_engine)
        exports = dict(wasmtime.Instance(self.store, loaded.module, []).exports(self.store).items())
        self.call = Functions(self.store, exports)
        self._memory: Any = exports["memory"]
        self.gone: list[int] = []
        """Batches that nobody uses any more."""
        self._lock = RLock()
        self._inputs: tuple[Mapping[str, Tensor], int, bytes] | None = None
        """The last parameters, the number of worlds, and what the module takes for them."""

    def __enter__(self) -> Functions:
        self._lock.acquire()
        while self.gone:
            self.call("release", self.gone.pop())
        return self.call

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def address(self, at: int) -> int:
        """An address in the module's memory as one of this process; memory may move when it grows."""
        start = self._memory.data_ptr(self.store)
        return ctypes.addressof(start.contents) + at

    def memory_size(self) -> int:
        """The bytes of the module's memory."""
        return int(self._memory.data_len(self.store))

    def transfers(self, name: str, tensor: Tensor) -> Iterator[dict[str, int]]:
        """How the pieces of a slot get in and out of a tensor: the number of the field, the bytes from its beginning and
        from one world to the next; or that of the first plane, how many there are, and the size of a cell.
        """
        layout, size = self.loaded.layout, tensor.element_size()
        for piece in self.loaded.pieces[name]:
            begin = int(piece.of(tensor).storage_offset()) * size
            if piece.is_real:
                apart = tensor.stride(0) * size
                yield {"number": layout.reals[piece.slot], "planes": 0, "begin": begin, "apart": apart}
            else:
                first, count = layout.planes[piece.planes[0]], len(piece.planes)
                found = {"number": first, "planes": count, "signed": int(piece.signed), "size": size}
                yield found | {"begin": begin}

    def pack(self, state: Mapping[str, Tensor]) -> tuple[int, Like]:
        """A new batch with the state."""
        worlds, rows, _ = state["element"].shape
        batch = self.call("allocate", worlds, rows)
        like: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {}
        for name, given in state.items():
            value = given.contiguous()
            like[name] = (value.dtype, tuple(value.shape))
            at = self.call("scratch", value.nbytes)
            ctypes.memmove(self.address(at), value.data_ptr(), value.nbytes)
            for one in self.transfers(name, value):
                begin = at + one["begin"]
                if one["planes"]:
                    self.call("load", batch, one["number"], one["planes"], one["size"], begin)
                else:
                    self.call("load_real", batch, one["number"], begin, one["apart"])
        return batch, like

    def read(self, batch: int, name: str, like: Like) -> Tensor:
        """One slot as a new tensor of its storage dtype."""
        dtype, shape = like[name]
        out = torch.empty(shape, dtype=dtype)
        with self as call:
            at = call("scratch", out.nbytes)
            for one in self.transfers(name, out):
                begin = at + one["begin"]
                if one["planes"]:
                    call("store", batch, one["number"], one["planes"], one["signed"], one["size"], begin)
                else:
                    call("store_real", batch, one["number"], begin, one["apart"])
            ctypes.memmove(out.data_ptr(), self.address(at), out.nbytes)
        return out

    def input_bytes(self, params: Mapping[str, Tensor], worlds: int) -> bytes:
        """Parameters as the module takes them, after the clocks."""
        layout = self.loaded.layout
        bits, reals = parameters(params, layout.param_planes, layout.param_reals, worlds, torch.device("cpu"))
        head = bytes(bits[: len(layout.param_planes)].numpy())
        padding = bytes(-len(head) - 8 * worlds & 15)  # the values begin at a multiple of 16 bytes
        return head + padding + bytes(reals[: len(layout.param_reals)].numpy())

    def set_inputs(self, batch: int, job: Job, worlds: int) -> None:
        """The clocks and parameters of a job."""
        if self._inputs is None or self._inputs[0] is not job.params or self._inputs[1] != worlds:
            self._inputs = (job.params, worlds, self.input_bytes(job.params, worlds))
        at = self.address(self.call("inputs", batch))
        for part in (job.clock.seed, job.clock.world, job.clock.step):
            ctypes.memmove(at, part.contiguous().data_ptr(), 8 * worlds)
            at += 8 * worlds
        ctypes.memmove(at, self._inputs[2], len(self._inputs[2]))

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


class Loaded:
    """A module for grids of one width, ready to be instantiated, and its numbers."""

    def __init__(
        self, engine: wasmtime.Engine, program: Program, planes: Program, width: int, *, apart: bool
    ):
        made = wasm_module(planes, width, apart=apart)
        self.module_engine, self.module = engine, wasmtime.Module(engine, made.code)
        self.layout, self.pieces = made.layout, pieces(program)
        self.passes = tuple(one.name for one in planes.passes)
        self._instances: dict[tuple[int, bool], Instance] = {}

    def instance(self, worlds: int, rows: int) -> Instance:
        """The instance for a shape. Whether lanes are strips depends on the rows and on whether there is one world."""
        key = (rows, worlds == 1)
        if key not in self._instances:
            self._instances[key] = Instance(self)
        return self._instances[key]


class WasmProgram:
    """A program as WebAssembly, run by wasmtime on one thread: a module for each width of grids.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
    """

    def __init__(self, program: Program, planes: Program):
        self._program, self._planes = program, planes
        self._engine = wasmtime.Engine()
        self._modules: dict[tuple[int, bool], Loaded] = {}

    def loaded(self, width: int, *, apart: bool = False) -> Loaded:
        """The module for a width; `apart`: one whose passes can be called one by one."""
        key = (width, apart)
        if key not in self._modules:
            self._modules[key] = Loaded(self._engine, self._program, self._planes, width, apart=apart)
        return self._modules[key]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        assert not job.draws
        assert job.passes is None
        state = job.state
        shape = state.like["element"][1] if isinstance(state, WasmState) else state["element"].shape
        worlds, rows, width = shape
        instance = self.loaded(width, apart=job.timing is not None).instance(worlds, rows)
        if isinstance(state, WasmState) and state.instance is not instance:
            state = dict(state)
        with instance as call:
            if isinstance(state, WasmState):
                batch, like = state.take() if job.reuse else call("copy", state.batch), state.like
            else:
                batch, like = instance.pack(state)
            instance.run(batch, job, worlds)
        return WasmState(instance, batch, like)
