"""Declarations -> symbols of the checker: kernels, parameters, properties, fields and sets, with their values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from powderdsl.diagnostics import Label, Span, suggest
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.contested import given_values
from powderdsl.model.composition.names import Named, report_unknown
from powderdsl.model.declarations import (
    ElementDecl,
    FieldDecl,
    KernelDecl,
    ParamDecl,
    PropertyDecl,
    TintDecl,
    TypedDecl,
)
from powderdsl.model.expressions.operators import Broken, Operand, Poisoned, Scope, SetOf, Unresolved
from powderdsl.model.expressions.symbols import clamped, default_of, not_a_value, number_value, read_kind
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.schema import keys_of
from powderdsl.model.types import CHANCE, FLAG, Field, Kernel, Kind, Param, Property, Tint, Value
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

KINDS = {
    "parameter": (("chance", "int", "real", "flag"), "kinds: chance, LOW..HIGH, real(LOW..HIGH), flag"),
    "property": (("int", "flag", "chance"), "kinds of properties: LOW..HIGH, flag, chance"),
    "field": (("int", "flag", "real", "vec2", "element", "direction"), "use `real(0..1)`"),
}
"""The kinds that each may have, and what to write instead of another one."""


def define_symbols(typer: Typer) -> list[tuple[str, int, Span]]:
    """Complete a typer's symbols, whose names are known. Reports what is wrong with definitions and leaves it out.

    Returns:
        Where elements' own values of properties stand: property, id, place.
    """
    symbols, composition = typer.symbols, typer.symbols.composition
    _check_param_names(typer)
    for name, kernel in composition.kernels.items():
        if kernel.decl.shape is not None:
            symbols.constants[name] = _shaped(kernel, kernel.decl.shape, typer)
    for name, param in composition.params.items():
        with suppress(Poisoned):
            symbols.params[name] = _param(param, typer)
    for key, syntax in _ruleset_params(composition):
        known = symbols.params.get(key.text)
        if known is None:
            helps = suggest(key.text, symbols.params, "parameters")
            typer.reporter.error(
                "PD309", f"unknown parameter `{key.text}`", key.span, "no loaded pack defines it", helps=helps
            )
            continue
        with suppress(Poisoned):
            value = typer.constant(syntax, known.kind, Scope("", {}))
            symbols.params[key.text] = replace(known, default=value)
    for name, prop in composition.properties.items():
        with suppress(Poisoned):
            kind = _kind("property", prop.decl, typer)
            symbols.properties[name] = Property(name, kind, (), frozenset(), prop.pack, prop.span, prop.word)
    for name, field in composition.fields.items():
        with suppress(Poisoned):
            symbols.fields[name] = _field(field, typer)
    given = _element_values(typer)
    for name, prop in composition.properties.items():
        if name in symbols.properties:
            symbols.properties[name] = replace(symbols.properties[name], values=_values(prop, given, typer))
    for name, named in composition.sets.items():
        try:
            if name not in symbols.constants:
                typer.resolve_set(name, named.decl.members.span)
        except Poisoned:
            symbols.constants.setdefault(name, Broken())
        except Unresolved:
            symbols.constants.setdefault(name, SetOf(()))
    typer.used.clear()
    ids = {name: element.id for name, element in composition.elements.items()}
    return [(name, ids[of], syntax.span) for (name, of), (syntax, _) in given.items() if of in ids]


def _check_param_names(typer: Typer) -> None:
    """A parameter may not hide a global word that its pack knows: a rule would read the other one without a sign."""
    composition = typer.symbols.composition
    for named in composition.params.values():
        name = composition.names.of(named.pack, named.decl.name.text)
        other = composition.definitions.get(name)
        if other is not None and composition.names.knows(named.pack, name):
            typer.reporter.error(
                "PD308", f"the parameter `{name}` hides another `{name}`", named.span, "the same word",
                secondary=[Label(other.span, "this one")], helps=["rename the parameter"],
            )  # fmt: skip


def _shaped(named: Named[KernelDecl], shape: Syntax, typer: Typer) -> Operand:
    """A kernel that is declared by a shape and its radius."""
    try:
        found = typer.evaluate(shape, Scope(named.pack, {}))
        if not isinstance(found, Kernel):
            fix = "such as `box(5)`, or rows of weights"
            raise typer.wrong(found, "a shape with its radius", shape.span, fix)
        return replace(found, name=named.name, wrap=named.decl.wrap)
    except (Poisoned, Unresolved):
        return Broken()


# Parameters


def _kind(noun: str, decl: TypedDecl, typer: Typer) -> Kind:
    """The kind of a definition. Raises Poisoned after reporting one that it may not have."""
    if decl.type is None:
        if noun == "parameter" and decl.default is not None:
            return _kind_of_literal(decl.name.text, decl.default, typer)
        raise Poisoned
    kind = read_kind(decl.type, typer)
    allowed, fix = KINDS[noun]
    if kind.name not in allowed:
        raise typer.fail("PD401", f"a {noun} cannot be a {kind}", decl.type.span, "", fix)
    return kind


def _kind_of_literal(name: str, default: Syntax, typer: Typer) -> Kind:
    """`rate: 2%` is a chance, `wet: yes` a flag; other numbers must say their range."""
    if default.kind == "percent":
        return CHANCE
    if default.kind in ("yes", "no"):
        return FLAG
    value, chance = default.span.text, ""
    if re.fullmatch(r"0?\.[0-9]+|[0-9]{1,2}", value):
        chance = f"`{100 * float(value):g}%`, or " if "." in value else f"`{value}%`, or "
    bounds = "real(0..1)" if "." in value else "0..9"
    raise typer.fail(
        "PD401", f"the parameter `{name}` does not say its kind", default.span, "neither a percentage nor `yes` or `no`",
        f"write {chance}`{name}: {{type: {bounds}, default: {value}}}`",
    )  # fmt: skip


def _param(named: Named[ParamDecl], typer: Typer) -> Param:
    kind = _kind("parameter", named.decl, typer)
    if named.decl.default is None:
        raise Poisoned
    value = typer.constant(named.decl.default, kind, Scope(named.pack, {}))
    return Param(named.name, kind, value, named.decl.about, named.span)


def _ruleset_params(composition: Composition) -> Iterator[tuple[Scalar, Syntax]]:
    """The values that rulesets give to parameters, bases first; values for packs that are left out are skipped."""
    loaded = {pack.name.text for pack in composition.packs}
    for ruleset in composition.lineage:
        for key, syntax in ruleset.params:
            pack = key.text.partition(".")[0]
            if pack in loaded or not any(pack in one.members for one in ruleset.lineage):
                yield key, syntax


# Fields and properties


def _field(named: Named[FieldDecl], typer: Typer) -> Field:
    decl, scope = named.decl, Scope(named.pack, {})
    kind = _kind("field", decl, typer)
    default = default_of(kind, typer.symbols.first_id)
    if decl.default:
        default = typer.constant(decl.default, kind, scope)
    of = None
    if decl.of is not None:
        of = frozenset(typer.set_of(typer.evaluate(decl.of, scope), decl.of.span).ids)
        if decl.at != "element":
            label = "a field of a place belongs to no element"
            raise typer.fail("PD401", "`of` needs `at: element`", decl.of.span, label)
    resets = decl.resets is not None
    return Field(
        named.name, kind, clamped(default, kind), decl.at, resets, of, named.pack, named.span,
        word=named.word, tint=_tint(decl.tint, kind, typer, scope) if decl.tint else None,
    )  # fmt: skip


def _tint(decl: TintDecl, kind: Kind, typer: Typer, scope: Scope) -> Tint:
    """The tint of a field. Raises Poisoned after reporting that it is not a vector."""
    if kind.name != "vec2":
        fix = "cells show numbers and flags with `color_by`, under their element"
        raise typer.fail(
            "PD401", f"a field of kind {kind} tints nothing", decl.name.span, "only vectors do", fix
        )
    most = typer.constant(decl.most, CHANCE, scope) if decl.most else 1
    return Tint(decl.color, decl.full, float(most))  # type: ignore[arg-type]  # a chance is a number


Given = Mapping[tuple[str, str], tuple[Syntax, str]]
"""By property and element, global names: the value that holds, and the pack that gives it."""


def _element_values(typer: Typer) -> Given:
    """The properties' values of single elements; fields get theirs. Reports keys that name nothing."""
    symbols, composition = typer.symbols, typer.symbols.composition
    given: dict[tuple[str, str], tuple[Syntax, str]] = {}
    own: dict[str, dict[int, Value]] = {}
    for pack, name, word, key, syntax in given_values(composition):
        element = composition.elements.get(word)
        field = symbols.fields.get(name)
        if name in composition.properties:
            given[name, word] = (syntax, pack)
        elif name not in composition.fields:
            if not key.is_optional:
                keys = [own for own in keys_of(ElementDecl) if own != "override"]
                known = (*composition.properties, *composition.fields, *keys)
                report_unknown("property", key, known, typer.reporter, "PD108")
        elif field and element and _may_have(field, element.id, word, key, typer):
            with suppress(Poisoned):
                value = typer.constant(syntax, field.kind, Scope(pack, {}))
                own.setdefault(name, {})[element.id] = clamped(value, field.kind)
    declared: list[Named[Any]] = [*composition.properties.values(), *composition.fields.values()]
    for named in declared:
        for key, _ in named.decl.values:
            if composition.element(key.word, named.pack) is None and not key.is_optional:
                _report_unknown_key(key, named, typer)
    for name, values in own.items():
        field = symbols.fields[name]
        kept = tuple((number, value) for number, value in sorted(values.items()) if value != field.default)
        symbols.fields[name] = replace(field, own=kept)
    return given


