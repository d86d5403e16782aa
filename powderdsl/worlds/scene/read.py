"""Scene files: YAML -> scenes. Everything is checked but element names, which need a ruleset."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from powderdsl.diagnostics import Label, Reporter, Source, Span, suggest
from powderdsl.model.schema import Key, Reader, first_line
from powderdsl.syntax import yaml_tree
from powderdsl.worlds.raster import MAX_CELLS, Paint, Setting, Size, mask
from powderdsl.worlds.scene.fixed import parse_statement

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
    reader = Reader(reporter)
    if tree is None:
        if not reporter.has_errors:
            reporter.error(
                "PD107", f"{source.name} is empty", None, helps=["a scene starts with `scene: NAME`"]
            )
        return ()
    if not isinstance(tree, yaml_tree.Mapping):
        reader.shape(tree, "a scene: a mapping that starts with `scene: NAME`")
        return ()
    if tree.get("scenes") is None:
        scene = _read_scene(tree, reader)
        return (scene,) if scene else ()
    items = _entries(tree, FILE_KEYS, "a file of scenes", reporter)["scenes"]
    if not isinstance(items, yaml_tree.Sequence):
        reader.shape(items, "a list of scenes")
        return ()
    scenes: dict[str, Scene] = {}
    for item in items.items:
        scene = _read_scene(item, reader)
        if scene and scene.name in scenes:
            reporter.error(
                "PD302",
                f"two scenes are called `{scene.name}`",
                scene.span,
                "second one",
                secondary=[Label(scenes[scene.name].span, "first one")],
            )
        elif scene:
            scenes[scene.name] = scene
    return tuple(scenes.values())


def _entries(
    node: yaml_tree.Mapping, keys: dict[str, Key], what: str, reporter: Reporter
) -> dict[str, yaml_tree.Node]:
    """The values of known keys; unknown and missing keys are reported."""
    found = {}
    for key, value in node.entries:
        if key.text in keys:
            found[key.text] = value
        else:
            reporter.error(
                "PD108",
                f"unknown key `{key.text}`",
                key.span,
                f"not a key of {what}",
                helps=suggest(key.text, keys, f"keys of {what}"),
            )
    for name, row in keys.items():
        if row.required and name not in found:
            start = node.span.start
            reporter.error(
                "PD109",
                f"{what} lacks `{name}`",
                Span(node.span.source, start, start + 1),
                f"`{name}` is missing",
                helps=[f"`{name}`: {row.about}"],
            )
    return found


def _read_scene(node: yaml_tree.Node, reader: Reader) -> Scene | None:
    if not isinstance(node, yaml_tree.Mapping):
        reader.shape(node, "a scene: a mapping that starts with `scene: NAME`")
        return None
    reporter = reader.reporter
    entries = _entries(node, SCENE_KEYS, "a scene", reporter)
    words: dict[str, yaml_tree.Scalar] = {}
    for key in ("scene", "about", "fill"):
        value = entries.get(key)
        if isinstance(value, yaml_tree.Scalar):
            words[key] = value
        elif value is not None:
            reader.shape(value, f"a single value for `{key}`")
    name, fill = words.get("scene"), words.get("fill")
    if name and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}", name.text):
        reporter.error(
            "PD111", "a scene's name is a word", name.span, "letters, digits, `-` and `_`, up to 60"
        )
        name = None
    size = _read_size(entries["size"], reporter) if "size" in entries else None
    paints = _read_statements(entries["draw"], reader) if "draw" in entries else ()
    if size:
        _check_coverage(paints, size, reporter)
    if not (name and size and fill):
        return None
    about = " ".join(words["about"].text.split()) if "about" in words else ""
    return Scene(name.text, about, size, fill.text, paints, name.span, fill.span)


def _read_size(node: yaml_tree.Node, reporter: Reporter) -> Size | None:
    items = node.items if isinstance(node, yaml_tree.Sequence) else ()
    words = [item.text for item in items if isinstance(item, yaml_tree.Scalar)]
    numbers = [int(word) for word in words if re.fullmatch(r"[0-9]{1,9}", word)]
    if not (len(items) == len(numbers) == 2):
        reporter.error(
            "PD607",
            "a size is [rows, columns]",
            first_line(node),
            "not two integers",
            helps=["size: [64, 64]"],
        )
        return None
    rows, columns = numbers
    if rows < 1 or columns < 1 or rows * columns > MAX_CELLS:
        reporter.error(
            "PD607",
            f"a world of {rows}×{columns} cells",
            node.span,
            "too small or too large",
            helps=[SIZE_RULE],
        )
        return None
    return rows, columns


def _check_coverage(paints: Iterable[Paint | Setting], size: Size, reporter: Reporter) -> None:
    for one in paints:
        if not mask(one.shape, size).any():
            reporter.error(
                "PD608",
                "a shape that covers no cell",
                one.span,
                f"nothing of it lies in the {size[0]}×{size[1]} world",
                helps=[f"rows are 0 to {size[0] - 1}, columns 0 to {size[1] - 1}; rows come first"],
            )


def _read_statements(node: yaml_tree.Node, reader: Reader) -> tuple[Paint | Setting, ...]:
    """A list of statements, or a `|` block with one a line."""
    spans: list[Span] = []
    if isinstance(node, yaml_tree.Sequence):
        for item in node.items:
            if isinstance(item, yaml_tree.Scalar) and _has_escapes(item):
                reader.reporter.error(
                    "PD605", "escapes in a quoted statement", item.span, "escaped or doubled quotes"
                )
            elif isinstance(item, yaml_tree.Scalar):
                spans.append(item.content)
            elif isinstance(item, yaml_tree.Mapping):
                reader.reporter.error(
                    "PD605",
                    "YAML reads this statement as a mapping",
                    first_line(item),
                    "a `:` at the end of a word makes it a key",
                    helps=["say `48:end` for `48:`, or quote the statement"],
                )
            else:
                reader.shape(item, "a statement")
    elif isinstance(node, yaml_tree.Scalar) and node.style == "block":
        spans = _lines(node.content)
    elif not (isinstance(node, yaml_tree.Scalar) and node.text == ""):
        reader.shape(node, "a list of statements", "write `draw:` and below it one `- statement` a line")
    return tuple(one for span in spans if (one := parse_statement(span, reader.reporter)))


def _has_escapes(item: yaml_tree.Scalar) -> bool:
    """Whether the text differs from what stands in the file, so that carets would go astray."""
    return item.style == "quoted" and item.content.text.split() != item.text.split()


def _lines(block: Span) -> list[Span]:
    """The lines of a block that are neither empty nor a comment."""
    spans, start = [], block.start
    for line in block.text.splitlines(keepends=True):
        if line.split("#")[0].strip():
            spans.append(Span(block.source, start, start + len(line)))
        start += len(line)
    return spans
