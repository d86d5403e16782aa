"""Tests of packs: small worlds in ASCII, drawn values of fields, and expected worlds."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from itertools import chain, product
from math import lcm

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.builtins import DIRECTIONS, FLAG_WORDS, OCTANTS
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.names import report_unknown, words_of
from powderdsl.model.declarations import ElementDecl, TestDecl
from powderdsl.model.expressions.operators import Poisoned, Scope, Unresolved
from powderdsl.model.expressions.symbols import clamp_number
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.schema import comment_after
from powderdsl.model.types import CHANCE, Cell, Example, FieldGrid, Kernel, Kind, Often, plus
from powderdsl.syntax.yaml_tree import Scalar

MAX_SIDE = 64

FORMS = {
    "int": ("an integer", "an integer such as `3` or `-2`"),
    "flag": ("a flag", "`yes` or `no`"),
    "element": ("an element", "an element's name"),
    "direction": ("a direction", "a neighbor such as `left` or `above.right`"),
    "real": ("a number", "a number such as `3` or `-0.25`"),
    "vec2": ("a vector", "rows and columns, such as `1.5,-2`"),
}
"""For each kind, a noun for its words, and their syntax."""

_OCTANTS = {
    f"{first}.{second}".removesuffix(".here"): OCTANTS.index(plus(DIRECTIONS[first], DIRECTIONS[second]))
    for first, second in product(DIRECTIONS, repeat=2)
    if plus(DIRECTIONS[first], DIRECTIONS[second]) in OCTANTS
}
"""Directions by their words: `above.right`, rows first, and `right.above`."""

_WHOLE = r"-?[0-9]{1,7}"
_NUMBER = r"-?[0-9]{1,7}(\.[0-9]{1,20})?([eE][-+]?[0-9]{1,2})?"

Bounds = tuple[float, float]
"""The lowest and highest value that a word allows, which differ only for a range."""


class WordProblem(Exception):
    """A word is not a value of its kind. Has a code, a message, a label, and possibly fixes."""

    def __init__(self, code: str, message: str, label: str, *helps: str):
        super().__init__(message)
        self.code, self.message, self.label, self.helps = code, message, label, helps


def read_word(word: str, kind: Kind, ids: Mapping[str, int], *, ranges: bool = False) -> tuple[Bounds, ...]:
    """The bounds of each component of the value: two of a vector, one of other kinds.

    `ids` maps words to elements. With `ranges`, numbers may be ranges such as `1..3`. Raises WordProblem if the word is
    not a value of this kind.
    """
    table = {"flag": FLAG_WORDS, "element": ids, "direction": _OCTANTS}.get(kind.name)
    values: list[Bounds] = []
    if table is not None:
        parts = [word]
        values += [(table[word],) * 2] if word in table else []
    else:
        parts = [word] if kind.name != "vec2" else word.removeprefix("(").removesuffix(")").split(",")
        for part in parts:
            low, dots, high = part.partition("..") if ranges else (part, "", "")
            least = _number(low, kind)
            most = _number(high, kind) if dots else least
            if least is None or most is None:
                break
            if least > most:
                label, fix = f"{low} is above {high}", f"write `{high}..{low}`"
                raise WordProblem("PD402", "the bounds are reversed", label, fix)
            values.append((least, most))
    if not len(values) == len(parts) == 1 + (kind.name == "vec2"):
        noun, form = FORMS[kind.name]
        elements = [name for name in ids if len(name) > 1]
        helps = suggest(word, elements, "elements") if kind.name == "element" else ()
        raise WordProblem("PD110", f"`{word}` is not {noun}", f"expected {form}", *helps)
    return tuple(values)


def _number(word: str, kind: Kind) -> float | None:
    """The number that a word represents; None for other words."""
    whole = kind.name == "int"
    if not re.fullmatch(_WHOLE if whole else _NUMBER, word):
        return None
    value = Fraction(word)
    if not kind.lo <= value <= kind.hi:
        label = f"the range is {kind.lo:g}..{kind.hi:g}"
        fix = "write a number in this range, or widen it where it is declared"
        raise WordProblem("PD402", f"{word} is out of range {kind}", label, fix)
    return int(value) if whole else float(clamp_number(value, kind))


def direction_word(octant: int) -> str:
    """A direction as in drawings: `above.right`."""
    return next(word for word, number in _OCTANTS.items() if number == octant and not word.startswith("here"))


DEFAULT = "."
"""The word of a cell with the value of a fresh cell of its element."""

ANYTHING = "?"
"""The word of an expected cell that is not compared."""


def check_examples(typer: Typer) -> tuple[Example, ...]:
    """The tests of all packs, checked: characters known, rows equally long."""
    examples, composition = [], typer.symbols
    names, elements = composition.names, composition.elements
    known = {name: (name, element.id, names.pack(name)) for name, element in elements.items()}
    for name, pack in composition.packs.items():
        if not pack.tests:
            continue
        glyphs = {element.glyph: word for word, element in elements.items()}
        # Glyphs keep the meaning that they have without packs added later.
        glyphs |= {glyph: word for word, glyph in composition.glyphs_alone(composition.scope(name)).items()}
        # Glyphs of the pack's own file take precedence over those of other packs.
        declared = ((word, decl) for word, decl in names.declared(ElementDecl).items() if decl.pack == name)
        glyphs |= {decl.glyph: word for word, decl in declared if decl.glyph}
        legend = tuple(sorted(glyphs.items()))
        for test in pack.tests:
            drawings = test.given, test.expect, *dict((*test.fields, *test.expect_fields)).values()
            drawn = {"#", *chain(*(part.text for part in drawings if part))}  # `#` may begin a comment
            meant = {glyph: known.get(glyphs.get(glyph, "")) for glyph in drawn}
            with suppress(Poisoned, Unresolved):
                reader = _ExampleReader(typer, name, test, glyphs)
                example = typer.reuse.of(test.name.span, meant, typer, reader.example)
                own = {key.text: names.of(name, value.word) for key, value in test.legend}
                whole = tuple(sorted((glyphs | own).items())) if own else legend
                examples.append(example if example.legend == whole else replace(example, legend=whole))
    return tuple(examples)


class _ExampleReader:
    """Reads one test. Its methods raise Poisoned after reporting, Unresolved for a test that needs an absent pack.

    `legend` has the elements of characters, by global name.
    """

    def __init__(self, typer: Typer, pack: str, decl: TestDecl, legend: dict[str, str]):
        self.typer, self.pack, self.decl = typer, pack, decl
        self.composition, self.legend = typer.symbols, legend
        self.given: tuple[str, ...] = ()
        """The rows of the first world, once they are read."""

    def example(self) -> Example:
        decl, typer, name, place = self.decl, self.typer, self.decl.name.text, self.decl.name.span
        self.typer.start_rule(place)
        self.legend = self.legend | self._own_legend()
        if decl.given is None:
            raise typer.fail("PD109", f"the test `{name}` has no start world", place, "`given` is missing")
        given = self.given = self._rows(decl.given, wildcard=False)
        self._check_sides(decl.given)
        expect = self._rows(decl.expect, wildcard=True) if decl.expect else None
        size = f"`given` has {len(given)} row{'s' * (len(given) != 1)} of {len(given[0])}"
        if expect and decl.expect and (len(expect), len(expect[0])) != (len(given), len(given[0])):
            raise typer.fail("PD110", "`expect` and `given` have different sizes", decl.expect.span, size)
        ids = self._ids() if decl.fields or decl.expect_fields else {}
        fields = self._grids(decl.fields, ids, size, expected=False)
        expect_fields = self._grids(decl.expect_fields, ids, size, expected=True)
        params = self._params()
        if not (decl.expect or decl.expect_fields or decl.always or decl.often):
            label = "`expect`, `expect_fields`, `always` or `often` is missing"
            raise typer.fail("PD109", f"the test `{name}` checks nothing", place, label)
        height, width = len(given), len(given[0])
        reach = ((dy, dx, 1) for dy in range(1 - height, height) for dx in range(1 - width, width))
        # A kernel that sees all cells from each.
        scope = Scope(self.pack, {"world": Kernel("world", tuple(reach), wrap=False)})
        always = tuple(typer.condition(syntax, scope) for syntax in decl.always)
        often = []
        for change, chance in decl.often:
            before, after = change.children
            part = Fraction(typer.constant(chance, CHANCE, scope))  # type: ignore[arg-type]  # a chance is a fraction
            often.append(
                Often(typer.condition(before, scope), typer.condition(after, scope), part, change.span)
            )
        drawn = set("".join((*given, *(expect or ()))))
        words = sorted(meaning for character, meaning in self.legend.items() if character in drawn)
        words += [*(grid.name for grid in (*fields, *expect_fields)), *params]
        for syntax in (*decl.always, *(change for change, _ in decl.often)):
            words += words_of(syntax)
        return Example(
            name,
            given,
            tuple(sorted(self.legend.items())),
            decl.steps,
            expect,
            always,
            self.pack,
            place,
            decl.seed,
            fields,
            expect_fields,
            tuple(often),
            tuple(params.items()),
            self.composition.scope(self.pack, words),
        )

    def _params(self) -> dict[str, float]:
        """The parameters that the test sets, by qualified name."""
        known, values = self.composition.params, {}
        for key, syntax in self.decl.params:
            param = known.get(key.word) or known.get(f"{self.pack}.{key.word}")
            if param is not None:
                values[param.name] = float(self.typer.constant(syntax, param.kind, Scope("", {})))  # type: ignore[arg-type]  # no kind of parameters has pairs
                continue
            if self.composition.is_declared(key.word, self.pack):
                raise Poisoned  # what is wrong with its declaration has been reported
            if key.is_optional:
                raise Unresolved(key.word)
            report_unknown("parameter", key, known, self.typer.reporter, "PD309")
            raise Poisoned
        return values

    def _ids(self) -> dict[str, int]:
        """The elements' ids by the words and characters that the pack may use for them."""
        composition, elements = self.composition, self.composition.elements
        ids: dict[str, int] = {}
        for name, element in elements.items():
            for word in (name, element.qualified, element.word or name):
                ids[word] = elements[composition.element(word, self.pack) or name].id
        return ids | {character: elements[name].id for character, name in self.legend.items()}

    def _own_legend(self) -> dict[str, str]:
        """The elements, by global name, of the characters in the test's own legend."""
        composition = self.composition
        legend: dict[str, str] = {}
        for key, value in self.decl.legend:
            element = composition.element(value.word, self.pack)
            if element is None:
                if value.is_optional:
                    # A test of packs in combination is inactive until all are loaded.
                    raise Unresolved(value.word)
                report_unknown("element", value, composition.elements, self.typer.reporter)
                raise Poisoned
            if len(key.text) != 1:
                raise self.typer.fail(
                    "PD110", "a legend maps single characters", key.span, "not one character"
                )
            legend[key.text] = element
        return legend

    def _check_sides(self, drawing: Scalar) -> None:
        """Reject sides that the test's pack or its needs disallow; if only other packs do, it is inactive."""
        multiple, sides = self.composition.side_multiple, (len(self.given), len(self.given[0]))
        if not any(side % multiple for side in sides):
            return
        known = self.composition.names.needs[self.pack]
        least = lcm(*(self.composition.packs[pack].side_multiple for pack in known))
        if any(side % least for side in sides):
            label = f"`side_multiple` requires multiples of {multiple}"
            raise self.typer.fail("PD110", f"a world of {sides[0]}×{sides[1]} cells", drawing.span, label)
        self.typer.reporter.report(
            "PD506", "this test is inactive: its world has sides that these rules do not allow", self.decl.name.span, "left out",
            notes=[f"a loaded pack requires sides that are multiples of {multiple}"],
            helps=["it becomes active without the pack that sets `side_multiple`"],
        )  # fmt: skip
        raise Unresolved("side_multiple")

    def _rows(self, scalar: Scalar, *, wildcard: bool) -> tuple[str, ...]:
        """The rows of a drawn world, one character per cell."""
        comment = comment_after(scalar) if scalar.style == "plain" and "#" in self.legend else None
        if comment is not None:  # on the line of the key, `#` begins a comment of YAML
            whole = Span(comment.source, scalar.span.start, comment.end).text
            raise self.typer.fail(
                "PD110", "a drawing cut short by a comment", comment, "a comment, to YAML",
                f'put quotes around the drawing: "{whole}"', "or draw it on the next lines, below `|`",
            )  # fmt: skip
        rows = tuple("".join(line.split()) for line in scalar.text.splitlines() if line.strip())
        if not rows or len(set(map(len, rows))) != 1 or max(len(rows), len(rows[0])) > MAX_SIDE:
            label = f"expected 1 to {MAX_SIDE} equal rows"
            raise self.typer.fail("PD110", "rows of a world must be equally long", scalar.span, label)
        for char in sorted(set("".join(rows)) - self.legend.keys()):
            if not (wildcard and char == "?"):
                start = scalar.content.start + max(scalar.content.text.find(char), 0)
                place = Span(scalar.span.source, start, start + 1)
                known = " ".join(f"{glyph}={name}" for glyph, name in sorted(self.legend.items()))
                raise self.typer.fail(
                    "PD301", f"`{char}` has no meaning here", place, "not in the legend", f"known: {known}"
                )
        return rows

    # Drawn fields: all mistakes are reported, and repeated words are read once

    def _grids(
        self, drawn: Sequence[tuple[Scalar, Scalar]], ids: Mapping[str, int], size: str, *, expected: bool
    ) -> tuple[FieldGrid, ...]:
        grids = []
        for key, scalar in drawn:
            with suppress(Poisoned):
                grids.append(self._grid(key, scalar, ids, size, expected))
        return tuple(grids)

    def _grid(
        self, key: Scalar, scalar: Scalar, ids: Mapping[str, int], size: str, expected: bool
    ) -> FieldGrid:
        name = self.composition.names.of(self.pack, key.word)
        kind = self._kind(key, name)
        rows = [line.split() for line in scalar.text.splitlines() if line.strip()]
        words = list(chain.from_iterable(rows))
        content = scalar.content
        places = [
            Span(content.source, content.start + match.start(), content.start + match.end())
            for match in re.finditer(r"\S+", content.text)
        ]
        if len(places) != len(words):  # YAML has changed the text while reading it
            places = [scalar.span] * len(words)
        everywhere = len(words) == 1
        if not everywhere and list(map(len, rows)) != list(map(len, self.given)):
            raise self.typer.fail(
                "PD110", f"`{key.text}` and `given` have different sizes", places[0] if places else key.span, size,
                f"write a word for each cell, or one for all cells: {FORMS[kind.name][1]}",
            )  # fmt: skip
        read: dict[str, Cell] = {DEFAULT: ()} | ({ANYTHING: None} if expected else {})
        for word, place in zip(words, places, strict=True):
            if word in read:
                continue
            try:
                if word == ANYTHING:
                    form, fix = FORMS[kind.name][1], f"write `{DEFAULT}` for the value of a fresh cell"
                    raise WordProblem("PD110", "a start world needs a value for every cell", form, fix)
                read[word] = read_word(word, kind, ids, ranges=expected)
            except WordProblem as wrong:
                self.typer.fail(wrong.code, wrong.message, place, wrong.label, *wrong.helps)
                read[word] = None
        if everywhere:
            rows = [words * len(row) for row in self.given]
        cells = tuple(tuple(read[word] for word in row) for row in rows)
        field = self.typer.symbols.fields.get(name)
        if field is not None and field.of is not None and not everywhere and not expected:
            drawing = zip(chain.from_iterable(cells), "".join(self.given), places, strict=True)
            for cell, character, place in drawing:
                if cell and ids[character] not in field.of:
                    element = self.legend[character]
                    self.typer.reporter.error(
                        "PD407", f"`{element}` has no `{key.text}`", place, f"the cell contains `{element}`",
                        secondary=(Label(field.span, "only some elements have it"),),
                        helps=(f"write `{DEFAULT}` here, or add `{element}` to `of:` of `{key.text}`",),
                    )  # fmt: skip
                    raise Poisoned
        return FieldGrid(name, cells, everywhere, key.span)

    def _kind(self, key: Scalar, name: str) -> Kind:
        symbols = self.typer.symbols
        symbol = symbols.fields.get(name) or symbols.properties.get(name)
        if symbol is not None:
            if symbol.kind.name in FORMS:
                return symbol.kind
            label = f"cells do not store {symbol.kind}"
            raise self.typer.fail("PD407", f"`{name}` is not a field", key.span, label)
        if symbols.is_declared(name, self.pack):
            raise Poisoned  # what is wrong with its declaration has been reported
        if key.is_optional:
            raise Unresolved(name)  # the test waits for the pack that declares it
        report_unknown("field", key, (*symbols.fields, *symbols.properties), self.typer.reporter)
        raise Poisoned


def check_assigned(examples: Sequence[Example], symbols: Composition, reporter: Reporter) -> None:
    """Reject drawn properties that follow from the element: only those that rules assign can differ."""
    elements = symbols.elements
    for example in examples:
        legend = dict(example.legend)
        for grid in (*example.fields, *example.expect_fields):
            prop = symbols.properties.get(grid.name)
            if prop is None:
                continue
            if not prop.stored:
                helps = ["draw it only if a rule assigns it; otherwise omit it"]
                message, label = f"no rule assigns `{grid.name}`", "it follows from the element"
                reporter.error("PD407", message, grid.span, label, helps=helps)
                continue
            if grid.everywhere or grid in example.expect_fields:
                continue  # it applies where it can, or is compared with the world's values
            cells = zip(chain.from_iterable(grid.cells), "".join(example.given), strict=True)
            names = (legend[character] for cell, character in cells if cell)
            name = next((name for name in names if elements[name].id not in prop.stored), None)
            if name is not None:
                message = f"no rule assigns `{grid.name}` of `{name}`"
                label = f"a cell that contains `{name}` has a value here"
                reporter.error("PD407", message, grid.span, label, helps=["write `.` for such cells"])
