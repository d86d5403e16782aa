"""Scene files: start worlds drawn in one-line statements, later ones over earlier ones.

    scene: NAME
    about: What it shows, in a sentence.
    size: [64, 64]                                     # rows, columns
    fill: ELEMENT
    draw:
      - line ELEMENT from (63, 5) to (32, 5) width 3   # points are (row, column)
      - disk ELEMENT at (32, 32) radius 10
      - box ELEMENT rows 32:64                         # a:b leaves b out; all columns unless it says so
      - box ELEMENT rows 48:end columns :16            # `48:` means the same, but YAML takes it for a key
      - frame ELEMENT

`draw` may also be a `|` block, one statement a line. A file with several scenes has a list under `scenes`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import Label, Reporter, Source, Span, suggest
from powderdsl.model.schema import Key, Reader, first_line
from powderdsl.model.types import Element
from powderdsl.syntax import yaml_tree
from powderdsl.worlds.files import failure, read_source
from powderdsl.worlds.raster import MAX_CELLS, Paint, Size, mask, paint
from powderdsl.worlds.statements import parse_statement

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


class HasElements(Protocol):
    """A ruleset, as far as scenes need one."""

    @property
    def elements(self) -> Sequence[Element]: ...


@dataclass(frozen=True)
class Scene:
    """A drawn world. Elements are names as written: only `draw_scene` needs to know a ruleset."""

    name: str
    about: str
    size: Size
    fill: str
    paints: tuple[Paint, ...]
    span: Span = field(compare=False, repr=False)
    fill_span: Span = field(compare=False, repr=False)


def load_scene(
    path_or_name: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene: a file, ``FILE#NAME`` for one of several, or a shipped scene's name.

    With another `size` shapes stay where they are, a frame and open ends follow the edge. Raises CompileError
    with everything that is wrong.
    """
    return draw_scene(find_scene(path_or_name), ruleset, size=size)


def load_scenes(
    path: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> dict[str, NDArray[np.uint8]]:
    """Every scene of a file by name, uint8 [H, W] each, in the order of the file. Raises CompileError."""
    reporter = Reporter()
    drawn = {scene.name: _draw(scene, ruleset, size, reporter) for scene in _read_file(Path(path))}
    reporter.raise_if_errors()
    return {name: ids for name, ids in drawn.items() if ids is not None}


def find_scene(path_or_name: str | Path) -> Scene:
    """A scene from a file, or a shipped one by name. Raises CompileError (PD601 for an unknown name)."""
    text = str(path_or_name)
    file, _, name = text.rpartition("#") if "#" in text else (text, "", "")
    if file.lower().endswith((".yaml", ".yml")) or Path(file).is_file():
        scenes = {scene.name: scene for scene in _read_file(Path(file))}
        if not name and len(scenes) == 1:
            return next(iter(scenes.values()))
        if name in scenes:
            return scenes[name]
        helps = suggest(name, scenes) if name else ()
        example = next(iter(scenes), "NAME")
        raise failure(
            "PD601",
            f"no scene `{name}` in {file}" if name else f"{file} has {len(scenes)} scenes",
            helps=helps or (f"say which: {file}#{example}",),
        )
    shipped = {scene.name: scene for scene in shipped_scenes()}
    if text in shipped:
        return shipped[text]
    raise failure(
        "PD601",
        f"unknown scene `{text}`",
        helps=suggest(text, shipped) or ("shipped: " + ", ".join(shipped),),
    )


def shipped_scenes() -> tuple[Scene, ...]:
    """The scenes that come with the package, files in alphabetical order."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "data" / "tasks" / "scenes"
    directory = installed if installed.is_dir() else package.parent / "tasks" / "scenes"
    return tuple(scene for path in sorted(directory.glob("*.yaml")) for scene in _read_file(path))


def _read_file(path: Path) -> tuple[Scene, ...]:
    reporter = Reporter()
    source = read_source(path, reporter)
    scenes = read_scenes(source, reporter) if source else ()
    reporter.raise_if_errors()
    return scenes


def draw_scene(scene: Scene, ruleset: HasElements, *, size: Size | None = None) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene. Raises CompileError: PD604 unknown elements, PD607 a bad `size`."""
    reporter = Reporter()
    ids = _draw(scene, ruleset, size, reporter)
    reporter.raise_if_errors()
    assert ids is not None
    return ids


def _draw(
    scene: Scene, ruleset: HasElements, size: Size | None, reporter: Reporter
) -> NDArray[np.uint8] | None:
    height, width = size or scene.size
    if not (height >= 1 and width >= 1 and height * width <= MAX_CELLS):
        raise failure("PD607", f"a world of {height}×{width} cells", helps=(_SIZE_RULE,))
    ids = {element.qualified: element.id for element in ruleset.elements}
    ids |= {element.name: element.id for element in ruleset.elements}
    used = [(scene.fill, scene.fill_span), *((one.element, one.element_span) for one in scene.paints)]
    unknown = [(name, span) for name, span in used if name not in ids]
    for name, span in unknown:
        reporter.error(
            "PD604",
            f"unknown element `{name}`",
            span,
            "not an element of this ruleset",
            helps=suggest(name, {element.name for element in ruleset.elements}, "its elements"),
        )
    return None if unknown else paint((height, width), ids[scene.fill], scene.paints, ids)


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


_SIZE_RULE = f"a world has at least one row and one column, and at most {MAX_CELLS:,} cells"


def _read_size(node: yaml_tree.Node, reporter: Reporter) -> Size | None:
    items = node.items if isinstance(node, yaml_tree.Sequence) else ()
    words = [item.text for item in items if isinstance(item, yaml_tree.Scalar)]
    numbers = [int(word) for word in words if re.fullmatch(r"[0-9]{1,9}", word)]
    if not (len(items) == len(numbers) == 2):
        reporter.error(
            "PD607",
            "a size is [rows, columns]",
            first_line(node),
            "not two whole numbers",
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
            helps=[_SIZE_RULE],
        )
        return None
    return rows, columns


def _check_coverage(paints: Iterable[Paint], size: Size, reporter: Reporter) -> None:
    for one in paints:
        if not mask(one.shape, size).any():
            reporter.error(
                "PD608",
                "a shape that covers no cell",
                one.span,
                f"nothing of it lies in the {size[0]}×{size[1]} world",
                helps=[f"rows are 0 to {size[0] - 1}, columns 0 to {size[1] - 1}; rows come first"],
            )


def _read_statements(node: yaml_tree.Node, reader: Reader) -> tuple[Paint, ...]:
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
