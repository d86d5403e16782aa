"""Scene files: YAML -> scenes -> start worlds of a ruleset: elements, and fields in shapes."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import Label, Reporter, Source, Span, suggest
from powderdsl.model.schema import NAME_FORM, Reader, Record, first_line, keyed, read_tree
from powderdsl.model.state import Slot, holders, slot_name, slots
from powderdsl.model.types import Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import Syntax, line_of
from powderdsl.syntax.sources import read_source, shipped
from powderdsl.system.cache import persistent
from powderdsl.system.writing import failure
from powderdsl.worlds.ascii import ids_by_name
from powderdsl.worlds.raster import MAX_CELLS, Paint, Setting, Shape, Size, mask
from powderdsl.worlds.scene.statements import (
    SETTING,
    STATEMENTS,
    Statement,
    amounts_of,
    constants,
    read_statement,
)


class SceneDecl(Record, noun="a scene"):
    """A scene as written."""

    name: str = keyed("the scene's name", "", name="scene", required=True, form=NAME_FORM)
    about: str = keyed("its purpose, in a sentence", "")
    size: yaml_tree.Node | None = keyed("[rows, columns]", required=True)
    fill: yaml_tree.Scalar | None = keyed("the element that fills the world first", required=True)
    draw: yaml_tree.Node | None = keyed("statements, in order")


class FileDecl(Record, noun="a file of scenes"):
    """A file with several scenes."""

    scenes: yaml_tree.Node | None = keyed("the scenes of the file", required=True, shape="list")
    about: str = keyed("their purpose, in a sentence", "")


SIZE_RULE = f"a world needs at least one row and one column, and has at most {MAX_CELLS:,} cells"


@dataclass(frozen=True)
class Scene:
    """A drawn world. Elements are names as written: only `draw_start` needs a ruleset."""

    name: str
    about: str
    size: Size
    fill: str
    paints: tuple[Paint | Setting, ...]
    span: Span = field(compare=False, repr=False)
    fill_span: Span = field(compare=False, repr=False)


def read_scenes(source: Source, reporter: Reporter) -> tuple[Scene, ...]:
    """The scenes of a file. Everything except element names is checked; mistakes go to the reporter."""
    tree = read_tree(source, reporter, "a scene starts with `scene: NAME`")
    if tree is None:
        return ()
    reader = Reader(reporter)
    if not isinstance(tree, yaml_tree.Mapping) or tree.get("scenes") is None:
        scene = _read_scene(tree, reader)
        return (scene,) if scene else ()
    file = reader.record(FileDecl, tree, "a file of scenes")
    if file is None or not isinstance(file.scenes, yaml_tree.Sequence):
        if file is not None and file.scenes is not None:
            reader.shape(file.scenes, "a list of scenes")
        return ()
    scenes: dict[str, Scene] = {}
    for item in file.scenes.items:
        scene = _read_scene(item, reader)
        if scene and scene.name in scenes:
            first = Label(scenes[scene.name].span, "first one")
            message = f"two scenes are called `{scene.name}`"
            reporter.error("PD302", message, scene.span, "second one", secondary=[first])
        elif scene:
            scenes[scene.name] = scene
    return tuple(scenes.values())


def _read_scene(node: yaml_tree.Node, reader: Reader) -> Scene | None:
    decl = reader.record(SceneDecl, node, "a scene")
    if decl is None:
        return None
    name = node.get("scene") if isinstance(node, yaml_tree.Mapping) else None
    size = None if decl.size is None else _read_size(decl.size, reader.reporter)
    paints = () if decl.draw is None else _read_statements(decl.draw, reader)
    for paint in paints if size else ():
        if size and not mask(paint.shape, size).any():
            covers_nothing(paint.span, "nothing of it lies", size, reader.reporter)
    if name is None or not (decl.name and size and decl.fill):
        return None
    return Scene(decl.name, decl.about, size, decl.fill.text, paints, name.span, decl.fill.span)


def two_integers(node: yaml_tree.Node) -> Size | None:
    """The numbers of a list of two nonnegative integers, or None."""
    items = node.items if isinstance(node, yaml_tree.Sequence) else ()
    words = [item.text for item in items if isinstance(item, yaml_tree.Scalar)]
    numbers = [int(word) for word in words if re.fullmatch(r"[0-9]{1,9}", word)]
    return (numbers[0], numbers[1]) if len(items) == len(numbers) == 2 else None


def _read_size(node: yaml_tree.Node, reporter: Reporter) -> Size | None:
    size = two_integers(node)
    if size is None:
        message, label, helps = "a size is [rows, columns]", "not two integers", ["size: [64, 64]"]
        reporter.error("PD607", message, first_line(node), label, helps=helps)
    elif 0 in size or size[0] * size[1] > MAX_CELLS:
        message = f"a world of {size[0]}×{size[1]} cells"
        reporter.error("PD607", message, node.span, "too small or too large", helps=[SIZE_RULE])
        return None
    return size


def covers_nothing(span: Span | None, what: str, size: Size, reporter: Reporter) -> None:
    """Report a shape that covers no cell of the world."""
    rows, columns = size
    label = f"{what} in the {rows}×{columns} world"
    fix = f"rows are 0 to {rows - 1}, columns 0 to {columns - 1}; rows come first"
    reporter.error("PD608", "a shape that covers no cell", span, label, helps=[fix])


def _read_statements(node: yaml_tree.Node, reader: Reader) -> tuple[Paint | Setting, ...]:
    """A list of statements, or a `|` block with one per line, of which some may be empty or comments."""
    spans: list[Span] = []
    if isinstance(node, yaml_tree.Sequence):
        for item in node.items:
            span = line_of(item, "statement", reader.reporter)
            if span is not None:
                spans.append(span)
            elif isinstance(item, yaml_tree.Mapping):
                not_a_statement(item, reader.reporter, "write `48:end` for `48:`, or quote the statement")
            elif isinstance(item, yaml_tree.Sequence):
                reader.shape(item, "a statement")
    elif isinstance(node, yaml_tree.Scalar) and node.style == "block":
        start = node.content.start
        for line in node.content.text.splitlines(keepends=True):
            if statement := line.split("#")[0].rstrip():
                spans.append(Span(node.content.source, start, start + len(statement)))
            start += len(line)
    elif not (isinstance(node, yaml_tree.Scalar) and node.text == ""):
        reader.shape(node, "a list of statements", "write `draw:`, and below it one `- statement` per line")
    return tuple(paint for span in spans if (paint := parse_statement(span, reader.reporter)))


def not_a_statement(item: yaml_tree.Mapping, reporter: Reporter, fix: str) -> None:
    message, label = "YAML reads this statement as a mapping", "a word followed by `:` is a key"
    reporter.error("PD605", message, first_line(item), label, helps=[fix])


def parse_statement(span: Span, reporter: Reporter) -> Paint | Setting | None:
    """The statement of a scene at `span`, or None after reporting bad syntax (PD605) or numbers (PD606)."""
    statement = read_statement(span, reporter)
    if statement is None:
        return None
    usage = STATEMENTS.get(statement.kind, "statements of scenes: " + ", ".join(STATEMENTS))
    shape = _fixed(statement, SETTING if statement.setting else usage, reporter)
    if statement.setting is not None:
        return replace(statement.setting, shape=shape) if shape else None
    element = statement.choice.children[0] if statement.choice and statement.choice.children else None
    return Paint(element.text, shape, statement.span, element.span) if shape and element else None


def _fixed(statement: Statement, usage: str, reporter: Reporter) -> Shape | None:
    """The shape of a statement, or None after reporting syntax that only tasks support."""
    faults: list[tuple[Span, str]] = []
    if statement.choice is not None and statement.choice.kind != "element":
        faults.append((statement.choice.span, "one element, by its name"))
    for written in statement.numbers:
        if written is not None and _varies(written):
            faults.append((written.span, "a number, written out"))
    if statement.where is not None:
        faults.append((statement.where.span, "a scene has no regions"))
    if statement.over is not None:
        faults.append((statement.over.span, "a scene cannot limit painting to some elements"))
    if statement.kind not in STATEMENTS:
        faults = [(statement.span, f"`{statement.kind}` is a statement of tasks")]
    for span, label in faults:
        reporter.error("PD605", "scenes are not random", span, label, helps=(usage,))
    if faults:
        return None
    amounts = amounts_of(statement, {}, reporter)
    return None if amounts is None else Shape(statement.kind, constants(amounts) or ())


def _varies(written: Syntax) -> bool:
    """True if a number is named or drawn."""
    return written.kind in ("name", "range") or any(map(_varies, written.children))


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


def find_scene(path_or_name: str | Path) -> Scene:
    """A scene: from a file, ``FILE#NAME`` for one of several in it, or a shipped one by its name.

    Raises CompileError: PD601 for an unknown name, PD101 or PD102 for a file that cannot be read, or mistakes in the
    file.
    """
    text = str(path_or_name)
    file, _, name = text.rpartition("#") if "#" in text else (text, "", "")
    if file.lower().endswith((".yaml", ".yml")) or os.path.isfile(file):
        scenes = {scene.name: scene for scene in read_file(Path(file))}
        if not name and len(scenes) == 1:
            return next(iter(scenes.values()))
        if name in scenes:
            return scenes[name]
        message = f"no scene `{name}` in {file}" if name else f"{file} has {len(scenes)} scenes"
        which = f"choose one: {file}#{next(iter(scenes), 'NAME')}"
        raise failure("PD601", message, helps=suggest(name, scenes) if name else (which,))
    return shipped_scene(text)


def shipped_scene(name: str) -> Scene:
    """A scene that comes with the package. Raises CompileError (PD601) for an unknown name."""
    for scene in shipped_scenes(f"scene: {name}"):
        if scene.name == name:
            return scene
    scenes = [scene.name for scene in shipped_scenes()]
    helps = suggest(name, scenes) or ("shipped: " + ", ".join(scenes),)
    raise failure("PD601", f"unknown scene `{name[:80]}`", helps=helps)


def shipped_scenes(text: str = "") -> tuple[Scene, ...]:
    """The shipped scenes of files that contain a text, with files in alphabetical order."""
    paths = sorted(shipped("tasks/scenes").glob("*.yaml"))
    return tuple(scene for path in paths if text in path.read_text("utf-8") for scene in read_file(path))


def read_file(path: Path) -> tuple[Scene, ...]:
    """The scenes of a file. Raises CompileError: PD101 or PD102 if it cannot be read, and mistakes in it."""
    reporter = Reporter()
    source = read_source(path, reporter)
    reporter.raise_if_errors()
    assert source is not None
    return _checked_scenes(source)


@lru_cache(maxsize=32)
def _checked_scenes(source: Source) -> tuple[Scene, ...]:
    """The scenes of a text, cached because tasks look up shipped files repeatedly. Raises CompileError."""

    def read() -> tuple[Scene, ...]:
        reporter = Reporter()
        scenes = read_scenes(source, reporter)
        reporter.raise_if_errors()
        return scenes

    return persistent(f"scenes in {Path(source.name).name}", repr((source.name, source.text)), read)


def draw_start(scene: Scene, ruleset: Ruleset, *, size: Size | None = None) -> Start:
    """The start world of a scene.

    `size`, (rows, columns), replaces the scene's: shapes keep their cells; frames and open ends follow the edge.
    Statements run in order. A field is set in the cells of its shape whose element can have it; painting an element
    later resets the fields there. Raises CompileError for unknown elements (PD604) or fields (PD301), values of another
    kind (PD110) or out of range (PD402), settings that no cell can have (PD608), a bad `size` (PD607).
    """
    size = size or scene.size
    if not (min(size) >= 1 and size[0] * size[1] <= MAX_CELLS):
        raise failure("PD607", f"a world of {size[0]}×{size[1]} cells", helps=(SIZE_RULE,))
    reporter, ids = Reporter(), ids_by_name(ruleset.elements)
    # Unlike worlds, scenes may use qualified names of fields.
    paints = [
        replace(paint, name=slot_name(ruleset, paint.name)) if isinstance(paint, Setting) else paint
        for paint in scene.paints
    ]
    used = [(paint.element, paint.element_span) for paint in paints if isinstance(paint, Paint)]
    unknown: dict[str, Span | None] = {}
    for name, span in ((scene.fill, scene.fill_span), *used):
        if name not in ids:
            unknown.setdefault(name, span)
    helps = {name: suggest(name, {e.name for e in ruleset.elements}, "its elements") for name in unknown}
    others = [name for name in unknown if not "".join(helps[name]).startswith("did")]
    if len(others) > 1:  # not misspelled, but drawn for other rules
        names = ", ".join(f"`{name}`" for name in others)
        message = f"`{scene.name}` is drawn with elements that {ruleset.name} lacks: {names}"
        fix = "load rules that have them, or choose another scene"
        reporter.error("PD604", message, unknown[others[0]], "the first of them", helps=[fix])
    for name in (name for name in unknown if len(others) < 2 or name not in others):
        label = "not an element of this ruleset"
        reporter.error("PD604", f"unknown element `{name}`", unknown[name], label, helps=helps[name])
    slot_of = {slot.name: slot for slot in slots(ruleset) if slot.name != "element"}
    settings = [paint for paint in paints if isinstance(paint, Setting)]
    values = {setting: value_of(setting, slot_of, ids, ruleset, reporter) for setting in settings}
    reporter.raise_if_errors()
    fields: dict[str, FieldValues] = {}
    for name in dict.fromkeys(setting.name for setting in settings):
        slot = slot_of[name]
        unset = np.zeros((2, *size) if slot.planes == 2 else size, np.dtype(slot.dtype))
        fields[name] = FieldValues(unset, np.zeros(size, np.bool_))
    drawn = np.full(size, ids[scene.fill], dtype=np.uint8)
    for paint in paints:
        cells = mask(paint.shape, size)
        if isinstance(paint, Paint):
            drawn[cells] = ids[paint.element]
            for name, field in fields.items():
                if slot_of[name].travels:
                    field.where[cells] = False
            continue
        owners = holders(ruleset, slot_of[paint.name])
        if owners is not None:
            cells = cells & np.isin(drawn, sorted(owners))
        if not cells.any():
            names = ", ".join(f"`{e.name}`" for e in ruleset.elements if e.id in (owners or ()))
            label = f"no cell of the shape can have `{paint.name}`"
            fix = f"only these elements have it: {names}; paint them first"
            reporter.error("PD608", f"`{paint.name}` is set in no cell", paint.span, label, helps=[fix])
        fields[paint.name].values[..., cells] = np.array(values[paint])[:, None]
        fields[paint.name].where[cells] = True
    reporter.raise_if_errors()
    return Start(drawn, fields)


def value_of(
    setting: Setting,
    slot_of: Mapping[str, Slot],
    ids: Mapping[str, int],
    ruleset: Ruleset,
    reporter: Reporter,
) -> tuple[float, ...]:
    """The components of a setting's value; empty after a report."""
    from powderdsl.model.examples import WordProblem, read_word  # brings the checker

    slot, name = slot_of.get(setting.name), setting.name
    if slot is None:
        if ruleset.property(name) is not None:
            label = "it follows from the element"
            reporter.error("PD407", f"no rule assigns `{name}`", setting.name_span, label)
        else:
            helps, label = suggest(name, slot_of, "its fields"), "not a field of this ruleset"
            reporter.error("PD301", f"unknown field `{name}`", setting.name_span, label, helps=helps)
        return ()
    try:
        return tuple(low for low, _ in read_word(setting.value, slot.kind, ids))
    except WordProblem as problem:
        reporter.error(problem.code, problem.message, setting.value_span, problem.label, helps=problem.helps)
        return ()
