"""Scenes by file or name -> start worlds of a ruleset: elements, and fields in shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.fields.words import WordProblem, read_word
from powderdsl.model.state import Slot, slot_name, slots
from powderdsl.model.types import Element, Ruleset
from powderdsl.syntax.sources import read_source
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import MAX_CELLS, Paint, Setting, Size, mask, paint
from powderdsl.worlds.scene.read import SIZE_RULE, Scene, read_scenes


class HasElements(Protocol):
    """A ruleset, as far as scenes need one."""

    @property
    def elements(self) -> Sequence[Element]: ...


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


def load_scene(
    path_or_name: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene: a file, ``FILE#NAME`` for one of several, or a shipped scene's name.

    Fields that the scene sets are left out: `load_start` has them.

    With another `size` shapes stay where they are, a frame and open ends follow the edge. Raises CompileError
    with everything that is wrong.
    """
    return draw_scene(find_scene(path_or_name), ruleset, size=size)


def load_start(path_or_name: str | Path, ruleset: Ruleset, *, size: Size | None = None) -> Start:
    """The start world of a scene: as `load_scene`, and the fields that it sets. Raises CompileError."""
    return draw_start(find_scene(path_or_name), ruleset, size=size)


def load_scenes(
    path: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> dict[str, NDArray[np.uint8]]:
    """Every scene of a file by name, uint8 [H, W] each, in the order of the file. Raises CompileError."""
    reporter = Reporter()
    drawn = {scene.name: _draw(scene, ruleset, size, reporter) for scene in _read_file(Path(path))}
    reporter.raise_if_errors()
    return drawn


def find_scene(path_or_name: str | Path) -> Scene:
    """A scene from a file, or a shipped one by name. Raises CompileError (PD601 for an unknown name)."""
    text = str(path_or_name)
    file, _, name = text.rpartition("#") if "#" in text else (text, "", "")
    if file.lower().endswith((".yaml", ".yml")) or _is_file(file):
        scenes = {scene.name: scene for scene in _read_file(Path(file))}
        if not name and len(scenes) == 1:
            return next(iter(scenes.values()))
        if name in scenes:
            return scenes[name]
        message = f"no scene `{name}` in {file}" if name else f"{file} has {len(scenes)} scenes"
        which = f"say which: {file}#{next(iter(scenes), 'NAME')}"
        raise failure("PD601", message, helps=suggest(name, scenes) if name else (which,))
    shipped = {scene.name: scene for scene in shipped_scenes()}
    if text in shipped:
        return shipped[text]
    helps = suggest(text, shipped) or ("shipped: " + ", ".join(shipped),)
    raise failure("PD601", f"unknown scene `{text[:80]}`", helps=helps)


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # a name longer than the system allows is not a file either
        return False


def shipped_scenes() -> tuple[Scene, ...]:
    """The scenes that come with the package, files in alphabetical order."""
    package = Path(__file__).resolve().parents[2]
    installed = package / "data" / "tasks" / "scenes"
    directory = installed if installed.is_dir() else package.parent / "tasks" / "scenes"
    return tuple(scene for path in sorted(directory.glob("*.yaml")) for scene in _read_file(path))


def _read_file(path: Path) -> tuple[Scene, ...]:
    reporter = Reporter()
    source = read_source(path, reporter)
    scenes = read_scenes(source, reporter) if source else ()
    reporter.raise_if_errors()
    return scenes


def element_ids(ruleset: HasElements) -> dict[str, int]:
    """Ids by plain and qualified name."""
    ids = {element.qualified: element.id for element in ruleset.elements}
    return ids | {element.name: element.id for element in ruleset.elements}


def draw_scene(scene: Scene, ruleset: HasElements, *, size: Size | None = None) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene. Raises CompileError: PD604 unknown elements, PD607 a bad `size`."""
    reporter = Reporter()
    ids = _draw(scene, ruleset, size, reporter)
    reporter.raise_if_errors()
    return ids


def _draw(scene: Scene, ruleset: HasElements, size: Size | None, reporter: Reporter) -> NDArray[np.uint8]:
    """The ids of a scene; unknown elements are reported, and painted as 0."""
    height, width = size or scene.size
    if not (height >= 1 and width >= 1 and height * width <= MAX_CELLS):
        raise failure("PD607", f"a world of {height}×{width} cells", helps=(SIZE_RULE,))
    ids = element_ids(ruleset)
    paints = [one for one in scene.paints if isinstance(one, Paint)]
    used = [(scene.fill, scene.fill_span), *((one.element, one.element_span) for one in paints)]
    names = {element.name for element in ruleset.elements}
    for name, span in used:
        if name not in ids:
            helps, label = suggest(name, names, "its elements"), "not an element of this ruleset"
            reporter.error("PD604", f"unknown element `{name}`", span, label, helps=helps)
    known = {name: ids.get(name, 0) for name, _ in used}
    return paint((height, width), known[scene.fill], paints, known)


def draw_start(scene: Scene, ruleset: Ruleset, *, size: Size | None = None) -> Start:
    """The start world of a scene.

    Statements follow one another: a field is set in the cells of its shape whose element can have it, and an
    element that is painted later is fresh there.

    Raises:
        CompileError: unknown elements (PD604) or fields (PD301), values of another kind (PD110) or out of range
            (PD402), settings that no cell can have (PD608), a bad `size` (PD607).
    """
    ids = draw_scene(scene, ruleset, size=size)
    # Scenes may use qualified names of fields, worlds do not.
    paints = [
        replace(one, name=slot_name(ruleset, one.name)) if isinstance(one, Setting) else one
        for one in scene.paints
    ]
    reporter, words = Reporter(), element_ids(ruleset)
    held = {slot.name: slot for slot in slots(ruleset) if slot.name != "element"}
    values = {one: _value(one, held, words, ruleset, reporter) for one in paints if isinstance(one, Setting)}
    reporter.raise_if_errors()
    found = {one.name: _unset(held[one.name], ids.shape) for one in values}
    now = np.full(ids.shape, words[scene.fill], dtype=np.uint8)
    for one in paints if values else ():
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
            label, fix = (
                f"the shape holds nothing that has `{one.name}`",
                f"only these have it: {names}; paint them before",
            )
            reporter.error("PD608", f"`{one.name}` is set in no cell", one.span, label, helps=[fix])
        found[one.name].values[..., cells] = np.array(values[one])[:, None]
        found[one.name].where[cells] = True
    reporter.raise_if_errors()
    return Start(ids, found)


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
