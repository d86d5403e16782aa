"""Hosts, which compile and run modules of WebAssembly that import nothing and export `memory`; batches in that memory.

The host is wasmtime in this process (`wasmtime_host`); in Pyodide, it is the browser or Node.js.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Protocol

from powderdsl.ir.ops import SlotType
from powderdsl.targets.layout import Layout

TOO_LARGE = "the worlds do not fit into the memory of a WebAssembly module"


class RunningModule(Protocol):
    """An instance of a module: its functions and its memory, each for one thread at a time."""

    def call(self, name: str, *args: int) -> int:
        """Call an exported function with i32 arguments; return the result as unsigned, or 0 if there is none.

        Raises MemoryError after a trap: modules trap when their memory is too small.
        """

    def write(self, at: int, data: Any) -> None:
        """Write bytes to an address of the module's memory."""

    def read(self, at: int, size: int) -> bytearray:
        """Bytes from an address of the module's memory."""

    def memory_size(self) -> int:
        """The bytes of the module's memory."""


Compiled = Callable[[], RunningModule]
"""A module: makes its instances."""


def this_host() -> Callable[[bytes], Compiled]:
    """The compiler of this process. Raises ImportError if there is none."""
    if sys.platform == "emscripten":
        return browser_module
    from powderdsl.targets.wasm.wasmtime_host import WasmtimeModule

    return WasmtimeModule


def browser_module(code: bytes) -> Compiled:
    """A module of JavaScript, compiled synchronously: on a page, only a worker may do that."""
    import js
    from pyodide.ffi import to_js

    module = js.WebAssembly.Module.new(to_js(code))
    return lambda: BrowserInstance(js.WebAssembly.Instance.new(module).exports)


class BrowserInstance:
    """An instance in the browser. When its memory grows, addresses stay valid and views do not, so calls make new views."""

    def __init__(self, exports: Any):
        import js
        from pyodide.ffi import JsException

        self._exports, self._memory, self._trap = exports, exports.memory, JsException
        self._view = js.Uint8Array.new
        self._functions: dict[str, Any] = {}

    def call(self, name: str, *args: int) -> int:
        function = self._functions.get(name)
        if function is None:
            function = self._functions[name] = getattr(self._exports, name)
        try:
            result = function(*args)
        except self._trap:
            raise MemoryError(TOO_LARGE) from None
        return 0 if result is None else int(result) & 0xFFFFFFFF

    def write(self, at: int, data: Any) -> None:
        self._view(self._memory.buffer, at, len(data)).assign(data)

    def read(self, at: int, size: int) -> bytearray:
        octets = bytearray(size)
        self._view(self._memory.buffer, at, size).assign_to(octets)
        return octets

    def memory_size(self) -> int:
        return int(self._memory.buffer.byteLength)


# The layout of batches of worlds

HEADER = 16
"""Bytes of numbers before the contents of planes, fields and batches."""

WORLDS, GROUPS = 0, 4
"""Where the header of a batch has its numbers of worlds and of groups, i32."""


def aligned(count: int, by: int = 16) -> int:
    """The next multiple of `by`."""
    return -(-count // by) * by


def numbers_of(piece: SlotType, layout: Layout, size: int) -> tuple[int, int, int, int]:
    """The arguments of `load` and `store` for a piece of the state whose cells have `size` bytes."""
    slot, planes, signed = layout.home(piece)
    return slot if planes else len(layout.planes) + slot, planes, int(signed), size
