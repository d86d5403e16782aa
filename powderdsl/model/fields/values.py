"""Defaults of fields by element: beside the field, in the element's entry, or under `also`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from difflib import get_close_matches

from powderdsl.diagnostics import Label, suggest
from powderdsl.model.composition.contested import given_values
from powderdsl.model.expressions.operands import Poisoned, Scope
from powderdsl.model.expressions.symbols import Symbols, clamped
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.schema import KEYS
from powderdsl.model.types import Field
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

Written = tuple[str, str, Scalar, Syntax]
"""A field, an element, the key, the value."""


def add_field_values(symbols: Symbols, typer: Typer) -> None:
    """Give the fields the defaults of single elements. Reports what is wrong with them."""
    found: dict[str, dict[int, object]] = {}
    ids = {name: element.id for name, element in symbols.composition.elements.items()}
    for pack, (name, element, key, syntax) in _written(symbols, typer):
        field = symbols.fields.get(name)
        if field is None or element not in ids or not _may_have(field, ids[element], element, key, typer):
            continue
        try:
            value = typer.constant(syntax, field.kind, Scope(pack, {}))
        except Poisoned:
            continue
        found.setdefault(name, {})[ids[element]] = clamped(value, field.kind)
    for name, values in found.items():
        field = symbols.fields[name]
        own = tuple((i, value) for i, value in sorted(values.items()) if value != field.default)
        symbols.fields[name] = replace(field, own=own)


def _written(symbols: Symbols, typer: Typer) -> Iterator[tuple[str, Written]]:
    """Every value of a field with the pack that says it, in rising precedence."""
    composition = symbols.composition
    for pack, name, element, key, syntax in given_values(composition):
        if name in composition.fields and element in composition.elements:
            yield pack, (name, element, key, syntax)
    for name, field in composition.fields.items():
        for key, _ in field.decl.values:
            known = composition.element(key.text.removesuffix("?"), field.pack)
            if known is None and not key.text.endswith("?"):
                unknown_element_key(key, "field", f"the field `{name}`", symbols, typer)


def unknown_element_key(key: Scalar, context: str, what: str, symbols: Symbols, typer: Typer) -> None:
    """Report a key that should be an element's name: it may also be a misspelled key of the table."""
    close = get_close_matches(key.text.lower(), sorted(KEYS[context]), n=1, cutoff=0.75)
    if close:
        helps = [f"did you mean `{close[0]}`?"]
        typer.reporter.error(
            "PD108", f"unknown key `{key.text}`", key.span, f"not a key of {what}", helps=helps
        )
        return
    helps = [
        *suggest(key.text, symbols.composition.elements, "elements"),
        f"if its pack may be absent, write `{key.text}?`",
    ]
    typer.reporter.error("PD301", f"unknown element `{key.text}`", key.span, helps=helps)


def _may_have(field: Field, number: int, element: str, key: Scalar, typer: Typer) -> bool:
    """Whether fresh cells of the element can have a value of their own; reports if not."""
    if field.at != "element":
        label, fix = "a field of a place belongs to no element", "say `at: element`"
    elif field.resets:
        label, fix = "what resets has one default for all", "leave out `resets`, or set it in a pass"
    elif field.of is not None and number not in field.of:
        label, fix = f"`of:` leaves `{element}` out", f"add `{element}` to `of:`"
    else:
        return True
    other = (Label(field.span, "declared here"),)
    typer.reporter.error(
        "PD407",
        f"`{element}` cannot have a `{field.name}` of its own",
        key.span,
        label,
        secondary=other,
        helps=[fix],
    )
    return False
