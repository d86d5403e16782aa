"""Declared color ramps -> checked ones: elements whose color follows a field."""

from __future__ import annotations

from powderdsl.diagnostics import Label, Span
from powderdsl.model.composition.contested import report_replaced
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.declarations import RampDecl
from powderdsl.model.expressions.coercer import read_bounds
from powderdsl.model.expressions.operands import Poisoned
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
        element, decl = composition.elements.get(name), entry.ramp
        field = _field(pack, decl, typer) if decl else None
        if decl is None or element is None or field is None or not _shows(field, element, decl, typer):
            continue
        ramp = _ramp(field, element, decl, typer)
        if ramp is None:
            continue
        here = pack, decl.key.span
        if name in found and found[name] != ramp:
            report_replaced("color_by", name, places[name], here, composition, typer.reporter)
        places[name], found[name] = here, ramp
    return found


def _field(pack: str, decl: RampDecl, typer: Typer) -> Field | None:
    """The field that a ramp follows; None if its pack is absent, or after reporting that it does not exist."""
    symbols, composition = typer.symbols, typer.symbols.composition
    word = decl.field.word
    owner, _, base = word.rpartition(".")
    name = (composition.names.qualified(owner, base) if owner else None) or composition.names.of(pack, word)
    if name in composition.fields:
        return symbols.fields.get(name)  # None: its own declaration was reported
    if name in composition.properties:
        typer.reporter.error(
            "PD401", f"`{word}` is a property", decl.field.span, "a color follows a field",
            helps=["a property is the same in all cells of an element: choose its `color` accordingly, or declare a field"],
        )  # fmt: skip
    elif not decl.field.is_optional:
        report_unknown("field", decl.field, symbols.fields, typer.reporter)
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
