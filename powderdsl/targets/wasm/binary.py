"""The binary format of WebAssembly: functions and modules as bytes."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

from powderdsl.targets.wasm.functions import Function, Module, Statement, Value

TYPES = {"i32": 0x7F, "i64": 0x7E, "f32": 0x7D, "f64": 0x7C, "v128": 0x7B}

_NUMBERED = (
    (0x00, "unreachable nop block loop if else"),
    (0x0B, "end br br_if"),
    (0x0F, "return call"),
    (0x1A, "drop select"),
    (0x20, "local.get local.set local.tee global.get global.set"),
    (0x28, "i32.load i64.load f32.load f64.load i32.load8_s i32.load8_u i32.load16_s i32.load16_u i64.load8_s"),
    (0x31, "i64.load8_u i64.load16_s i64.load16_u i64.load32_s i64.load32_u i32.store i64.store f32.store"),
    (0x39, "f64.store i32.store8 i32.store16 i64.store8 i64.store16 i64.store32 memory.size memory.grow"),
    (0x41, "i32.const i64.const f32.const f64.const"),
    (0x45, "i32.eqz i32.eq i32.ne i32.lt_s i32.lt_u i32.gt_s i32.gt_u i32.le_s i32.le_u i32.ge_s i32.ge_u"),
    (0x50, "i64.eqz i64.eq i64.ne i64.lt_s i64.lt_u i64.gt_s i64.gt_u i64.le_s i64.le_u i64.ge_s i64.ge_u"),
    (0x5B, "f32.eq f32.ne f32.lt f32.gt f32.le f32.ge f64.eq f64.ne"),
    (0x67, "i32.clz i32.ctz i32.popcnt i32.add i32.sub i32.mul i32.div_s i32.div_u i32.rem_s i32.rem_u i32.and"),
    (0x72, "i32.or i32.xor i32.shl i32.shr_s i32.shr_u i32.rotl i32.rotr"),
    (0x79, "i64.clz i64.ctz i64.popcnt i64.add i64.sub i64.mul i64.div_s i64.div_u i64.rem_s i64.rem_u i64.and"),
    (0x84, "i64.or i64.xor i64.shl i64.shr_s i64.shr_u i64.rotl i64.rotr"),
    (0x8B, "f32.abs"),
    (0x96, "f32.min f32.max"),
    (0x9B, "f64.ceil f64.floor"),
    (0xA0, "f64.add f64.sub f64.mul f64.div f64.min f64.max"),
    (0xA7, "i32.wrap_i64"),
    (0xAC, "i64.extend_i32_s i64.extend_i32_u"),
    (0xB6, "f32.demote_f64"),
    (0xB7, "f64.convert_i32_s"),
    (0xBA, "f64.convert_i64_u"),
    (0xFC02, "i32.trunc_sat_f64_s"),
    (0xFC06, "i64.trunc_sat_f64_s"),
    (0xFC0A, "memory.copy memory.fill"),
    (0xFD00, "v128.load"),
    (0xFD09, "v128.load32_splat v128.load64_splat v128.store v128.const i8x16.shuffle i8x16.swizzle"),
    (0xFD0F, "i8x16.splat"),
    (0xFD11, "i32x4.splat i64x2.splat f32x4.splat"),
    (0xFD1B, "i32x4.extract_lane i32x4.replace_lane i64x2.extract_lane i64x2.replace_lane"),
    (0xFD20, "f32x4.replace_lane"),
    (0xFD23, "i8x16.eq"),
    (0xFD37, "i32x4.eq i32x4.ne"),
    (0xFD41, "f32x4.eq f32x4.ne f32x4.lt f32x4.gt f32x4.le f32x4.ge"),
    (0xFD4D, "v128.not v128.and v128.andnot v128.or v128.xor v128.bitselect v128.any_true"),
    (0xFD64, "i8x16.bitmask"),
    (0xFD6B, "i8x16.shl"),
    (0xFD6E, "i8x16.add"),
    (0xFDA4, "i32x4.bitmask"),
    (0xFDAB, "i32x4.shl i32x4.shr_s i32x4.shr_u i32x4.add"),
    (0xFDB5, "i32x4.mul"),
    (0xFDCB, "i64x2.shl i64x2.shr_s i64x2.shr_u i64x2.add"),
    (0xFDE0, "f32x4.abs f32x4.neg"),
    (0xFDE3, "f32x4.sqrt f32x4.add f32x4.sub f32x4.mul f32x4.div"),
    (0xFDEA, "f32x4.pmin f32x4.pmax"),
)  # fmt: skip
"""The instructions that are used, by number; those after a prefix as 0xFC and 0xFD followed by theirs."""


def unsigned(number: int) -> bytes:
    """LEB128 of a number from 0 on."""
    if number < 128:
        return bytes((number,))
    octets = bytearray()
    while number > 127:
        octets.append(number & 127 | 128)
        number >>= 7
    return bytes([*octets, number])


def signed(number: int) -> bytes:
    """LEB128 of a signed number."""
    octets = bytearray()
    while not -64 <= number < 64:
        octets.append(number & 127 | 128)
        number >>= 7
    return bytes([*octets, number & 127])


OPCODES: dict[str, bytes] = {}
for _first, _names in _NUMBERED:
    for _number, _name in enumerate(_names.split(), _first):
        prefix = bytes([_number >> 8]) if _number > 255 else b""
        OPCODES[_name] = prefix + (unsigned(_number & 255) if prefix else bytes([_number]))
for _name in ("block", "loop", "if"):
    OPCODES[_name] += b"\x40"  # without a result
for _name in ("memory.size", "memory.grow", "memory.fill", "memory.copy", "memory.copy"):
    OPCODES[_name] += b"\0"  # of memory 0

_ALIGN = {"v128": 4, "i64": 3, "f64": 3, "i32": 2, "f32": 2, "8": 0, "16": 1, "32": 2, "64": 3}
ALIGNMENTS = {
    name: _ALIGN["".join(filter(str.isdigit, access)) or kind]
    for name in OPCODES
    for kind, _, access in [name.partition(".")]
    if access.startswith(("load", "store"))
}
"""The natural alignment of accesses to memory, which is only a hint."""

Instruction = tuple[str, Any]
"""Its name, and what follows it."""


def instructions(function: Function) -> list[Instruction]:
    """The instructions of a function in order; jumps have the number of blocks that they leave."""
    code: list[Instruction] = []

    def block(body: Iterable[Statement], around: Sequence[Statement]) -> None:
        for statement in body:
            for value in statement.args:
                code.extend(_expression(value))
            match statement.op:
                case "do":
                    pass
                case "block" | "loop" | "if":
                    inside = [*around, statement]
                    code.append((statement.op, None))
                    block(statement.body, inside)
                    if statement.otherwise is not None:
                        code.append(("else", None))
                        block(statement.otherwise, inside)
                    code.append(("end", None))
                case "br" | "br_if":
                    code.append((statement.op, len(around) - 1 - around.index(statement.attr)))
                case _:
                    code.append((statement.op, statement.attr))

    block(function.body, ())
    return code


def _expression(root: Value) -> list[Instruction]:
    """The code that leaves a value on the stack."""
    code, waiting = [], [root]
    while waiting:
        value = waiting.pop()
        code.append((value.op, value.attr))
        waiting.extend(value.args)
    return code[::-1]


def function_code(function: Function) -> bytes:
    """Locals and body, as in the code section."""
    groups = [(len(list(group)), kind) for kind, group in groupby(function.types[len(function.params) :])]
    local = _vector([unsigned(count) + bytes([TYPES[kind]]) for count, kind in groups])
    body = [
        OPCODES[name] if attr is None else OPCODES[name] + _immediates(name, attr)
        for name, attr in instructions(function)
    ]
    return b"".join([local, *body, OPCODES["end"]])


def _immediates(name: str, attr: Any) -> bytes:
    """What follows an instruction."""
    kind, dot, rest = name.partition(".")
    if name == "call":
        return unsigned(attr.index)
    if not dot or kind in ("local", "global"):
        return unsigned(attr)
    if rest == "const":
        if kind in ("i32", "i64"):
            return signed(attr)
        return attr if kind == "v128" else struct.pack("<f" if kind == "f32" else "<d", attr)
    if name in ALIGNMENTS:
        return bytes([ALIGNMENTS[name]]) + unsigned(attr)
    return unsigned(attr)


def module_code(module: Module) -> bytes:
    """A module in the binary format."""
    signatures = [
        b"\x60"
        + _vector([bytes([TYPES[t]]) for t in function.params])
        + _vector([bytes([TYPES[t]]) for t in function.results])
        for _, function, _ in module.functions
    ]
    types = list(dict.fromkeys(signatures))
    variables = [bytes([TYPES[t], 1]) + _start(t, start) for t, start in module.variables]
    exports = [_text(name) + b"\x00" + unsigned(callee.index) for name, callee in module.exports]
    data = [b"\0" + _start("i32", at) + unsigned(len(octets)) + octets for at, octets in module.data]
    sections = [
        (1, _vector(types)),
        (3, _vector([unsigned(types.index(signature)) for signature in signatures])),
        (5, _vector([b"\x01" + unsigned(module.pages) + unsigned(module.most)])),
        (6, _vector(variables)),
        (7, _vector([_text("memory") + b"\x02\x00", *exports])),
        (10, _vector([unsigned(len(code)) + code for _, _, code in module.functions])),
        *([(11, _vector(data))] if data else []),
        *((0, _text(name) + octets) for name, octets in module.custom),
    ]  # fmt: skip
    return b"\0asm\1\0\0\0" + b"".join(
        bytes([number]) + unsigned(len(section)) + section for number, section in sections
    )


def _start(type: str, number: int) -> bytes:
    """An expression of a constant."""
    return OPCODES[f"{type}.const"] + signed(number) + OPCODES["end"]


def _vector(items: Sequence[bytes]) -> bytes:
    return unsigned(len(items)) + b"".join(items)


def _text(text: str) -> bytes:
    return unsigned(len(text.encode())) + text.encode()
