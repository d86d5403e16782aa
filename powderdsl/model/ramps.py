"""Declared color ramps -> checked ones: elements whose color follows a field."""

from __future__ import annotations

from contextlib import suppress

from powderdsl.diagnostics import Label, Span
from powderdsl.model.composition.contested import report_replaced
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.declarations import RampDecl
from powderdsl.model.expressions.operators import Poisoned
from powderdsl.model.expressions.symbols import read_bounds
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import ColorRamp, Element, Field

ORDERED = ("int", "flag", "real")
"""Kinds of fields that a color can follow: their values have an order."""


def element_ramps(typer: Typer) -> dict[str, ColorRamp]:
    """The ramps by global names of elements. Of several for one element the last holds. Reports what is wrong."""
    composition = typer.symbols.composition
    places: dict[str, tuple[str, Span]] = {}
    found: dict[str, ColorRamp] = {}
    for pack, name, entry in composition.entries():
        if entry.ramp is None:
            continue
        with suppress(Poisoned):
            field = _field(pack, entry.ramp, typer)
            if field is None or name not in composition.elements:
                continue
            ramp = _ramp(field, composition.elements[name], entry.ramp, typer)
            here = pack, entry.ramp.name.span
            if name in found and found[name] != ramp:
                report_replaced("color_by", name, places[name], here, composition, typer.reporter)
            places[name], found[name] = here, ramp
    return found


def _field(pack: str, decl: RampDecl, typer: Typer) -> Field | None:
    """The field that a ramp follows; None if its pack is absent, or after reporting that it does not exist."""
    symbols, composition = typer.symbols, typer.symbols.composition
    name = composition.names.of(pack, decl.field.word)
    if name in composition.properties:
        fix = "a property is the same in all cells of an element: choose its `color` accordingly, or declare a field"
        raise typer.fail(
            "PD401", f"`{decl.field.word}` is a property", decl.field.span, "a color follows a field", fix
        )
    if name not in composition.fields and not decl.field.is_optional:
        report_unknown("field", decl.field, symbols.fields, typer.reporter)
    return symbols.fields.get(name)


def _ramp(field: Field, element: Element, decl: RampDecl, typer: Typer) -> ColorRamp:
    """The ramp of an element. Raises Poisoned after reporting that cells cannot show the field, or not this range."""
    kind = field.kind
    declared = (Label(field.span, "declared here"),)
    if kind.name not in ORDERED:
        fix = "a color follows numbers and flags: LOW..HIGH, real(LOW..HIGH), flag"
        if kind.name == "vec2":
            fix = f"declare a field for its length, `real(0..{kind.hi:g})`, and assign it in a pass"
        typer.reporter.error(
            "PD401", f"a color cannot follow a field of kind {kind}", decl.field.span, "its values have no order",
            secondary=declared, helps=[fix],
        )  # fmt: skip
        raise Poisoned
    if field.of is not None and element.id not in field.of:
        typer.reporter.error(
            "PD407", f"`{element.name}` has no `{field.name}`", decl.field.span, f"`of:` leaves `{element.name}` out",
            secondary=declared, helps=[f"add `{element.name}` to `of:`, or remove `color_by`"],
        )  # fmt: skip
        raise Poisoned
    least, most = (0, 1) if kind.name == "flag" else (int(kind.lo), int(kind.hi))
    lo, hi = read_bounds(decl.over, typer) if decl.over is not None else (least, most)
    if not least <= lo <= hi <= most and decl.over is not None:
        typer.reporter.error(
            "PD402", f"`{field.name}` does not reach all of {lo}..{hi}", decl.over.span, f"its values are {least}..{most}",
            secondary=declared, helps=[f"write a range within `{least}..{most}`, or leave out `over` for all of it"],
        )  # fmt: skip
        raise Poisoned
    if lo == hi:
        place, fix = decl.field.span, f"widen the kind of `{field.name}`, or remove `color_by`"
        if decl.over is not None:
            place, fix = decl.over.span, "give a range of at least two values"
        raise typer.fail(
            "PD402", f"a range of the single value {lo}", place, "the color cannot change here", fix
        )
    return ColorRamp(field.name, decl.start or element.color, decl.end, lo, hi, kind.name == "real")
