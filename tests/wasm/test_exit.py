"""What wasmtime owns when a process ends."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import atexit
from wasmtime import _ffi

FREE = ("wasmtime_module_delete", "wasmtime_store_delete", "wasm_engine_delete")

def take_apart():
    for name in FREE:
        getattr(_ffi, name)
        setattr(_ffi, name, None)

atexit.register(take_apart)  # what is registered first runs last
from powderdsl.targets.wasm.wasmtime_host import WasmtimeModule

module = WasmtimeModule(bytes.fromhex("0061736d01000000" "0503010001" "070a01066d656d6f72790200"))  # exports a memory
running = module()
assert running.memory_size() == 1 << 16
"""


def test_nothing_is_freed_after_python_has_taken_wasmtime_apart() -> None:
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=False
    )
    assert (run.returncode, run.stderr) == (0, "")
