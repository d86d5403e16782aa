"""Scene files: YAML -> scenes. Everything is checked but element names, which need a ruleset."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.model.schema import Key, Reader, first_line
from powderdsl.syntax import yaml_tree
from powderdsl.worlds.raster import MAX_CELLS, Paint, Setting, Shape, Size, mask
from powderdsl.worlds.scene.amounts import integers
from powderdsl.worlds.scene.statements import (
    SETTING,
    STATEMENTS,
    Statement,
    read_setting,
    read_statement,
    text_span,
)

SCENE_KEYS = {
    "scene": Key("word", "the scene's name", True),
    "about": Key("text", "what it shows, in a sentence"),
    "size": Key("any", "[rows, columns]", True),
    "fill": Key("word", "the element that is everywhere before anything is drawn", True),
    "draw": Key("any", "statements, one a line, later ones over earlier ones"),
}
"""The keys of a scene."""

FILE_KEYS = {
    "scenes": Key("list", "the scenes of the file", True),
    "about": Key("text", "what they are for, in a sentence"),
}
"""The keys of a file with several scenes."""


SIZE_RULE = f"a world has at least one row and one column, and at most {MAX_CELLS:,} cells"


@dataclass(frozen=True)
class Scene:
    """A drawn world. Elements are names as written: only `draw_scene` needs to know a ruleset."""

    name: str
    about: str
    size: Size
    fill: str
    paints: tuple[Paint | Setting, ...]
    span: Span = field(compare=False, repr=False)
    fill_span: Span = field(compare=False, repr=False)


def read_scenes(source: Source, reporter: Reporter) -> tuple[Scene, ...]:
    """The scenes of a file. Everything but element names is checked; what is wrong goes to the reporter."""
    tree = yaml_tree.parse_yaml(source, reporter)
    if tree is None:
        if not reporter.has_errors:
            helps = ["a scene starts with `scene: NAME`"]
            reporter.error("PD107", f"{source.name} is empty", None, helps=helps)
        return ()
    reader = Reader(reporter, {"scene": SCENE_KEYS, "file": FILE_KEYS})
    if not isinstance(tree, yaml_tree.Mapping) or tree.get("scenes") is None:
        scene = _read_scene(tree, reader)
        return (scene,) if scene else ()
    entries = reader.mapping(tree, "file", "a file of scenes")
    scenes: dict[str, Scene] = {}
    items = entries["scenes"][1] if "scenes" in entries else yaml_tree.Sequence((), tree.span)
    if not isinstance(items, yaml_tree.Sequence):
        reader.shape(items, "a list of scenes")
        return ()
    for item in items.items:
        scene = _read_scene(item, reader)
        if scene and scene.name in scenes:
            first = Label(scenes[scene.name].span, "first one")
            message = f"two scenes are called `{scene.name}`"
            reporter.error("PD302", message, scene.span, "second one", secondary=[first])
        elif scene:
            scenes[scene.name] = scene
    return tuple(scenes.values())


def _read_scene(node: yaml_tree.Node, reader: Reader) -> Scene | None:
    reporter = reader.reporter
    entries = reader.mapping(node, "scene", "a scene")
    name, fill = reader.scalar(entries, "scene"), reader.scalar(entries, "fill")
    named = name is not None and can_be_called(name, "a scene", reporter)
    size = _read_size(entries["size"][1], reporter) if "size" in entries else None
    paints = _read_statements(entries["draw"][1], reader) if "draw" in entries else ()
    if size:
        _check_coverage(paints, size, reporter)
    if not (name and named and size and fill):
        return None
    return Scene(name.text, reader.text(entries, "about"), size, fill.text, paints, name.span, fill.span)


def can_be_called(name: yaml_tree.Scalar, what: str, reporter: Reporter) -> bool:
    """Whether a word can name a scene or a task; reports PD111 if not."""
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}", name.text):
        return True
    label = "letters, digits, `-` and `_`, up to 60"
    reporter.error("PD111", f"{what}'s name is a word", name.span, label)
    return False


def two_integers(node: yaml_tree.Node) -> Size | None:
    """The numbers of a list of two integers of 0 or more, or None."""
    items = node.items if isinstance(node, yaml_tree.Sequence) else ()
    words = [item.text for item in items if isinstance(item, yaml_tree.Scalar)]
    numbers = [int(word) for word in words if re.fullmatch(r"[0-9]{1,9}", word)]
    return (numbers[0], numbers[1]) if len(items) == len(numbers) == 2 else None


def _read_size(node: yaml_tree.Node, reporter: Reporter) -> Size | None:
    size = two_integers(node)
    if size is None:
        helps = ["size: [64, 64]"]
        reporter.error(
            "PD607", "a size is [rows, columns]", first_line(node), "not two integers", helps=helps
        )
    elif 0 in size or size[0] * size[1] > MAX_CELLS:
        message = f"a world of {size[0]}×{size[1]} cells"
        reporter.error("PD607", message, node.span, "too small or too large", helps=[SIZE_RULE])
        return None
    return size


def _check_coverage(paints: Iterable[Paint | Setting], size: Size, reporter: Reporter) -> None:
    for one in paints:
        if not mask(one.shape, size).any():
            covers_nothing(one.span, "nothing of it lies", size, reporter)


def covers_nothing(span: Span | None, what: str, size: Size, reporter: Reporter) -> None:
    """Report a shape of which nothing lies in the world."""
    rows, columns = size
    reporter.error(
        "PD608",
        "a shape that covers no cell",
        span,
        f"{what} in the {rows}×{columns} world",
        helps=[f"rows are 0 to {rows - 1}, columns 0 to {columns - 1}; rows come first"],
    )


def _read_statements(node: yaml_tree.Node, reader: Reader) -> tuple[Paint | Setting, ...]:
    """A list of statements, or a `|` block with one a line."""
    spans: list[Span] = []
    if isinstance(node, yaml_tree.Sequence):
        for item in node.items:
            span = text_span(item, reader.reporter)
            if span is not None:
                spans.append(span)
            elif isinstance(item, yaml_tree.Mapping):
                not_a_statement(item, reader.reporter, "say `48:end` for `48:`, or quote the statement")
            elif isinstance(item, yaml_tree.Sequence):
                reader.shape(item, "a statement")
    elif isinstance(node, yaml_tree.Scalar) and node.style == "block":
        spans = _lines(node.content)
    elif not (isinstance(node, yaml_tree.Scalar) and node.text == ""):
        reader.shape(node, "a list of statements", "write `draw:` and below it one `- statement` a line")
    return tuple(one for span in spans if (one := parse_statement(span, reader.reporter)))


def not_a_statement(item: yaml_tree.Mapping, reporter: Reporter, fix: str) -> None:
    """Report a mapping where a statement should stand."""
    message, label = "YAML reads this statement as a mapping", "a `:` at the end of a word makes it a key"
    reporter.error("PD605", message, first_line(item), label, helps=[fix])


def _lines(block: Span) -> list[Span]:
    """The lines of a block that are neither empty nor a comment."""
    spans, start = [], block.start
    for line in block.text.splitlines(keepends=True):
        if line.split("#")[0].strip():
            spans.append(Span(block.source, start, start + len(line)))
        start += len(line)
    return spans


def parse_statement(span: Span, reporter: Reporter) -> Paint | Setting | None:
    """The statement of a scene at `span`, or None after reporting bad syntax (PD605) or numbers (PD606)."""
    if ":=" in span.text:
        setting = read_setting(span, reporter)
        if setting is None:
            return None
        shape = _fixed(setting.shape, SETTING, reporter) if setting.shape else Shape("fill")
        name, value = setting.name, setting.value
        if shape is None:
            return None
        return Setting(name.text, value.text, shape, setting.span, name.span, value.span)
    found = read_statement(span, reporter)
    if found is None:
        return None
    usage = STATEMENTS.get(found.kind, "statements of scenes: " + ", ".join(STATEMENTS))
    shape = _fixed(found, usage, reporter)
    element = found.choice.names[0] if found.choice and found.choice.names else None
    return Paint(element.text, shape, found.span, element.span) if shape and element else None


def _fixed(statement: Statement, usage: str, reporter: Reporter) -> Shape | None:
    """The shape of a statement, or None after reporting what only generators of tasks may say."""
    faults: list[tuple[Span | None, str]] = []
    if statement.choice is not None and statement.choice.how != "one":
        faults.append((statement.choice.span, "one element, by its name"))
    drawn = [one for one in statement.numbers if one is not None and not one.is_number]
    faults += [(one.span, "a number, written out") for one in drawn]
    if statement.where is not None:
        faults.append((statement.where.span, "a scene has no regions"))
    if statement.over is not None:
        faults.append((statement.over.span, "a scene paints over everything"))
    if statement.kind not in STATEMENTS:
        faults = [(statement.span, f"`{statement.kind}` is a statement of tasks")]
    for span, label in faults:
        reporter.error("PD605", "a scene is the same every time", span, label, helps=(usage,))
    return None if faults else Shape(statement.kind, integers(statement.numbers) or ())
