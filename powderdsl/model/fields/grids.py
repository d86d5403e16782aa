"""Fields drawn cell by cell, as tests give and expect them: a word a cell, separated by blanks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from powderdsl.diagnostics import Label, Span, suggest
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
        places = self._places(scalar, sum(map(len, rows)))
        everywhere = len(rows) == 1 and len(rows[0]) == 1
        if not everywhere and [len(row) for row in rows] != [len(row) for row in given]:
            raise self.typer.fail(
                "PD110",
                f"`{key.text}` has another size than `given`",
                places[0] if places else key.span,
                f"`given` has {len(given)} row{'s' * (len(given) != 1)} of {len(given[0])}",
                f"write a word for each cell, or one for all of them: {FORMS[kind.name][1]}",
            )
        words: dict[str, Cell] = {}
        cells, at = [], 0
        failed = False
        for row in rows:
            read = []
            for word in row:
                if word not in words:
                    try:
                        words[word] = self._cell(word, kind, places[at], expected)
                    except Poisoned:
                        words[word], failed = None, True
                read.append(words[word])
                at += 1
            cells.append(tuple(read))
        if failed:
            raise Poisoned
        if not expected:
            self._check_holders(key, cells, given, places, everywhere)
        if everywhere:
            cells = [tuple(cells[0][0] for _ in line) for line in given]
        return FieldGrid(self._name(key), tuple(cells), everywhere, key.span)

    def _name(self, key: Scalar) -> str:
        """The global name of the field that the pack means."""
        return self.typer.symbols.composition.names.of(self.pack, key.text.removesuffix("?"))

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
        if key.text.endswith("?"):
            raise Unresolved(name)  # the test waits for the pack that declares it
        helps = (
            *suggest(name, [*symbols.fields, *symbols.properties], "fields"),
            f"if its pack may be absent, write `{name}?`",
        )
        raise self.typer.fail("PD301", f"unknown field `{name}`", key.span, "", *helps)

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
        self,
        key: Scalar,
        cells: Sequence[Sequence[Cell]],
        given: Sequence[str],
        places: Sequence[Span],
        everywhere: bool,
    ) -> None:
        """Refuse a value in a cell whose element does not have the field."""
        symbols = self.typer.symbols
        field = symbols.fields.get(self._name(key))
        if everywhere or field is None or field.of is None:
            return
        at = 0
        for row, characters in zip(cells, given, strict=True):
            for cell, character in zip(row, characters, strict=True):
                name = self.legend[character]
                if cell and symbols.composition.elements[name].id not in field.of:
                    self.typer.reporter.error(
                        "PD407",
                        f"`{name}` has no `{key.text}`",
                        places[at],
                        f"the cell holds `{name}`",
                        secondary=(Label(field.span, "only some elements have it"),),
                        helps=(f"write `{DEFAULT}` here, or add `{name}` to `of:` of `{key.text}`",),
                    )
                    raise Poisoned
                at += 1
