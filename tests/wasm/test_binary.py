"""The binary format: what is written runs in an engine and means what Python says."""

from __future__ import annotations

import struct
from typing import Any

import pytest
import wasmtime

from powderdsl.targets.wasm.binary import (
    Function,
    Module,
    Value,
    body,
    const,
    load,
    op,
    signed,
    vector,
)


def ran(function: Function, *args: float) -> Any:
    """The result of a function in a module of its own."""
    module = Module(1, 1)
    module.add(function, "f", export=True)
    store = wasmtime.Store()
    instance = wasmtime.Instance(store, wasmtime.Module(store.engine, module.code), [])
    found: Any = instance.exports(store)["f"]
    return found(store, *args)


def value_of(value: Value) -> Any:
    function = Function()
    with body.of(function):
        body.give(value)
    return ran(function)


@pytest.mark.parametrize("type", ["i32", "i64"])
@pytest.mark.parametrize("number", [0, 1, -1, 63, 64, -64, -65, 1 << 20, 1 << 30, -(1 << 31)])
def test_constants(type: str, number: int) -> None:
    assert value_of(const(type, number)) == number
    assert len(signed(number)) <= 5


@pytest.mark.parametrize("number", [0.1, -0.0, 1e30, 1e-40])
def test_float_constants_are_exact(number: float) -> None:
    wanted = struct.pack("<f", number)
    assert struct.pack("<f", value_of(const("f32", number))) == wanted


def test_operators() -> None:
    seven, three = const("i32", 7), const("i32", 3)
    assert value_of(seven + three) == 10
    assert value_of(seven - three) == 4
    assert value_of(seven * three) == 21
    assert value_of(seven % three) == 1
    assert value_of(seven // three) == 2
    assert value_of(seven & three) == 3
    assert value_of(seven ^ three) == 4
    assert value_of(seven << three) == 56
    assert value_of(seven >> 1) == 3
    assert value_of(const("i32", -1) >> 28) == 15
    assert value_of(const("i32", -1) < three) == 0
    assert value_of(seven >= three) == 1
    assert value_of(seven.equals(7)) == 1


def test_vectors() -> None:
    octets = bytes(range(16))
    low = int.from_bytes(octets[:8], "little")
    word = op("i64x2.extract_lane", vector(octets) >> 8, tail=b"\0")
    assert value_of(word) == low >> 8
    high = op("i64x2.extract_lane", vector(octets), tail=b"\1")
    assert value_of(high) == int.from_bytes(octets[8:], "little")
    assert value_of(op("v128.any_true", ~const("v128", -1))) == 0


def test_loops_and_memory() -> None:
    function = Function(["i32"])
    (count,) = function.params
    with body.of(function):
        with body.each(0, count) as i:
            load("i32.load", i << 2, 16).set(i * i)
        total = body.let(0)
        with body.each(0, count) as i:
            total += load("i32.load", i << 2, 16)
        body.give(total)
    assert ran(function, 10) == sum(i * i for i in range(10))


def test_blocks_are_left_by_their_labels() -> None:
    function = Function(["i32"])
    with body.of(function):
        with body.block() as outer:
            with body.block(), body.when(function.params[0]):
                body.jump(outer)
            body.give(1)
        body.give(2)
    assert [ran(function, n) for n in (0, 1)] == [1, 2]


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
