"""A program as compiled C++ with its layout: enough to run it again without lowering anything."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from powderdsl.ir.ops import Program, Threshold, Type
from powderdsl.system.reading import read_json
from powderdsl.targets import cache
from powderdsl.targets.codec import Piece, pieces
from powderdsl.targets.cpp.build import current, open_library
from powderdsl.targets.cpp.source import native_source
from powderdsl.targets.layout import NativeLayout


@dataclass(frozen=True)
class NativeCode:
    """A library, the widths it is for (`source.known_width`), its layout, the pieces of each state tensor, and the names
    of the passes."""

    library: Path
    width: int
    layout: NativeLayout
    pieces: Mapping[str, tuple[Piece, ...]]
    passes: tuple[str, ...]


def compile_program(program: Program, planes: Program, width: int) -> NativeCode:
    """Write a program as C++ and compile it.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
        width: of grids, see `source.known_width`.

    Raises:
        NoCompiler: there is no C++ compiler, or it failed.
    """
    source, layout, units = native_source(planes, width)
    library, _ = open_library(source, program.name, units)
    return NativeCode(library, width, layout, pieces(program), tuple(p.name for p in planes.passes))


def recall(key: str) -> NativeCode | None:
    """The code stored under a key, if its library still exists. Raises NoCompiler if there is no cache folder."""
    folder = current().place()
    path = cache.find(folder, key)
    facts = {} if path is None else read_json(path)
    library = cache.find(folder, facts["library"]) if facts else None
    return None if library is None else _decode(facts, library)


def remember(key: str, code: NativeCode) -> None:
    """Store the rest of a compiled program under a key. A cache that cannot be written only costs time."""
    _, name = cache.key_and_name(code.library)
    with suppress(OSError):
        cache.add(current().place(), key, json.dumps(_encode(code)).encode(), f"{name}.json")


def _encode(code: NativeCode) -> dict[str, Any]:
    """The code as JSON. Tables become lists of pairs, since their keys are tuples; thresholds become lists."""
    layout = {f.name: getattr(code.layout, f.name) for f in fields(NativeLayout)}
    tables = {k: list(v.items()) if isinstance(v, dict) else v for k, v in layout.items()}
    tables["param_planes"] = [
        ((name, threshold and [threshold.bits, threshold.strict], bit), number)
        for (name, threshold, bit), number in code.layout.param_planes.items()
    ]
    return {
        "library": cache.key_and_name(code.library)[0],
        "width": code.width,
        "layout": tables,
        "pieces": [asdict(piece) for parts in code.pieces.values() for piece in parts],
        "passes": list(code.passes),
    }


def _decode(facts: dict[str, Any], library: Path) -> NativeCode:
    tables: dict[str, Any] = {
        name: {_key(key): number for key, number in value} if isinstance(value, list) else value
        for name, value in facts["layout"].items()
    }
    tables["param_planes"] = {
        (name, threshold and Threshold(*threshold), bit): number
        for (name, threshold, bit), number in facts["layout"]["param_planes"]
    }
    found: dict[str, tuple[Piece, ...]] = {}
    for row in facts["pieces"]:
        piece = Piece(**row | {"type": Type(**row["type"])})
        found[piece.state] = (*found.get(piece.state, ()), piece)
    return NativeCode(library, int(facts["width"]), NativeLayout(**tables), found, tuple(facts["passes"]))


def _key(key: Any) -> Any:
    return tuple(_key(part) for part in key) if isinstance(key, list) else key
