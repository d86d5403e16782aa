"""Tests inside packs: small worlds drawn in ASCII, and what must become of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from itertools import chain
from math import lcm

from powderdsl.diagnostics import Reporter, Span
from powderdsl.model.composition.claim_scopes import words_of
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.declarations import TestDecl
from powderdsl.model.expressions.operators import Poisoned, Scope, Unresolved
from powderdsl.model.expressions.symbols import Symbols
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.fields import GridReader, size_of
from powderdsl.model.schema import comment_after
from powderdsl.model.types import CHANCE, Example, Kernel, Often
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

MAX_SIDE = 64


def check_examples(typer: Typer) -> tuple[Example, ...]:
    """The tests of all packs, checked: characters known, rows equally long."""
    examples = []
    for pack in typer.symbols.composition.packs:
        for decl in pack.tests:
            with suppress(Poisoned, Unresolved):
                examples.append(_example(decl, pack.name.text, typer))
    return tuple(examples)


def _example(decl: TestDecl, pack: str, typer: Typer) -> Example:
    name, place = decl.name.text, decl.name.span
    legend = _legend(decl, pack, typer)
    if decl.given is None:
        raise typer.fail("PD109", f"the test `{name}` has no start world", place, "`given` is missing")
    given = _rows(decl.given, legend, typer, wildcard=False)
    _check_sides(decl, decl.given, given, pack, typer)
    expect = _rows(decl.expect, legend, typer, wildcard=True) if decl.expect else None
    if expect and decl.expect and (len(expect), len(expect[0])) != (len(given), len(given[0])):
        raise typer.fail("PD110", "`expect` has another size than `given`", decl.expect.span, size_of(given))
    reader = GridReader(typer, pack, legend)
    fields = reader.read(decl.fields, given, expected=False)
    expect_fields = reader.read(decl.expect_fields, given, expected=True)
    if not (expect or expect_fields or decl.always or decl.often):
        label = "`expect`, `expect_fields`, `always` or `often` is missing"
        raise typer.fail("PD109", f"the test `{name}` checks nothing", place, label)
    scope = Scope(pack, {"world": _whole_world(len(given), len(given[0]))})
    always = tuple(typer.condition(syntax, scope) for syntax in decl.always)
    often = tuple(_often(change, chance, scope, typer) for change, chance in decl.often)
    drawn = {legend[char] for char in "".join([*given, *(expect or ())]) if char in legend}
    asked = [*decl.always, *(change for change, _ in decl.often)]
    words = [*sorted(drawn), *(grid.name for grid in (*fields, *expect_fields))]
    words += [word for syntax in asked for word in words_of(syntax)]
    return Example(
        name,
        given,
        tuple(sorted(legend.items())),
        decl.steps,
        expect,
        always,
        pack,
        place,
        decl.seed,
        fields,
        expect_fields,
        often,
        typer.symbols.composition.scopes.of_pack(pack, words),
    )


def _legend(decl: TestDecl, pack: str, typer: Typer) -> dict[str, str]:
    """The elements, by global name, that the characters of a test stand for."""
    composition = typer.symbols.composition
    legend = {element.glyph: name for name, element in composition.elements.items()}
    # Glyphs mean what they mean without packs that the author of the test does not know.
    alone = composition.glyphs_alone(composition.scopes.of_pack(pack))
    legend |= {glyph: name for name, glyph in alone.items()}
    # What the pack's own file says comes first, whatever other packs took before.
    own = {name: named.decl.glyph for name, named in composition.element_decls.items() if named.pack == pack}
    legend |= {glyph: name for name, glyph in own.items() if glyph}
    for key, value in decl.legend:
        found = composition.element(value.word, pack)
        if found is None:
            if value.is_optional:
                raise Unresolved(value.word)  # a test of what packs do together waits until both are loaded
            report_unknown("element", value, composition.elements, typer.reporter)
            raise Poisoned
        if len(key.text) != 1:
            raise typer.fail("PD110", "a legend explains single characters", key.span, "not one character")
        legend[key.text] = found
    return legend


def _check_sides(decl: TestDecl, drawing: Scalar, given: tuple[str, ...], pack: str, typer: Typer) -> None:
    """Refuse a world of sides that the packs do not allow; where an unknown pack does not, the test is inactive."""
    composition = typer.symbols.composition
    multiple, sides = composition.side_multiple, (len(given), len(given[0]))
    if not any(side % multiple for side in sides):
        return
    known = composition.names.needs[pack]
    least = lcm(*(one.side_multiple for one in composition.packs if one.name.text in known))
    if any(side % least for side in sides):
        label = f"`side_multiple` asks for multiples of {multiple}"
        raise typer.fail("PD110", f"a world of {sides[0]}×{sides[1]} cells", drawing.span, label)
    typer.reporter.report(
        "PD506", "this test is inactive: its world has sides that these rules do not allow", decl.name.span, "left out",
        notes=[f"a loaded pack asks for sides that are multiples of {multiple}"],
        helps=["it becomes active without the pack that says `side_multiple`"],
    )  # fmt: skip
    raise Unresolved("side_multiple")


def _often(change: Syntax, chance: Syntax, scope: Scope, typer: Typer) -> Often:
    before, after = (typer.condition(part, scope) for part in change.children)
    return Often(before, after, Fraction(typer.constant(chance, CHANCE, scope)), change.span)  # type: ignore[arg-type]  # a chance is a fraction


def check_assigned(examples: Sequence[Example], symbols: Symbols, reporter: Reporter) -> None:
    """Refuse drawn properties that follow from the element: only what rules assign can differ."""
    elements = symbols.composition.elements
    for example in examples:
        legend = dict(example.legend)
        for grid in (*example.fields, *example.expect_fields):
            prop = symbols.properties.get(grid.name)
            if prop is None:
                continue
            if not prop.stored:
                helps = ["a test of what rules assign to it needs such a rule; otherwise leave it out"]
                message, label = f"no rule assigns `{grid.name}`", "it follows from the element"
                reporter.error("PD407", message, grid.span, label, helps=helps)
                continue
            if grid.everywhere or grid in example.expect_fields:
                continue  # it counts where it can, or is compared with what the world has
            cells = zip(chain.from_iterable(grid.cells), "".join(example.given), strict=True)
            names = (legend[character] for cell, character in cells if cell)
            name = next((name for name in names if elements[name].id not in prop.stored), None)
            if name is not None:
                message, label = (
                    f"no rule assigns `{grid.name}` of `{name}`",
                    f"a cell that holds `{name}` has a value here",
                )
                reporter.error("PD407", message, grid.span, label, helps=["write `.` for such cells"])


def _whole_world(height: int, width: int) -> Kernel:
    """A kernel that sees all cells of a small world from each of them: `count(X in world) == 1`."""
    offsets = ((dy, dx) for dy in range(1 - height, height) for dx in range(1 - width, width))
    return Kernel("world", tuple((dy, dx, 1) for dy, dx in offsets), wrap=False)


def _check_whole(scalar: Scalar, legend: dict[str, str], typer: Typer) -> None:
    """Refuse a drawing on the line of its key whose rest is a comment to YAML, where `#` is a character of drawings."""
    comment = comment_after(scalar) if scalar.style == "plain" and "#" in legend else None
    if comment is not None:
        whole = Span(comment.source, scalar.span.start, comment.end).text
        raise typer.fail(
            "PD110", "a drawing that stops at a comment", comment, "a comment, to YAML",
            f'put quotes around the drawing: "{whole}"', "or draw it on the next lines, below `|`",
        )  # fmt: skip


def _rows(scalar: Scalar, legend: dict[str, str], typer: Typer, *, wildcard: bool) -> tuple[str, ...]:
    """The rows of a drawn world, a character a cell."""
    _check_whole(scalar, legend, typer)
    rows = tuple("".join(line.split()) for line in scalar.text.splitlines() if line.strip())
    if not rows or len({len(row) for row in rows}) != 1 or max(len(rows), len(rows[0])) > MAX_SIDE:
        label = f"expected 1 to {MAX_SIDE} equal rows"
        raise typer.fail("PD110", "rows of a world are equally long", scalar.span, label)
    for char in sorted(set("".join(rows))):
        if char not in legend and not (wildcard and char == "?"):
            start = scalar.content.start + max(scalar.content.text.find(char), 0)
            place = Span(scalar.span.source, start, start + 1)
            known = " ".join(f"{glyph}={name}" for glyph, name in sorted(legend.items()))
            raise typer.fail(
                "PD301", f"`{char}` stands for nothing", place, "not in the legend", f"known: {known}"
            )
    return rows
