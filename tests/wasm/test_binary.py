"""The binary format: what is written runs in an engine and means what Python says."""

from __future__ import annotations

import struct
from typing import Any

import pytest
import wasmtime

from powderdsl.targets.wasm.binary import Function, Module, Value, body, const, load, op, signed


def value_of(value: Value) -> Any:
    """What a function in a module of its own gives."""
    function = Function()
    with body.of(function):
        body.give(value)
    module = Module(1, 1)
    module.add(function, "f", export=True)
    store = wasmtime.Store()
    instance = wasmtime.Instance(store, wasmtime.Module(store.engine, module.code), [])
    found: Any = instance.exports(store)["f"]
    return found(store)


@pytest.mark.parametrize("type", ["i32", "i64"])
@pytest.mark.parametrize("number", [0, 1, -1, 63, 64, -64, -65, 1 << 20, 1 << 30, -(1 << 31)])
def test_constants(type: str, number: int) -> None:
    assert value_of(const(type, number)) == number
    assert len(signed(number)) <= 5


@pytest.mark.parametrize("number", [0.1, -0.0, 1e30, 1e-40])
def test_float_constants_are_exact(number: float) -> None:
    wanted = struct.pack("<f", number)
    assert struct.pack("<f", value_of(const("f32", number))) == wanted


def test_listings_have_every_instruction() -> None:
    function = Function(["i32"])
    with body.of(function):
        held = body.let(5, "v128")
        with body.when(op("v128.any_true", held)):
            load("v128.load", function.params[0], 32).set(held)
        body.give(-7)
    module = Module(1, 1)
    module.add(function, "f")
    for line in ("v128.const i32x4 0x5 0x0 0x5 0x0", "v128.any_true", "v128.store offset=32", "i32.const -7"):
        assert f"  {line}\n" in module.listing()
