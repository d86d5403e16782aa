"""A value of a field as one word, without blanks: in tests that draw fields, and in scenes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

from powderdsl.diagnostics import suggest
from powderdsl.model.builtins import DIRECTIONS, OCTANTS
from powderdsl.model.expressions.symbols import clamped_number
from powderdsl.model.types import Kind

FORMS = {
    "int": ("an integer", "an integer such as `3` or `-2`"),
    "flag": ("a flag", "`yes` or `no`"),
    "element": ("an element", "an element's name"),
    "direction": ("a direction", "a neighbor such as `left` or `above.right`"),
    "real": ("a number", "a number such as `3` or `-0.25`"),
    "vec2": ("a vector", "rows and columns, such as `1.5,-2`"),
}
"""For each kind: a noun for its words, and how they are written."""

_FLAGS = {"yes": 1, "true": 1, "no": 0, "false": 0}
_WHOLE = re.compile(r"-?[0-9]{1,7}")
_NUMBER = re.compile(r"-?[0-9]{1,7}(\.[0-9]{1,20})?([eE][-+]?[0-9]{1,2})?")

Bounds = tuple[float, float]
"""The lowest and the highest value that a word allows: twice the same, but for a range."""


class WordProblem(Exception):
    """A word is not a value of its kind. Has a code, a message, a label, and maybe fixes."""

    def __init__(self, code: str, message: str, label: str, *helps: str):
        super().__init__(message)
        self.code = code
        self.message = message
        self.label = label
        self.helps = helps


def read_word(word: str, kind: Kind, ids: Mapping[str, int], *, ranges: bool = False) -> tuple[Bounds, ...]:
    """The bounds of each component of the value: two of a vector, one of other kinds.

    Args:
        ids: what words stand for which element.
        ranges: numbers may be ranges, `1..3`.

    Raises:
        WordProblem: it is not a value of this kind.
    """
    vector = kind.name == "vec2"
    enclosed = vector and word.startswith("(") and word.endswith(")")
    parts = (word[1:-1] if enclosed else word).split(",") if vector else [word]
    found = [bounds for part in parts if (bounds := _bounds(part, kind, ids, ranges)) is not None]
    if not len(found) == len(parts) == 1 + vector:
        noun, form = FORMS[kind.name]
        helps = (
            suggest(word, [name for name in ids if len(name) > 1], "elements")
            if kind.name == "element"
            else ()
        )
        raise WordProblem("PD110", f"`{word}` is not {noun}", f"expected {form}", *helps)
    return tuple(found)


def _bounds(word: str, kind: Kind, ids: Mapping[str, int], ranges: bool) -> Bounds | None:
    value: int | None = None
    match kind.name:
        case "flag":
            value = _FLAGS.get(word)
        case "element":
            value = ids.get(word)
        case "direction":
            value = _direction(word)
        case _:
            low, dots, high = word.partition("..")
            if dots and not ranges:
                return None
            ends = _number(low, kind), _number(high if dots else low, kind)
            if ends[0] is None or ends[1] is None:
                return None
            if ends[0] > ends[1]:
                raise WordProblem(
                    "PD402", "a range that runs backwards", f"{low} is above {high}", f"write `{high}..{low}`"
                )
            return ends[0], ends[1]
    return None if value is None else (value, value)


def _direction(word: str) -> int | None:
    steps = [DIRECTIONS.get(step) for step in word.split(".")]
    rows, columns = sum(step[0] for step in steps if step), sum(step[1] for step in steps if step)
    return OCTANTS.index((rows, columns)) if None not in steps and (rows, columns) in OCTANTS else None


def _number(word: str, kind: Kind) -> float | None:
    whole = kind.name == "int"
    if not (_WHOLE if whole else _NUMBER).fullmatch(word):
        return None
    value = Fraction(word)
    if not kind.lo <= value <= kind.hi:
        fix = "write a number in this range, or widen it where it is declared"
        raise WordProblem(
            "PD402", f"{word} lies outside {kind}", f"the range is {kind.lo:g}..{kind.hi:g}", fix
        )
    if whole:
        return int(value)
    return float(clamped_number(value, kind))


def direction_word(octant: int) -> str:
    """A direction as drawings have it: `above.right`."""
    rows, columns = OCTANTS[octant]
    sides = {name: offset for name, offset in DIRECTIONS.items() if name != "here"}
    return ".".join(name for name, offset in sides.items() if offset in ((rows, 0), (0, columns)))
