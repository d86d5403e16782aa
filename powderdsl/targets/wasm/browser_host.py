"""The WebAssembly of a browser or of Node.js, used from Pyodide."""

from __future__ import annotations

from typing import Any

from powderdsl.targets.wasm.host import TOO_LARGE, Bytes


class BrowserHost:
    """The `WebAssembly` object of JavaScript. Modules are compiled at once: on a page that is for a worker to do."""

    def compile(self, code: bytes) -> Any:
        import js
        from pyodide.ffi import to_js

        return js.WebAssembly.Module.new(to_js(code))

    def instantiate(self, module: Any) -> BrowserModule:
        import js

        return BrowserModule(js.WebAssembly.Instance.new(module).exports)


class BrowserModule:
    """An instance; addresses of its memory stay valid when it grows, views of it do not, so each call makes its own."""

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
            found = function(*args)
        except self._trap:
            raise MemoryError(TOO_LARGE) from None
        return 0 if found is None else int(found) & 0xFFFFFFFF

    def write(self, at: int, data: Bytes) -> None:
        self._view(self._memory.buffer, at, memoryview(data).nbytes).assign(data)

    def read(self, at: int, out: Bytes) -> None:
        self._view(self._memory.buffer, at, memoryview(out).nbytes).assign_to(out)

    def memory_size(self) -> int:
        return int(self._memory.buffer.byteLength)