def _report_unknown_key(key: Scalar, named: Named[Any], typer: Typer) -> None:
    """Report a key that should be an element's name: it may also be a misspelled key of the table."""
    close = get_close_matches(key.text.lower(), sorted(keys_of(type(named.decl))), n=1, cutoff=0.75)
    if not close:
        report_unknown("element", key, typer.symbols.composition.elements, typer.reporter)
        return
    typer.reporter.error(
        "PD108", f"unknown key `{key.text}`", key.span, f"not a key of the {named.decl.NOUN.removeprefix('a ')} `{named.name}`",
        helps=[f"did you mean `{close[0]}`?"],
    )  # fmt: skip


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
    typer.reporter.error(
        "PD407", f"`{element}` cannot have a `{field.name}` of its own", key.span, label,
        secondary=[Label(field.span, "declared here")], helps=[fix],
    )  # fmt: skip
    return False


def _values(named: Named[PropertyDecl], given: Given, typer: Typer) -> tuple[Value | str, ...]:
    """A property's values by id."""
    composition, prop = typer.symbols.composition, typer.symbols.properties[named.name]
    default = named.decl.default
    values = [
        _value(prop, default, named.pack, typer) if default else default_of(prop.kind)
    ] * composition.slots
    for name, element in composition.elements.items():
        if (prop.name, name) in given:
            values[element.id] = _value(prop, *given[prop.name, name], typer)
    return tuple(values)


def _value(prop: Property, syntax: Syntax, pack: str, typer: Typer) -> Value | str:
    """A property's value as a pack gives it. It may name a parameter, which stays changeable."""
    scope, kind = Scope(pack, {}), prop.kind
    if syntax.kind == "name" and typer.find(syntax.text, syntax.span, scope) is None:
        not_a_value(prop, syntax, typer)
        return default_of(kind)
    try:
        expr = typer.of_kind(typer.evaluate(syntax, scope), kind, syntax.span)
    except (Poisoned, Unresolved):
        return default_of(kind)
    if expr.op == "param":
        if expr.kind.name != kind.name or not kind.lo <= expr.kind.lo <= expr.kind.hi <= kind.hi:
            label, fix = f"it is {expr.kind}", f"declare it as {kind}"
            typer.fail("PD402", f"the parameter may leave {kind}", syntax.span, label, fix)
        return str(expr.value)
    if expr.op == "const":
        return number_value(expr, kind)
    typer.fail("PD405", "expected a constant or a parameter", syntax.span, "depends on the world")
    return default_of(kind)
