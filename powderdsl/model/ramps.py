"""Which element's color follows which field: the ramps of packs, checked."""

from __future__ import annotations

from collections.abc import Iterator

from powderdsl.diagnostics import Label, suggest
from powderdsl.model.composition.compose import Composition, needed_first
from powderdsl.model.declarations import RampDecl
from powderdsl.model.expressions.literals import read_bounds
from powderdsl.model.expressions.operands import Poisoned
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import ColorRamp, Element, Field

ORDERED = ("int", "flag", "real")
"""Kinds of fields that a color can follow: their values have an order."""


def element_ramps(typer: Typer) -> dict[str, ColorRamp]:
    """The ramps by global names of elements. Of several for one element the last holds. Reports what is wrong."""
    composition = typer.symbols.composition
    holding: dict[str, tuple[str, RampDecl]] = {}
    found: dict[str, ColorRamp] = {}
    for pack, name, decl in _written(composition):
        element = composition.elements.get(name)
        field = _field(pack, decl, typer)
        if element is None or field is None or not _shows(field, element, decl, typer):
            continue
        ramp = _ramp(field, element, decl, typer)
        if ramp is None:
            continue
        if name in holding and found[name] != ramp:
            _report_contested(name, holding[name], (pack, decl), typer)
        holding[name], found[name] = (pack, decl), ramp
    return found


def _written(composition: Composition) -> Iterator[tuple[str, str, RampDecl]]:
    """Every ramp with its pack and its element, in rising precedence: the order of `contested.given_values`."""
    for name, named in composition.element_decls.items():
        if named.decl.ramp is not None:
            yield named.pack, name, named.decl.ramp
    for pack in needed_first(composition.packs):
        for also in pack.also:
            word = also.element.text.removesuffix("?")
            if also.ramp is not None:
                yield pack.name.text, composition.element(word, pack.name.text) or word, also.ramp


def _field(pack: str, decl: RampDecl, typer: Typer) -> Field | None:
    """The field that a ramp follows; None where its pack is absent, or after reporting that there is none."""
    symbols, composition = typer.symbols, typer.symbols.composition
    word = decl.field.text.removesuffix("?")
    owner, _, base = word.rpartition(".")
    name = (composition.names.qualified(owner, base) if owner else None) or composition.names.of(pack, word)
    if name in composition.fields:
        return symbols.fields.get(name)  # None: its own declaration was reported
    if name in composition.properties:
        typer.reporter.error(
            "PD401", f"`{word}` is a property", decl.field.span, "a color follows a field",
            helps=["a property is the same in all cells of an element: choose its `color` accordingly, or declare a field"],
        )  # fmt: skip
    elif not decl.field.text.endswith("?"):
        typer.reporter.error(
            "PD301", f"unknown field `{word}`", decl.field.span, "no loaded pack declares it",
            helps=[*suggest(word, symbols.fields, "fields"), f"if its pack may be absent, write `{word}?`"],
        )  # fmt: skip
    return None


def _shows(field: Field, element: Element, decl: RampDecl, typer: Typer) -> bool:
    """Whether cells of an element can differ in a field in an order; reports if not."""
    declared = (Label(field.span, "declared here"),)
    if field.kind.name not in ORDERED:
        fix = (
            f"declare a field for its length, `real(0..{field.kind.hi:g})`, and assign it in a pass"
            if field.kind.name == "vec2"
            else "a color follows numbers and flags: LOW..HIGH, real(LOW..HIGH), flag"
        )
        typer.reporter.error(
            "PD401", f"a color cannot follow a field of kind {field.kind}", decl.field.span, "its values have no order",
            secondary=declared, helps=[fix],
        )  # fmt: skip
        return False
    if field.of is not None and element.id not in field.of:
        typer.reporter.error(
            "PD407", f"`{element.name}` has no `{field.name}`", decl.field.span, f"`of:` leaves `{element.name}` out",
            secondary=declared, helps=[f"add `{element.name}` to `of:`, or remove `color_by`"],
        )  # fmt: skip
        return False
    return True


def _ramp(field: Field, element: Element, decl: RampDecl, typer: Typer) -> ColorRamp | None:
    kind = field.kind
    least, most = (0, 1) if kind.name == "flag" else (int(kind.lo), int(kind.hi))
    lo, hi = least, most
    if decl.over is not None:
        try:
            lo, hi = read_bounds(decl.over, typer)
        except Poisoned:
            return None
        if not least <= lo <= hi <= most:
            typer.reporter.error(
                "PD402", f"`{field.name}` does not reach all of {lo}..{hi}", decl.over.span, f"its values are {least}..{most}",
                secondary=[Label(field.span, "declared here")],
                helps=[f"write a range within `{least}..{most}`, or leave out `over` for all of it"],
            )  # fmt: skip
            return None
    if lo == hi:
        span = decl.over.span if decl.over is not None else decl.field.span
        typer.reporter.error(
            "PD402", f"a range of the single value {lo}", span, "the color cannot change here",
            helps=["give a range of at least two values"] if decl.over is not None else [f"widen the kind of `{field.name}`, or remove `color_by`"],
        )  # fmt: skip
        return None
    return ColorRamp(field.name, decl.start or element.color, decl.end, lo, hi, kind.name == "real")


def _report_contested(
    name: str, lost: tuple[str, RampDecl], held: tuple[str, RampDecl], typer: Typer
) -> None:
    """Report a ramp in whose place another one comes: a note where a pack means to, a warning where none can."""
    (before, old), (after, new) = lost, held
    if before in typer.symbols.composition.names.needs[after]:
        typer.reporter.report(
            "PD317", f"`{after}` replaces the `color_by` of `{name}`", new.key.span, "this one holds",
            secondary=[Label(old.key.span, f"the one that `{before}` gives")],
        )  # fmt: skip
        return
    typer.reporter.report(
        "PD316", f"packs `{before}` and `{after}` give `{name}` a different `color_by`", new.key.span, "this one holds",
        secondary=[Label(old.key.span, "this one is lost")],
        helps=[f"say `needs: {before}` in `{after}` if it means to replace it", "or remove one of them"],
    )  # fmt: skip
