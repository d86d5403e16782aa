"""Hosts: what runs modules of WebAssembly. One is wasmtime in this process; in a browser it is the browser itself."""

from __future__ import annotations

import sys
from functools import cache
from typing import Any, Protocol

Bytes = Any
"""An object that has the buffer protocol."""

TOO_LARGE = "the worlds do not fit into the memory of a WebAssembly module"


class RunningModule(Protocol):
    """An instance of a module: its functions and its memory, each for one thread at a time."""

    def call(self, name: str, *args: int) -> int:
        """Call an exported function with i32. The result, if there is one, is taken as unsigned.

        Raises:
            MemoryError: the function has ended in a trap; modules do that when their memory is too small.
        """
        ...

    def write(self, at: int, data: Bytes) -> None:
        """Write bytes to an address of the module's memory."""
        ...

    def read(self, at: int, out: Bytes) -> None:
        """Fill a buffer from an address of the module's memory."""
        ...

    def memory_size(self) -> int:
        """The bytes of the module's memory."""
        ...


class Host(Protocol):
    """Runs modules that import nothing and export `memory`."""

    def compile(self, code: bytes) -> Any:
        """A module, ready to be instantiated."""
        ...

    def instantiate(self, module: Any) -> RunningModule:
        """A new instance of a module of this host."""
        ...


@cache
def this_host() -> Host:
    """The host of this process. Raises ImportError if there is none."""
    if sys.platform == "emscripten":
        from powderdsl.targets.wasm.browser_host import BrowserHost

        return BrowserHost()
    from powderdsl.targets.wasm.wasmtime_host import WasmtimeHost

    return WasmtimeHost()
