"""wasmtime in this process, called through its C functions: `wasmtime.Func` takes 20 µs a call."""

from __future__ import annotations

import atexit
import ctypes
import os
from contextlib import suppress
from functools import cache
from hashlib import sha256
from typing import Any
from weakref import WeakSet

import wasmtime
from wasmtime import _ffi

from powderdsl.system.cache import persistent
from powderdsl.targets.wasm.host import TOO_LARGE

INSTALLED = os.stat(wasmtime.__file__).st_mtime_ns
"""When wasmtime was installed: reading its version takes longer than reading what it has compiled."""

MOST_ARGUMENTS = 16
GROWTH = 16 << 20
"""Address space reserved for growth on machines with little address space."""

_OWNED: WeakSet[Any] = WeakSet()
"""Python objects that own memory of wasmtime."""


@atexit.register
def _leave_memory() -> None:
    """Leave all memory to the operating system: wasmtime cannot free it while Python shuts down."""
    for owner in list(_OWNED):
        with suppress(ValueError):  # already freed
            owner._consume()


@cache
def _engine(*, reserve: bool) -> wasmtime.Engine:
    config = wasmtime.Config()
    if not reserve:
        config.memory_reservation = 0
        config.memory_reservation_for_growth = GROWTH
        config.memory_guard_size = 0
    engine = wasmtime.Engine(config)
    _OWNED.add(engine)
    return engine


class WasmtimeModule:
    """A compiled module; each instance has its own store.

    wasmtime reserves 4 GiB of addresses for each memory, so that the processor checks accesses. Where addresses are
    limited (`ulimit -v`), generated code checks them, which takes half as long again.
    """

    engine = _engine(reserve=True)
    """The engine of new modules."""

    def __init__(self, code: bytes):
        self._code = code
        self._compile()

    def _compile(self) -> None:
        self._engine = self.engine
        inputs = f"{INSTALLED} {_engine(reserve=True) is self.engine} {sha256(self._code).hexdigest()}"

        def compile() -> bytes:
            return bytes(wasmtime.Module(self.engine, self._code).serialize())

        machine_code = persistent("machine code", inputs, compile)
        try:
            module = wasmtime.Module.deserialize(self.engine, machine_code)
        except wasmtime.WasmtimeError:  # made by another processor
            module = wasmtime.Module(self.engine, self._code)
        _OWNED.add(module)
        self._module = module

    def __call__(self) -> WasmtimeInstance:
        """A new instance. Raises MemoryError where there is no room for its memory."""
        try:
            return WasmtimeInstance(self._engine, self._module)
        except wasmtime.WasmtimeError:
            WasmtimeModule.engine = _engine(reserve=False)
            self._compile()
        try:
            return WasmtimeInstance(self._engine, self._module)
        except wasmtime.WasmtimeError:
            raise MemoryError(TOO_LARGE) from None


class WasmtimeInstance:
    """An instance in its own store."""

    def __init__(self, engine: wasmtime.Engine, module: wasmtime.Module):
        self._store = wasmtime.Store(engine)
        _OWNED.add(self._store)
        instance = wasmtime.Instance(self._store, module, [])
        exports: dict[str, Any] = dict(instance.exports(self._store).items())
        self._context = self._store._context()
        functions = ((name, item) for name, item in exports.items() if isinstance(item, wasmtime.Func))
        self._functions = {name: ctypes.byref(item._func) for name, item in functions}
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
        if not bool(error) and not bool(self._trap):
            return raw[0] & 0xFFFFFFFF
        if bool(error):
            _ffi.wasmtime_error_delete(error)
        if bool(self._trap):
            _ffi.wasm_trap_delete(self._trap)
            ctypes.memset(self._trap_at, 0, ctypes.sizeof(self._trap))
        raise MemoryError(TOO_LARGE)

    def _address(self, at: int) -> int:
        """An address of the module's memory in this process; memory may move when it grows."""
        start = _ffi.wasmtime_memory_data(self._context, self._memory_at)
        return ctypes.addressof(start.contents) + at

    def write(self, at: int, data: Any) -> None:
        ctypes.memmove(self._address(at), data, len(data))

    def read(self, at: int, size: int) -> bytearray:
        return bytearray((ctypes.c_ubyte * size).from_address(self._address(at)))

    def memory_size(self) -> int:
        return int(self._memory.data_len(self._store))
