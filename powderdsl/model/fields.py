"""Values of fields as written in files: words and grids."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import chain

from powderdsl.diagnostics import Label, Span, suggest
from powderdsl.model.builtins import DIRECTIONS, OCTANTS
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.expressions.operators import Poisoned, Unresolved
from powderdsl.model.expressions.symbols import clamped_number
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import Cell, FieldGrid, Kind
from powderdsl.syntax.yaml_tree import Scalar

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


DEFAULT = "."
"""The word of a cell that is as a fresh cell of its element has it."""

ANYTHING = "?"
"""The word of an expected cell that is not looked at."""


class GridReader:
    """Reads the drawn fields of one test; all mistakes are reported, and words that come again are read once."""

    def __init__(self, typer: Typer, pack: str, legend: Mapping[str, str]):
        self.typer = typer
        self.pack = pack
        self.legend = legend
        elements, names = typer.symbols.composition.elements, typer.symbols.composition.names
        self.ids = {element.qualified: element.id for element in elements.values()}
        self.ids |= {name: element.id for name, element in elements.items()}
        own = {word: name for (where, word), name in names.meanings.items() if where == pack}
        self.ids |= {word: elements[name].id for word, name in own.items() if name in elements}
        self.ids |= {character: elements[name].id for character, name in legend.items()}

    def read(
        self, drawn: Sequence[tuple[Scalar, Scalar]], given: Sequence[str], *, expected: bool
    ) -> tuple[FieldGrid, ...]:
        """The grids of `fields`, or of `expect_fields`. Raises Poisoned after reporting."""
        grids, failed = [], False
        for key, scalar in drawn:
            try:
                grids.append(self._grid(key, scalar, given, expected))
            except Poisoned:
                failed = True
        if failed:
            raise Poisoned
        return tuple(grids)

    def _grid(self, key: Scalar, scalar: Scalar, given: Sequence[str], expected: bool) -> FieldGrid:
        kind = self._kind(key)
        rows = [line.split() for line in scalar.text.splitlines() if line.strip()]
        words = list(chain.from_iterable(rows))
        places = self._places(scalar, len(words))
        everywhere = len(words) == 1
        if not everywhere and [len(row) for row in rows] != [len(row) for row in given]:
            raise self.typer.fail(
                "PD110", f"`{key.text}` has another size than `given`", places[0] if places else key.span, size_of(given),
                f"write a word for each cell, or one for all of them: {FORMS[kind.name][1]}",
            )  # fmt: skip
        read: dict[str, Cell] = {}
        failed = False
        for word, place in zip(words, places, strict=True):
            if word not in read:
                try:
                    read[word] = self._cell(word, kind, place, expected)
                except Poisoned:
                    read[word], failed = None, True
        if failed:
            raise Poisoned
        if everywhere:
            return FieldGrid(
                self._name(key), tuple((read[words[0]],) * len(row) for row in given), True, key.span
            )
        cells = [read[word] for word in words]
        if not expected:
            self._check_holders(key, cells, given, places)
        return FieldGrid(
            self._name(key), tuple(tuple(read[word] for word in row) for row in rows), False, key.span
        )

    def _name(self, key: Scalar) -> str:
        """The global name of the field that the pack means."""
        return self.typer.symbols.composition.names.of(self.pack, key.word)

    def _kind(self, key: Scalar) -> Kind:
        symbols = self.typer.symbols
        name = self._name(key)
        if name in symbols.fields:
            return symbols.fields[name].kind
        if name in symbols.properties:
            kind = symbols.properties[name].kind
            if kind.name in FORMS:
                return kind
            raise self.typer.fail(
                "PD407", f"`{name}` is not a field", key.span, f"no cell has {kind} of its own"
            )
        if symbols.is_declared(name, self.pack):
            raise Poisoned  # what is wrong with its declaration has been reported
        if key.is_optional:
            raise Unresolved(name)  # the test waits for the pack that declares it
        report_unknown("field", key, (*symbols.fields, *symbols.properties), self.typer.reporter)
        raise Poisoned

    def _places(self, scalar: Scalar, count: int) -> list[Span]:
        """Where each word stands; in text that YAML changes while reading it, the whole text."""
        content = scalar.content
        found = [
            Span(content.source, content.start + match.start(), content.start + match.end())
            for match in re.finditer(r"\S+", content.text)
        ]
        return found if len(found) == count else [scalar.span] * count

    def _cell(self, word: str, kind: Kind, place: Span, expected: bool) -> Cell:
        if word == DEFAULT:
            return ()
        if word == ANYTHING:
            if expected:
                return None
            fix = (f"write `{DEFAULT}` for what a fresh cell has",)
            raise self.typer.fail(
                "PD110", "a start world leaves nothing open", place, FORMS[kind.name][1], *fix
            )
        try:
            return read_word(word, kind, self.ids, ranges=expected)
        except WordProblem as wrong:
            raise self.typer.fail(wrong.code, wrong.message, place, wrong.label, *wrong.helps) from None

    def _check_holders(
        self, key: Scalar, cells: Sequence[Cell], given: Sequence[str], places: Sequence[Span]
    ) -> None:
        """Refuse a value in a cell whose element does not have the field."""
        field = self.typer.symbols.fields.get(self._name(key))
        if field is None or field.of is None:
            return
        for cell, character, place in zip(cells, "".join(given), places, strict=True):
            name = self.legend[character]
            if cell and self.ids[character] not in field.of:
                self.typer.reporter.error(
                    "PD407", f"`{name}` has no `{key.text}`", place, f"the cell holds `{name}`",
                    secondary=(Label(field.span, "only some elements have it"),),
                    helps=(f"write `{DEFAULT}` here, or add `{name}` to `of:` of `{key.text}`",),
                )  # fmt: skip
                raise Poisoned


def size_of(given: Sequence[str]) -> str:
    """How large a start world is."""
    return f"`given` has {len(given)} row{'s' * (len(given) != 1)} of {len(given[0])}"
