"""Worlds as ASCII art: one character per cell, by the elements' glyphs or a legend. Whitespace is ignored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.types import Element
from powderdsl.syntax.sources import read_source
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import MAX_CELLS

MAX_BYTES = 4 * MAX_CELLS
"""Maximum size of a file: the largest world, with whitespace between its cells."""


def parse_ascii(
    art: Span, elements: Sequence[Element], reporter: Reporter, legend: Mapping[str, str] | None = None
) -> NDArray[np.uint8] | None:
    """The ids uint8 [H, W] of a drawing in a text, or None after reporting mistakes.

    Empty lines are skipped. Reports unknown characters (PD610), uneven rows (PD611), and empty or too large worlds
    (PD607).

    `legend`: names of elements by character, which override their glyphs. Raises CompileError (PD604) if the legend
    names an unknown element.
    """
    ids = _characters(elements, legend or {})
    rows: list[str] = []
    offset, good = art.start, True
    seen: set[str] = set()
    names = {element.id: element.name for element in elements}
    for line in art.text.splitlines(keepends=True):
        start, offset = offset, offset + len(line)
        cells = "".join(line.split())
        if not cells:
            continue
        unknown = set(cells) - ids.keys()
        for character in sorted(unknown - seen):
            place = start + line.index(character)
            known = "  ".join(f"{character} {names[number]}" for character, number in ids.items())
            span, message = Span(art.source, place, place + 1), f"unknown character `{character}`"
            reporter.error("PD610", message, span, "no element has it", helps=[f"known: {known}"])
        seen |= unknown
        uneven = bool(rows) and len(cells) != len(rows[0])
        if uneven:
            begin = start + len(line) - len(line.lstrip())
            span = Span(art.source, begin, start + len(line.rstrip()))
            message = f"a row of {len(cells)} cells in a world of {len(rows[0])} columns"
            reporter.error("PD611", message, span, f"the first row has {len(rows[0])} cells")
        good = good and not unknown and not uneven
        rows.append(cells)
    height, width = len(rows), len(rows[0]) if rows else 0
    if not 0 < height * width <= MAX_CELLS:
        span, label = Span(art.source, art.start, art.start + 1), f"1 to {MAX_CELLS:,} cells"
        reporter.error("PD607", f"a world of {height}×{width} cells", span, label)
        return None
    if not good:
        return None
    decode = {ord(character): chr(number) for character, number in ids.items()}
    text = "".join(rows).translate(decode)
    return np.frombuffer(text.encode("latin-1"), dtype=np.uint8).reshape(len(rows), -1).copy()


def load_ascii(path: str | Path, elements: Sequence[Element]) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a text file. Raises CompileError as `parse_ascii` reports; PD101, PD102 if it cannot be read."""
    reporter = Reporter()
    source = read_source(Path(path), reporter, limit=MAX_BYTES)
    ids = parse_ascii(Span(source, 0, len(source.text)), elements, reporter) if source else None
    reporter.raise_if_errors()
    assert ids is not None
    return ids


def write_ascii(ids: Any, elements: Sequence[Element]) -> str:
    """Rows of characters for ids [H, W], each with a line break. `load_ascii` reads them back."""
    characters = {number: character for character, number in _characters(elements, {}).items()}
    return "".join("".join(map(characters.__getitem__, row)) + "\n" for row in ids.tolist())


def ids_by_name(elements: Sequence[Element]) -> dict[str, int]:
    """Element ids by plain and qualified name."""
    ids = {element.qualified: element.id for element in elements}
    return ids | {element.name: element.id for element in elements}


def _characters(elements: Sequence[Element], legend: Mapping[str, str]) -> dict[str, int]:
    """Element ids by character: the legend's characters, then glyphs that the legend does not use."""
    by_name = ids_by_name(elements)
    characters: dict[str, int] = {}
    for character, name in legend.items():
        if name not in by_name:
            helps = suggest(name, {element.name for element in elements}, "elements")
            raise failure("PD604", f"unknown element `{name}` in a legend", helps=helps)
        characters[character] = by_name[name]
    for element in elements:
        characters.setdefault(element.glyph, element.id)
    return characters
