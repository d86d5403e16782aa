"""Fields drawn cell by cell, as tests give and expect them: a word a cell, separated by blanks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain

from powderdsl.diagnostics import Label, Span
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.expressions.operands import Poisoned, Unresolved
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.fields.words import FORMS, WordProblem, read_word
from powderdsl.model.types import Cell, FieldGrid, Kind
from powderdsl.syntax.yaml_tree import Scalar

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
