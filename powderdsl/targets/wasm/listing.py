"""Modules as text: the instructions of functions in the notation of the text format, read back from their code."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from powderdsl.targets.wasm.binary import NAMES, TYPES, Module


def listing(module: Module, only: str | None = None) -> str:
    """The functions of a module; with `only`, one and those that it calls."""
    names = [name for name, _ in module.functions]
    bodies = [_listing(code, names) for _, code in module.functions]
    wanted = [i for i, name in enumerate(names) if only in (None, name.rpartition("_")[0])]
    for i in wanted:  # grows
        called = {int(line.rpartition("_")[2]) for line in bodies[i].splitlines() if " call $" in line}
        wanted += sorted(called - set(wanted))
    return "\n".join(f"(func ${names[i]}\n{bodies[i]})" for i in sorted(set(wanted)))


class _Reader:
    """Reads code back, for its text."""

    def __init__(self, code: bytes):
        self.code, self.at = code, 0

    def octets(self, count: int) -> bytes:
        self.at += count
        return self.code[self.at - count : self.at]

    def number(self, *, signed: bool = False) -> int:
        found = shift = 0
        while True:
            (octet,) = self.octets(1)
            found |= (octet & 127) << shift
            shift += 7
            if octet < 128:
                return found - (1 << shift) if signed and octet & 64 else found


def _listing(code: bytes, names: Sequence[str]) -> str:
    """The instructions of a function, one a line."""
    read = _Reader(code)
    kinds = {number: name for name, number in TYPES.items()}
    declared = [(read.number(), kinds[read.octets(1)[0]]) for _ in range(read.number())]
    lines = [f"  (local {kind}) ;; {count}" for count, kind in declared]
    depth = 1
    while read.at < len(code) - 1:
        number = read.octets(1)[0]
        if number in (0xFC, 0xFD):
            number = number << 8 | read.number()
        name = NAMES[number]
        depth -= name in ("end", "else")
        lines.append("  " * depth + f"{name}{_immediates(name, read, names)}")
        depth += name in ("block", "loop", "if", "else")
    return "\n".join(lines)


def _immediates(name: str, read: _Reader, names: Sequence[str]) -> str:
    kind, _, rest = name.partition(".")
    if name in ("block", "loop", "if"):
        read.octets(1)
        return ""
    if name == "call":
        return f" ${names[read.number()]}"
    if kind in ("br", "br_if", "local", "global"):
        return f" {read.number()}"
    if rest == "const":
        if kind in ("i32", "i64"):
            return f" {read.number(signed=True)}"
        if kind == "v128":
            return " i32x4 " + " ".join(f"{part:#x}" for part in struct.unpack("<4I", read.octets(16)))
        return f" {struct.unpack('<f' if kind == 'f32' else '<d', read.octets(4 if kind == 'f32' else 8))[0]}"
    if name == "i8x16.shuffle":
        return "".join(f" {octet}" for octet in read.octets(16))
    if kind == "memory":
        read.octets(2 if rest == "copy" else 1)
        return ""
    if rest.startswith(("load", "store")):
        read.number()
        return f" offset={read.number()}"
    return f" {read.octets(1)[0]}" if rest.endswith("_lane") else ""
