"""Stamps: pictures that a task file draws in ASCII, or names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import CompileError, suggest
from powderdsl.model.schema import Reader
from powderdsl.model.types import Element, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.sources import path_beside
from powderdsl.tasks.task import MAX_SIDE, Stamp
from powderdsl.worlds.ascii import load_ascii, parse_ascii
from powderdsl.worlds.image import read_image
from powderdsl.worlds.raster import Setting
from powderdsl.worlds.scene import draw_scene, find_scene, shipped_scenes

LEAVE = 255
"""In a stamp: the cell stays as it is."""


def read_stamp(key: yaml_tree.Scalar, node: yaml_tree.Node, reader: Reader, ruleset: Ruleset) -> Stamp | None:
    """The picture of a stamp, or None after a report."""
    entries = reader.mapping(node, "stamp", "a stamp")
    art, scene = reader.scalar(entries, "art"), reader.scalar(entries, "scene")
    if (art is None) == (scene is None):
        label = "neither `art` nor `scene`" if art is None else "both `art` and `scene`"
        reader.reporter.error("PD109", f"the stamp `{key.text}` needs one picture", key.span, label)
        return None
    ids = _named(scene, reader, ruleset) if scene is not None else None
    if art is not None:
        ids = _drawn(art, _legend(entries, reader), reader, ruleset)
    if ids is None:
        return None
    if max(ids.shape) > MAX_SIDE:
        message = f"a stamp of {ids.shape[0]}×{ids.shape[1]} cells"
        reader.reporter.error("PD607", message, key.span, "too large")
        return None
    return Stamp(key.text, tuple(map(tuple, ids.tolist())))


def _legend(entries: dict[str, tuple[yaml_tree.Scalar, yaml_tree.Node]], reader: Reader) -> dict[str, str]:
    node = entries["legend"][1] if "legend" in entries else None
    found = {}
    for key, value in node.entries if isinstance(node, yaml_tree.Mapping) else ():
        if len(key.text) != 1 or not isinstance(value, yaml_tree.Scalar):
            reader.reporter.error("PD110", "a legend has single characters", key.span, "not one character")
        else:
            found[key.text] = value.text
    return found


def _drawn(
    art: yaml_tree.Scalar, legend: dict[str, str], reader: Reader, ruleset: Ruleset
) -> NDArray[np.uint8] | None:
    """ASCII art, in which `?` leaves cells as they are."""
    hole = replace(ruleset.elements[0], name="?", pack="?", id=LEAVE, glyph="?")
    elements: list[Element] = [one for one in ruleset.elements if one.id != LEAVE]
    if art.style == "quoted" and art.content.text.split() != art.text.split():
        helps = ["write `art: |`, and the rows below it"]
        reader.reporter.error("PD107", "art with escapes", art.span, "quoted, on one line", helps=helps)
        return None
    try:
        return parse_ascii(art.content, [*elements, hole], reader.reporter, {"?": "?", **legend})
    except CompileError as error:
        for one in error.diagnostics:
            reader.reporter.error(one.code, one.message, one.primary.span or art.span, helps=one.helps)
    except ValueError as error:
        reader.reporter.error("PD110", str(error), art.span)
    return None


def _named(word: yaml_tree.Scalar, reader: Reader, ruleset: Ruleset) -> NDArray[np.uint8] | None:
    """A shipped scene, or a file beside the task's: .yaml, .png or .txt."""
    file, _, name = word.text.rpartition("#") if "#" in word.text else (word.text, "", "")
    suffix = Path(file).suffix.lower()
    known = [one.name for one in shipped_scenes()]
    if word.text not in known and suffix not in (".png", ".txt", ".yaml", ".yml"):
        helps = suggest(word.text, known) or ("shipped: " + ", ".join(known),)
        reader.reporter.error("PD601", f"unknown scene `{word.text[:80]}`", word.span, helps=helps)
        return None
    path = word.text if word.text in known else path_beside(file, word.span, reader.reporter)
    if path is None:
        return None
    beside = f"{path}#{name}" if name else str(path)
    try:
        if suffix == ".png":
            return read_image(beside, ruleset.elements)
        if suffix == ".txt":
            return load_ascii(beside, ruleset.elements)
        found = find_scene(beside)
        setting = next((one for one in found.paints if isinstance(one, Setting)), None)
        if setting is not None:
            message = f"the scene `{found.name}` sets `{setting.name}`"
            reader.reporter.error("PD605", message, word.span, "a picture is made of elements only")
            return None
        return draw_scene(found, ruleset)
    except CompileError as error:
        for one in error.diagnostics:
            reader.reporter.error(one.code, one.message, word.span, notes=one.notes, helps=one.helps)
    return None
