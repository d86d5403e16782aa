"""Tests inside packs: small worlds drawn in ASCII, and what must become of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import lcm

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.composition.claim_scopes import words_of
from powderdsl.model.composition.compose import Composition
from powderdsl.model.declarations import TestDecl
from powderdsl.model.expressions.operands import Poisoned, Scope, Unresolved
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.fields.grids import GridReader
from powderdsl.model.types import CHANCE, Example, Expr, Kernel, Often, Property
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

MAX_SIDE = 64


def check_examples(composition: Composition, typer: Typer) -> tuple[Example, ...]:
    """The tests of all packs, checked: characters known, rows equally long."""
    examples = []
    for pack in composition.packs:
        for decl in pack.tests:
            try:
                examples.append(_example(decl, pack.name.text, composition, typer))
            except (Poisoned, Unresolved):
                continue
    return tuple(examples)


def _example(decl: TestDecl, pack: str, composition: Composition, typer: Typer) -> Example:
    legend = {element.glyph: name for name, element in composition.elements.items()}
    # Glyphs mean what they mean without packs that the author of the test does not know.
    alone = composition.glyphs_alone(composition.scopes.of_pack(pack))
    legend |= {glyph: name for name, glyph in alone.items()}
    # What the pack's own file says comes first, whatever other packs took before.
    own = {name: named.decl.glyph for name, named in composition.element_decls.items() if named.pack == pack}
    legend |= {glyph: name for name, glyph in own.items() if glyph}
    for key, value in decl.legend:
        word = value.text.removesuffix("?")
        name = composition.element(word, pack)
        if name is None:
            if value.text != word:
                raise Unresolved(word)  # a test of what packs do together waits until both are loaded
            helps = (
                *suggest(word, composition.elements, "elements"),
                f"if its pack may be absent, write `{word}?`",
            )
            raise typer.fail("PD301", f"unknown element `{word}`", value.span, "", *helps)
        if len(key.text) != 1:
            raise typer.fail("PD110", "a legend explains single characters", key.span, "not one character")
        legend[key.text] = name
    if decl.given is None:
        raise typer.fail(
            "PD109", f"the test `{decl.name.text}` has no start world", decl.name.span, "`given` is missing"
        )
    given = _rows(decl.given, legend, typer, wildcard=False)
    sides = (len(given), len(given[0]))
    if any(side % composition.side_multiple for side in sides):
        known = composition.names.needs[pack]
        least = lcm(*(one.side_multiple for one in composition.packs if one.name.text in known))
        if not any(side % least for side in sides):  # a pack unknown to this one asks for other worlds
            typer.reporter.report(
                "PD506",
                "this test is inactive: its world has sides that these rules do not allow",
                decl.name.span,
                "left out",
                notes=[f"a loaded pack asks for sides that are multiples of {composition.side_multiple}"],
                helps=["it wakes up without the pack that says `side_multiple`"],
            )
            raise Unresolved("side_multiple")
        raise typer.fail(
            "PD110",
            f"a world of {len(given)}×{len(given[0])} cells",
            decl.given.span,
            f"`side_multiple` asks for multiples of {composition.side_multiple}",
        )
    expect = _rows(decl.expect, legend, typer, wildcard=True) if decl.expect else None
    if (
        expect is not None
        and decl.expect is not None
        and (len(expect), len(expect[0])) != (len(given), len(given[0]))
    ):
        raise typer.fail(
            "PD110",
            "`expect` has another size than `given`",
            decl.expect.span,
            f"`given` has {len(given)} row{'s' * (len(given) != 1)} of {len(given[0])}",
        )
    reader = GridReader(typer, pack, legend)
    fields = reader.read(decl.fields, given, expected=False)
    expect_fields = reader.read(decl.expect_fields, given, expected=True)
    if expect is None and not expect_fields and not decl.always and not decl.often:
        raise typer.fail(
            "PD109",
            f"the test `{decl.name.text}` checks nothing",
            decl.name.span,
            "`expect`, `expect_fields`, `always` or `often` is missing",
        )
    scope = Scope(pack, {"world": _whole_world(len(given), len(given[0]))})
    always: list[Expr] = [typer.condition(syntax, scope) for syntax in decl.always]
    drawn = {legend[char] for rows in (given, expect or ()) for row in rows for char in row if char in legend}
    words = [*sorted(drawn), *(grid.name for grid in (*fields, *expect_fields))]
    asked = [*decl.always, *(change for change, _ in decl.often)]
    words += [word for syntax in asked for word in words_of(syntax)]
    return Example(
        decl.name.text,
        given,
        tuple(sorted(legend.items())),
        decl.steps,
        expect,
        tuple(always),
        pack,
        decl.name.span,
        decl.seed,
        fields,
        expect_fields,
        tuple(_often(change, chance, scope, typer) for change, chance in decl.often),
        composition.scopes.of_pack(pack, words),
    )


def _often(change: Syntax, chance: Syntax, scope: Scope, typer: Typer) -> Often:
    before, after = (typer.condition(part, scope) for part in change.children)
    return Often(before, after, Fraction(typer.constant(chance, CHANCE, scope)), change.span)  # type: ignore[arg-type]


def check_assigned(
    examples: Sequence[Example],
    ids: Mapping[str, int],
    properties: Mapping[str, Property],
    reporter: Reporter,
) -> None:
    """Refuse drawn properties that follow from the element: only what rules assign can differ.

    `ids` are those of the elements by name.
    """
    for example in examples:
        legend = dict(example.legend)
        for grid in (*example.fields, *example.expect_fields):
            prop = properties.get(grid.name)
            if prop is None:
                continue
            if not prop.stored:
                helps = ("a test of what rules assign to it needs such a rule; otherwise leave it out",)
                reporter.error(
                    "PD407",
                    f"no rule assigns `{grid.name}`",
                    grid.span,
                    "it follows from the element",
                    helps=helps,
                )
                continue
            if grid.everywhere or grid in example.expect_fields:
                continue  # it counts where it can, or is compared with what is there
            names = (
                legend[character]
                for row, characters in zip(grid.cells, example.given, strict=True)
                for cell, character in zip(row, characters, strict=True)
                if cell
            )
            name = next((name for name in names if ids[name] not in prop.stored), None)
            if name is not None:
                reporter.error(
                    "PD407",
                    f"no rule assigns `{grid.name}` of `{name}`",
                    grid.span,
                    f"a cell that holds `{name}` has a value here",
                    helps=("write `.` for such cells",),
                )


def _whole_world(height: int, width: int) -> Kernel:
    """A kernel that sees all cells of a small world from each of them: `count(X in world) == 1`."""
    offsets = ((dy, dx) for dy in range(1 - height, height) for dx in range(1 - width, width))
    return Kernel("world", tuple((dy, dx, 1) for dy, dx in offsets), wrap=False)


def _check_whole(scalar: Scalar, legend: dict[str, str], typer: Typer) -> None:
    """Refuse a drawing on the line of its key whose rest is a comment to YAML, where `#` is a character of drawings."""
    if scalar.style != "plain" or "#" not in legend:
        return
    text = scalar.span.source.text
    end = text.find("\n", scalar.span.end)
    end = end if end >= 0 else len(text)
    rest = text[scalar.span.end : end]
    if rest.lstrip().startswith("#"):
        start = scalar.span.end + rest.index("#")
        whole = text[scalar.span.start : end].strip()
        raise typer.fail(
            "PD110", "a drawing that stops at a comment", Span(scalar.span.source, start, scalar.span.end + len(rest.rstrip())),
            "a comment, to YAML", f'put quotes around the drawing: "{whole}"', "or draw it on the next lines, below `|`")  # fmt: skip


def _rows(scalar: Scalar, legend: dict[str, str], typer: Typer, *, wildcard: bool) -> tuple[str, ...]:
    _check_whole(scalar, legend, typer)
    rows = tuple("".join(line.split()) for line in scalar.text.splitlines() if line.strip())
    if not rows or len({len(row) for row in rows}) != 1 or max(len(rows), len(rows[0])) > MAX_SIDE:
        raise typer.fail(
            "PD110", "rows of a world are equally long", scalar.span, f"expected 1 to {MAX_SIDE} equal rows"
        )
    for char in sorted(set("".join(rows))):
        if char not in legend and not (wildcard and char == "?"):
            place = scalar.content.start + max(scalar.content.text.find(char), 0)
            known = " ".join(f"{glyph}={name}" for glyph, name in sorted(legend.items()))
            raise typer.fail(
                "PD301",
                f"`{char}` stands for nothing",
                Span(scalar.span.source, place, place + 1),
                "not in the legend",
                f"known: {known}",
            )
    return rows
