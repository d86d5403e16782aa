"""The numbers of instructions are those that wasmtime's own assembler gives them."""

from __future__ import annotations

import pytest

from powderdsl.targets.wasm.binary import NAMES

wasmtime = pytest.importorskip("wasmtime")

OPERANDS = {
    "block": "end", "loop": "end", "if": "end", "else": "", "end": "",
    "br": "0", "br_if": "0", "call": "0",
    "local.get": "0", "local.set": "0", "local.tee": "0", "global.get": "0", "global.set": "0",
    "i32.const": "0", "i64.const": "0", "f32.const": "0", "f64.const": "0", "v128.const": "i32x4 0 0 0 0",
    "i8x16.shuffle": "0 " * 16,
}  # fmt: skip
"""What stands behind an instruction in the text format."""

INSIDE = {"else": "if else end", "end": "block end"}
"""Instructions that only stand inside another, which takes two bytes."""


@pytest.mark.parametrize(("number", "name"), [*NAMES.items()])
def test_numbers_of_instructions(number: int, name: str) -> None:
    operand = "0" if name.endswith("_lane") else OPERANDS.get(name, "")
    text = INSIDE.get(name, f"{name} {operand}")
    code = bytes(wasmtime.wat2wasm(f"(module (memory 1) (global i32 (i32.const 0)) (func {text}))"))
    body = code[code.index(b"\x0a", code.index(b"\x06")) :]  # the section of code, after that of globals
    start = 5 + (2 if name in INSIDE else 0)  # its size, one function, its size, no locals
    low = number & 0xFF
    expected = [number] if number <= 0xFF else [number >> 8, *([low | 0x80, 1] if low > 0x7F else [low])]
    assert [*body[start : start + len(expected)]] == expected
