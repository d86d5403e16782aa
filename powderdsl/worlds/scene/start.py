"""What a scene says of a start world besides its elements: fields in shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.fields.words import WordProblem, read_word
from powderdsl.model.state import Slot, slot_name, slots
from powderdsl.model.types import Ruleset
from powderdsl.worlds.raster import Paint, Setting, Size, mask
from powderdsl.worlds.scene.load import draw_scene, element_ids, find_scene
from powderdsl.worlds.scene.read import Scene


@dataclass(frozen=True)
class FieldValues:
    """Values of a field, [H, W] or [2, H, W], and the cells bool [H, W] that have them; others have the default."""

    values: NDArray[Any]
    where: NDArray[np.bool_]


@dataclass(frozen=True)
class Start:
    """A start world: element ids uint8 [H, W], and the fields that the scene sets, by name."""

    ids: NDArray[np.uint8]
    fields: Mapping[str, FieldValues]


def load_start(path_or_name: str | Path, ruleset: Ruleset, *, size: Size | None = None) -> Start:
    """The start world of a scene: as `load_scene`, and the fields that it sets. Raises CompileError."""
    return draw_start(find_scene(path_or_name), ruleset, size=size)


def draw_start(scene: Scene, ruleset: Ruleset, *, size: Size | None = None) -> Start:
    """The start world of a scene.

    Statements follow one another: a field is set in the cells of its shape whose element can have it, and an
    element that is painted later is fresh there.

    Raises:
        CompileError: unknown elements (PD604) or fields (PD301), values of another kind (PD110) or out of range
            (PD402), settings that no cell can have (PD608), a bad `size` (PD607).
    """
    ids = draw_scene(scene, ruleset, size=size)
    scene = _named_as(ruleset, scene)
    settings = [one for one in scene.paints if isinstance(one, Setting)]
    if not settings:
        return Start(ids, {})
    reporter = Reporter()
    words = element_ids(ruleset)
    held = {slot.name: slot for slot in slots(ruleset) if slot.name != "element"}
    values = {index: _value(one, held, words, ruleset, reporter) for index, one in enumerate(settings)}
    reporter.raise_if_errors()
    found = {one.name: _unset(held[one.name], ids.shape) for one in settings}
    now = np.full(ids.shape, words[scene.fill], dtype=np.uint8)
    number = 0
    for one in scene.paints:
        cells = mask(one.shape, ids.shape)
        if isinstance(one, Paint):
            now[cells] = words[one.element]
            for name, field in found.items():
                if held[name].travels:
                    field.where[cells] = False
            continue
        limited = _limited(held[one.name], ruleset)
        if limited is not None:
            cells &= np.isin(now, sorted(limited))
        if not cells.any():
            names = ", ".join(f"`{e.name}`" for e in ruleset.elements if e.id in (limited or ()))
            reporter.error(
                "PD608", f"`{one.name}` is set in no cell", one.span, f"the shape holds nothing that has `{one.name}`",
                helps=[f"only these have it: {names}; paint them before"],
            )  # fmt: skip
        found[one.name].values[..., cells] = np.array(values[number])[:, None]
        found[one.name].where[cells] = True
        number += 1
    reporter.raise_if_errors()
    return Start(ids, found)


def _named_as(ruleset: Ruleset, scene: Scene) -> Scene:
    """The scene with its fields' names as worlds have them: it may have qualified ones."""
    paints = tuple(
        replace(one, name=slot_name(ruleset, one.name)) if isinstance(one, Setting) else one
        for one in scene.paints
    )
    return replace(scene, paints=paints)


def _value(
    one: Setting, held: Mapping[str, Slot], ids: Mapping[str, int], ruleset: Ruleset, reporter: Reporter
) -> tuple[float, ...]:
    slot = held.get(one.name)
    if slot is None:
        if ruleset.property(one.name) is not None:
            label = "it follows from the element"
            reporter.error("PD407", f"no rule assigns `{one.name}`", one.name_span, label)
        else:
            helps, label = suggest(one.name, held, "its fields"), "not a field of this ruleset"
            reporter.error("PD301", f"unknown field `{one.name}`", one.name_span, label, helps=helps)
        return ()
    try:
        return tuple(low for low, _ in read_word(one.value, slot.kind, ids))
    except WordProblem as wrong:
        reporter.error(wrong.code, wrong.message, one.value_span, wrong.label, helps=wrong.helps)
        return ()


def _unset(slot: Slot, shape: tuple[int, ...]) -> FieldValues:
    dtype = np.dtype(slot.dtype)
    return FieldValues(np.zeros((2, *shape) if slot.planes == 2 else shape, dtype), np.zeros(shape, np.bool_))


def _limited(slot: Slot, ruleset: Ruleset) -> frozenset[int] | None:
    """The elements whose cells can have the slot's field; None for all."""
    prop = ruleset.property(slot.name)
    return slot.of if prop is None else prop.stored
