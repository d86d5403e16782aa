"""wasmtime in this process, called through its C functions: `wasmtime.Func` takes 20 µs a call."""

from __future__ import annotations

import atexit
import ctypes
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar
from weakref import WeakSet

import wasmtime
from wasmtime import _ffi

from powderdsl.targets.wasm.host import TOO_LARGE, Bytes

MOST_ARGUMENTS = 16
GROWTH = 16 << 20
"""Bytes of addresses beyond a memory into which it grows without being moved, where addresses are few."""


_OWNED: WeakSet[Any] = WeakSet()
"""What wasmtime frees with the objects of Python that own it."""
T = TypeVar("T")


def _owned(one: T) -> T:
    _OWNED.add(one)
    return one


@atexit.register
def _leave() -> None:
    """Leave everything to the operating system: wasmtime cannot free it when Python has taken its modules apart."""
    for one in list(_OWNED):
        with suppress(ValueError):  # it was freed before
            one._consume()


@dataclass
class Compiled:
    """A module with the engine that has compiled it."""

    code: bytes
    engine: wasmtime.Engine
    module: wasmtime.Module


class WasmtimeHost:
    """Compiles modules and instantiates them, each in a store of its own.

    wasmtime reserves 4 GiB of addresses for each memory, so that the processor checks accesses. Where addresses are
    limited (`ulimit -v`), it checks them itself, in code that takes half as long again.
    """

    def __init__(self) -> None:
        self._engine = _engine(reserve=True)

    def compile(self, code: bytes) -> Compiled:
        engine = self._engine
        return Compiled(code, engine, _owned(wasmtime.Module(engine, code)))

    def instantiate(self, module: Compiled) -> WasmtimeModule:
        try:
            return WasmtimeModule(module.engine, module.module)
        except wasmtime.WasmtimeError:
            self._engine = module.engine = _engine(reserve=False)
            module.module = _owned(wasmtime.Module(module.engine, module.code))
        try:
            return WasmtimeModule(module.engine, module.module)
        except wasmtime.WasmtimeError:
            raise MemoryError(TOO_LARGE) from None


@cache
def _engine(*, reserve: bool) -> wasmtime.Engine:
    config = wasmtime.Config()
    if not reserve:
        config.memory_reservation = 0
        config.memory_reservation_for_growth = GROWTH
        config.memory_guard_size = 0
    return _owned(wasmtime.Engine(config))


class WasmtimeModule:
    """An instance in a store of its own."""

    def __init__(self, engine: wasmtime.Engine, module: wasmtime.Module):
        self._store = _owned(wasmtime.Store(engine))
        exports: dict[str, Any] = dict(
            wasmtime.Instance(self._store, module, []).exports(self._store).items()
        )
        self._context = self._store._context()
        self._functions = {
            name: ctypes.byref(one._func) for name, one in exports.items() if isinstance(one, wasmtime.Func)
        }
        self._memory = exports["memory"]
        self._memory_at = ctypes.byref(self._memory._memory)
        self._raw = (ctypes.c_uint64 * (2 * MOST_ARGUMENTS))()  # of 16 bytes each
        self._values = ctypes.cast(self._raw, ctypes.POINTER(_ffi.wasmtime_val_raw_t))
        self._trap = ctypes.POINTER(_ffi.wasm_trap_t)()
        self._trap_at = ctypes.byref(self._trap)

    def call(self, name: str, *args: int) -> int:
        raw, at = self._raw, 0
        for arg in args:
            raw[at] = arg
            at += 2
        error = _ffi.wasmtime_func_call_unchecked(
            self._context, self._functions[name], self._values, max(len(args), 1), self._trap_at
        )
        if bool(error) or bool(self._trap):
            self._forget(error)
            raise MemoryError(TOO_LARGE)
        return raw[0] & 0xFFFFFFFF

    def _forget(self, error: Any) -> None:
        """Free what a call has failed with."""
        if error:
            _ffi.wasmtime_error_delete(error)
        if bool(self._trap):
            _ffi.wasm_trap_delete(self._trap)
            ctypes.memset(self._trap_at, 0, ctypes.sizeof(self._trap))

    def write(self, at: int, data: Bytes) -> None:
        if isinstance(data, bytes):
            ctypes.memmove(self._address(at), data, len(data))
            return
        view = memoryview(data).cast("B")
        self._bytes(at, view.nbytes)[:] = view

    def read(self, at: int, out: Bytes) -> None:
        view = memoryview(out).cast("B")
        view[:] = self._bytes(at, view.nbytes)

    def _address(self, at: int) -> int:
        """An address of the module's memory in this process; memory may move when it grows."""
        start = _ffi.wasmtime_memory_data(self._context, self._memory_at)
        return ctypes.addressof(start.contents) + at

    def _bytes(self, at: int, size: int) -> memoryview:
        return memoryview((ctypes.c_ubyte * size).from_address(self._address(at))).cast("B")

    def memory_size(self) -> int:
        return int(self._memory.data_len(self._store))
