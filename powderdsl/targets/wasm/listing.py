"""Modules as text: the instructions of functions in the notation of the text format."""

from __future__ import annotations

import struct
from itertools import groupby
from typing import Any

from powderdsl.targets.wasm.binary import instructions
from powderdsl.targets.wasm.functions import Function, Module


def listing(module: Module, only: str | None = None) -> str:
    """The functions of a module; with `only`, one and those that it calls."""
    names = [name for name, _, _ in module.functions]
    bodies = [_listing(function, names) for _, function, _ in module.functions]
    wanted = [i for i, name in enumerate(names) if only in (None, name.rpartition("_")[0])]
    for i in wanted:  # grows
        called = {int(line.rpartition("_")[2]) for line in bodies[i].splitlines() if " call $" in line}
        wanted += sorted(called - set(wanted))
    return "\n".join(f"(func ${names[i]}\n{bodies[i]})" for i in sorted(set(wanted)))


def _listing(function: Function, names: list[str]) -> str:
    """The instructions of a function, one a line."""
    groups = groupby(function.types[len(function.params) :])
    lines = [f"  (local {kind}) ;; {len(list(group))}" for kind, group in groups]
    depth = 1
    for name, attr in instructions(function):
        depth -= name in ("end", "else")
        lines.append("  " * depth + name + _operands(name, attr, names))
        depth += name in ("block", "loop", "if", "else")
    return "\n".join(lines)


def _operands(name: str, attr: Any, names: list[str]) -> str:
    rest = name.partition(".")[2]
    if name == "call":
        return f" ${names[attr.index]}"
    if name == "v128.const":
        return " i32x4 " + " ".join(f"{part:#x}" for part in struct.unpack("<4I", attr))
    if rest.startswith(("load", "store")):
        return f" offset={attr}"
    return "" if attr is None else f" {attr}"
