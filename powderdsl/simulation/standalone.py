"""Standalone WebAssembly modules of rulesets, for web pages and games (`powderdsl export`), without torch or NumPy."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from powderdsl.compiler import lower, parts
from powderdsl.ir.bits import choose_form
from powderdsl.ir.ops import SlotType
from powderdsl.model.state import (
    Slot,
    fits,
    fresh_values,
    holders,
    qualified_slots,
    size_problem,
    slots,
    storage,
    stored_range,
)
from powderdsl.model.types import Ruleset
from powderdsl.system.cache import Memo
from powderdsl.system.writing import failure
from powderdsl.targets.layout import pieces
from powderdsl.targets.wasm.source import wasm_module
from powderdsl.targets.wasm.standalone import ModuleData, ModuleParameter, Stored

FORMAT = 1
MAX_CELLS = 1 << 22
"""The largest world: 2048×2048 cells, whose planes and fields fit into the memory of a module."""

_CELLS = {
    "uint8": ("i32.load8_u", 1),
    "int8": ("i32.load8_s", 1),
    "int16": ("i32.load16_s", 2),
    "int32": ("i32.load", 4),
    "float32": ("f32.load", 4),
}
"""The instruction that loads a cell, and its size in bytes."""


def standalone_module(ruleset: Ruleset, size: tuple[int, int], memo: Memo | None = None) -> bytes:
    """The bytes of a module for a world of `size` (rows, columns), as described in `targets.wasm.standalone`.

    `memo` is as in `powderdsl.compile`. Raises CompileError: PD607 if the rules or the limits do not allow the size,
    PD702 if WebAssembly cannot run a pass of the rules.
    """
    if not fits(ruleset, size):
        raise failure("PD607", size_problem(ruleset, size))
    if min(size) < 1 or size[0] * size[1] > MAX_CELLS:
        helps = (f"a module holds 1 to {MAX_CELLS:,} cells",)
        raise failure("PD607", f"a world of {size[0]}×{size[1]} cells", helps=helps)
    program = lower(ruleset, memo)
    segments = parts(program, memo)
    if len(segments) > 1 or segments[0].planes is None:
        forms = (choose_form(program, pass_) for pass_ in program.passes)
        refused = [part for part in forms if part.planes is None]
        notes = tuple(f"{part.place}: the pass `{part.cells.name}` needs {part.why}" for part in refused)
        helps = ("use smaller numbers or kernels there",)
        raise failure("PD702", f"{ruleset.name} does not fit into WebAssembly", notes=notes, helps=helps)
    parts_of = pieces(program)
    (element,) = parts_of["element"]
    fields = tuple(_stored(slot, ruleset, parts_of[slot.name]) for slot in slots(ruleset)[1:])
    ids = tuple(sorted(element.id for element in ruleset.elements))
    knobs = []
    for param in ruleset.params:
        low, high = map(float, stored_range(param.kind))
        whole = param.kind.name in ("int", "flag")
        knobs.append(ModuleParameter(param.name, float(param.default), low, high, whole))
    about = json.dumps(_about(ruleset, size, knobs), separators=(",", ":"), ensure_ascii=False).encode()
    face = ModuleData(size[0], ids, element, fields, tuple(knobs), about)
    return wasm_module(segments[0].planes, size[1], face=face, memo=memo).code


def _stored(slot: Slot, ruleset: Ruleset, parts: tuple[SlotType, ...]) -> Stored:
    usual = fresh_values(ruleset, slot)
    number = float if slot.dtype == "float32" else int
    by_component = zip(*usual, strict=True) if slot.planes == 2 else [usual]
    low, high = stored_range(slot.kind)
    return Stored(
        slot.name,
        parts,
        *_CELLS[slot.dtype],
        tuple(tuple(map(number, values)) for values in by_component),
        float(low),
        float(high),
        holders(ruleset, slot),
        slot.travels,
        slot.kind.name == "element",
    )


def _about(ruleset: Ruleset, size: tuple[int, int], knobs: Sequence[ModuleParameter]) -> dict[str, Any]:
    """The custom section: size, elements, fields and parameters, in the order of their numbers."""
    elements = []
    for element in sorted(ruleset.elements, key=lambda element: element.id):
        row = _attributes(element, "id", "name", "qualified", "color", "glyph")
        if (ramp := element.ramp) is not None:
            row["ramp"] = {**_attributes(ramp, "field", "start", "end"), "low": ramp.lo, "high": ramp.hi}
        elements.append(row)
    qualified = qualified_slots(ruleset)
    tints = {field.name: field.tint for field in ruleset.fields}
    fields = []
    for slot in slots(ruleset)[1:]:
        row = {"name": slot.name, "qualified": qualified.get(slot.name, slot.name), "kind": slot.kind.name}
        row |= {"type": storage(slot.kind), "components": slot.planes}
        if (tint := tints.get(slot.name)) is not None:
            row["tint"] = _attributes(tint, "color", "full", "most")
        fields.append(row)
    parameters = []
    for param, knob in zip(ruleset.params, knobs, strict=True):
        row = {"name": param.name, "kind": param.kind.name, "value": knob.default}
        parameters.append(row | {"low": knob.low, "high": knob.high, "about": param.about})
    return {
        "format": FORMAT,
        "ruleset": ruleset.name,
        "rows": size[0],
        "columns": size[1],
        "elements": elements,
        "fields": fields,
        "parameters": parameters,
    }


def _attributes(value: object, *names: str) -> dict[str, Any]:
    return {name: getattr(value, name) for name in names}
