"""Declarations -> symbols of the checker: kernels, parameters, properties, fields, sets and ramps, with their values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.builtins import FLAG_WORDS
from powderdsl.model.composition.added_packs import report_replaced
from powderdsl.model.composition.names import report_unknown
from powderdsl.model.declarations import ElementDecl, FieldDecl, KernelDecl, PropertyDecl, RampDecl, TypedDecl
from powderdsl.model.expressions.operators import Broken, Operand, Poisoned, Scope, SetOf, Unresolved
from powderdsl.model.expressions.symbols import clamp, default_of, read_bounds, read_kind
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.schema import keys_of
from powderdsl.model.state import stored_range
from powderdsl.model.types import (
    CHANCE,
    FLAG,
    ColorRamp,
    Element,
    Field,
    Kernel,
    Kind,
    Param,
    Property,
    Ruleset,
    Tint,
    Value,
)
from powderdsl.syntax.parse import Syntax

ORDERED = ("int", "flag", "real")
"""Kinds of fields that a color can follow, whose values are ordered."""

KINDS = {
    "parameter": (("chance", "int", "real", "flag"), "kinds: chance, LOW..HIGH, real(LOW..HIGH), flag"),
    "property": (("int", "flag", "chance"), "kinds of properties: LOW..HIGH, flag, chance"),
    "field": (("int", "flag", "real", "vec2", "element", "direction"), "use `real(0..1)`"),
}
"""The kinds that each may have, and the fix for any other kind."""


def define_symbols(typer: Typer) -> list[tuple[str, int, Span]]:
    """Complete the symbols of a typer that knows their names. Reports wrong definitions and leaves them out.

    Returns the elements' own values of properties: property, id, span.
    """
    symbols = typer.symbols
    names, elements = symbols.names, symbols.elements
    for name, kernel in names.declared(KernelDecl).items():
        if kernel.shape is not None:
            symbols.constants[name] = _shaped_kernel(name, kernel, kernel.shape, typer)
    for name, param in symbols.param_decls.items():
        word = names.of(param.pack, param.name.text)
        if word in names.versions and names.knows(param.pack, word):
            # A rule would silently read the other one.
            typer.reporter.error(
                "PD308", f"the parameter `{word}` hides another `{word}`", param.span, "the same name",
                secondary=[Label(names.versions[word][-1].span, "this one")], helps=["rename the parameter"],
            )  # fmt: skip
        with suppress(Poisoned):
            kind = _kind("parameter", param, typer)
            if param.default is not None:
                value = typer.constant(param.default, kind, Scope(param.pack, {}))
                symbols.params[name] = Param(name, kind, value, param.about, param.span)
    _set_params_of_rulesets(typer)
    properties = names.declared(PropertyDecl)
    for name, prop in properties.items():
        with suppress(Poisoned):
            kind, word = _kind("property", prop, typer), prop.name.text
            symbols.properties[name] = Property(
                name, kind, (), frozenset(), prop.pack, prop.span, word if word != name else ""
            )
    for name, decl in names.declared(FieldDecl).items():
        with suppress(Poisoned):
            symbols.fields[name] = _field(name, decl, typer)
    values_of = _element_values(typer)
    for name, known in symbols.properties.items():
        prop = properties[name]
        usual = _value(known, prop.default, prop.pack, typer) if prop.default else default_of(known.kind)
        values = [usual] * symbols.slots
        for word, (pack, _, syntax) in values_of[name].items():
            values[elements[word].id] = _value(known, syntax, pack, typer)
        symbols.properties[name] = replace(known, values=tuple(values))
    for name, field in symbols.fields.items():
        own: dict[int, Value] = {}
        for word, (pack, span, syntax) in values_of[name].items():
            number = elements[word].id
            with suppress(Poisoned):
                _check_may_have(field, number, word, span, typer)
                value = clamp(typer.constant(syntax, field.kind, Scope(pack, {})), field.kind)
                own |= {number: value} if value != field.default else {}
        symbols.fields[name] = replace(field, own=tuple(sorted(own.items())))
    for name, named_set in typer.sets.items():
        try:
            if name not in symbols.constants:
                typer.resolve_set(name, named_set.members.span)
        except Poisoned:
            symbols.constants.setdefault(name, Broken())
        except Unresolved:
            symbols.constants.setdefault(name, SetOf(()))
    typer.used.clear()
    return [
        (name, elements[word].id, syntax.span)
        for name in properties
        for word, (_, _, syntax) in values_of[name].items()
    ]


def _shaped_kernel(name: str, decl: KernelDecl, shape: Syntax, typer: Typer) -> Operand:
    try:
        kernel = typer.evaluate(shape, Scope(decl.pack, {}))
        if not isinstance(kernel, Kernel):
            fix = "such as `box(5)`, or rows of weights"
            raise typer.wrong(kernel, "a shape with its radius", shape.span, fix)
        return replace(kernel, name=name, wrap=decl.edges == "wrap")
    except (Poisoned, Unresolved):
        return Broken()


# Parameters


def _kind(noun: str, decl: TypedDecl, typer: Typer) -> Kind:
    """The kind of a definition. Raises Poisoned after reporting one that is not allowed."""
    if decl.type is not None:
        kind = read_kind(decl.type, typer)
        allowed, fix = KINDS[noun]
        if kind.name not in allowed:
            raise typer.fail("PD401", f"a {noun} cannot be a {kind}", decl.type.span, "", fix)
        return kind
    default = decl.default
    if noun != "parameter" or default is None:
        raise Poisoned
    # `rate: 2%` is a chance, `wet: yes` a flag; other numbers must declare a range.
    if default.kind == "percent":
        return CHANCE
    if default.kind in ("yes", "no"):
        return FLAG
    name, value = decl.name.text, default.span.text
    bounds = "real(0..1)" if "." in value else "0..9"
    raise typer.fail(
        "PD401", f"the parameter `{name}` lacks a kind", default.span, "neither a percentage nor `yes` or `no`",
        f"write a percentage, or `{name}: {{type: {bounds}, default: {value}}}`",
    )  # fmt: skip


def _set_params_of_rulesets(typer: Typer) -> None:
    """Give parameters the values of rulesets, bases first; values for packs that are left out are skipped."""
    params = typer.symbols.params
    for ruleset in typer.symbols.ruleset.lineage:
        for key, syntax in ruleset.params:
            pack, known = key.text.partition(".")[0], params.get(key.text)
            if pack not in typer.symbols.packs and any(pack in member.members for member in ruleset.lineage):
                continue
            if known is None:
                helps = suggest(key.text, params, "parameters")
                message = f"unknown parameter `{key.text}`"
                typer.reporter.error("PD309", message, key.span, "no loaded pack defines it", helps=helps)
                continue
            with suppress(Poisoned):
                value = typer.constant(syntax, known.kind, Scope("", {}))
                params[key.text] = replace(known, default=value)


# Fields and properties


def _field(name: str, decl: FieldDecl, typer: Typer) -> Field:
    scope, word = Scope(decl.pack, {}), decl.name.text
    kind = _kind("field", decl, typer)
    default = default_of(kind, typer.symbols.first_id)
    if decl.default:
        default = typer.constant(decl.default, kind, scope)
    of = tint = None
    if decl.of is not None:
        of = frozenset(typer.set_of(typer.evaluate(decl.of, scope), decl.of.span).ids)
        if decl.at != "element":
            label = "a field of places does not belong to elements"
            raise typer.fail("PD401", "`of` needs `at: element`", decl.of.span, label)
    if decl.tint is not None:
        if kind.name != "vec2":
            message, place = f"a field of kind {kind} tints nothing", decl.tint.name.span
            fix = "to show numbers and flags, use `color_by` of an element"
            raise typer.fail("PD401", message, place, "only vectors do", fix)
        most = typer.constant(decl.tint.most, CHANCE, scope) if decl.tint.most else 1
        tint = Tint(decl.tint.color, decl.tint.full, float(most))  # type: ignore[arg-type]  # a chance is a number
    return Field(
        name, kind, clamp(default, kind), decl.at, decl.resets is not None, of, decl.pack, decl.span,
        word=word if word != name else "", tint=tint,
    )  # fmt: skip


def _element_values(typer: Typer) -> dict[str, dict[str, tuple[str, Span, Syntax]]]:
    """The pack, span and syntax of each value, by global name of the property or field, then of the element.

    Reports keys that name nothing, and values that are replaced by others.
    """
    symbols, names = typer.symbols, typer.symbols.names
    declared: dict[str, PropertyDecl | FieldDecl] = {
        **names.declared(PropertyDecl),
        **names.declared(FieldDecl),
    }
    values_of: dict[str, dict[str, tuple[str, Span, Syntax]]] = defaultdict(dict)
    for pack, name, word, key, syntax in symbols.given_values():
        if name not in declared:
            keys = (own for own in keys_of(ElementDecl) if own != "override")
            report_unknown("property", key, (*declared, *keys), typer.reporter, "PD108")
        elif word in symbols.elements:
            value = pack, key.span, syntax
            if word in values_of[name]:
                report_replaced(name, word, values_of[name][word], value, symbols, typer.reporter)
            values_of[name][word] = value
    for name, decl in declared.items():
        for key, _ in decl.values:
            if key.is_optional or symbols.element(key.word, decl.pack) is not None:
                continue
            # It should be an element's name, but may also be a misspelled key.
            close = get_close_matches(key.text.lower(), sorted(keys_of(type(decl))), n=1, cutoff=0.75)
            if close:
                label = f"not a key of the {decl.NOUN.removeprefix('a ')} `{name}`"
                helps = [f"did you mean `{close[0]}`?"]
                typer.reporter.error("PD108", f"unknown key `{key.text}`", key.span, label, helps=helps)
            else:
                report_unknown("element", key, symbols.elements, typer.reporter)
    return values_of


def _check_may_have(field: Field, number: int, element: str, span: Span, typer: Typer) -> None:
    """Report that fresh cells of the element cannot have another default of the field. Raises Poisoned."""
    if field.at != "element":
        label, fix = "a field of places does not belong to elements", "write `at: element`"
    elif field.resets:
        label, fix = "a field that resets has one default", "omit `resets`, or set the field in a pass"
    elif field.of is not None and number not in field.of:
        label, fix = f"`of:` leaves `{element}` out", f"add `{element}` to `of:`"
    else:
        return
    message = f"`{element}` cannot have its own `{field.name}`"
    raise typer.fail("PD407", message, span, label, fix, secondary=[Label(field.span, "declared here")])


def _value(prop: Property, syntax: Syntax, pack: str, typer: Typer) -> Value | str:
    """A property's value as written in a pack. It may be a parameter, which remains adjustable."""
    scope, kind = Scope(pack, {}), prop.kind
    if syntax.kind == "name" and typer.find(syntax.text, syntax.span, scope) is None:
        message, label = f"`{syntax.text}` is not a value of `{prop.name}`", f"expected {describe_kind(kind)}"
        fix = f"write {describe_kind(kind)}, or a parameter of this pack"
        typer.fail("PD110", message, syntax.span, label, fix)
        return default_of(kind)
    with suppress(Poisoned, Unresolved):
        expr = typer.of_kind(typer.evaluate(syntax, scope), kind, syntax.span)
        if expr.op != "param":
            return typer.constant_of(expr, syntax.span)
        if expr.kind.name == kind.name and kind.lo <= expr.kind.lo <= expr.kind.hi <= kind.hi:
            return str(expr.value)
        label, fix = f"it is {expr.kind}", f"declare it as {kind}"
        typer.fail("PD402", f"the parameter may exceed {kind}", syntax.span, label, fix)
    return default_of(kind)


# Colors that follow fields


def element_ramps(typer: Typer) -> dict[str, ColorRamp]:
    """The ramps by global names of elements. The last of several ramps of an element applies. Reports wrong ramps."""
    symbols = typer.symbols
    properties = symbols.names.declared(PropertyDecl)
    fields = symbols.names.declared(FieldDecl)
    ramps: dict[str, tuple[str, Span, ColorRamp]] = {}
    for name, entry in symbols.entries:
        if entry.ramp is None:
            continue
        pack, word, element = entry.pack, entry.ramp.field, symbols.elements.get(name)
        field_name = symbols.names.of(pack, word.word)
        field = symbols.fields.get(field_name)
        with suppress(Poisoned):
            if field_name in properties:
                fix = "a property is the same in all cells of an element: choose its `color` accordingly, or declare a field"
                raise typer.fail(
                    "PD401", f"`{word.word}` is a property", word.span, "a color follows a field", fix
                )
            if field_name not in fields:
                report_unknown("field", word, symbols.fields, typer.reporter)
            if field is None or element is None:
                continue
            value = pack, entry.ramp.name.span, _ramp(field, element, entry.ramp, typer)
            if name in ramps:
                report_replaced("color_by", name, ramps[name], value, symbols, typer.reporter)
            ramps[name] = value
    return {name: ramp for name, (_, _, ramp) in ramps.items()}


def _ramp(field: Field, element: Element, decl: RampDecl, typer: Typer) -> ColorRamp:
    """The ramp of an element. Raises Poisoned after reporting that cells cannot have the field or the range."""
    kind, declared = field.kind, [Label(field.span, "declared here")]
    if kind.name not in ORDERED:
        fix = "a color follows numbers and flags: LOW..HIGH, real(LOW..HIGH), flag"
        if kind.name == "vec2":
            fix = f"declare a field for its length, `real(0..{kind.hi:g})`, and assign it in a pass"
        message, label = f"a color cannot follow a field of kind {kind}", "its values have no order"
        raise typer.fail("PD401", message, decl.field.span, label, fix, secondary=declared)
    if field.of is not None and element.id not in field.of:
        message, label = f"`{element.name}` has no `{field.name}`", f"`of:` leaves `{element.name}` out"
        fix = f"add `{element.name}` to `of:`, or remove `color_by`"
        raise typer.fail("PD407", message, decl.field.span, label, fix, secondary=declared)
    least, most = (0, 1) if kind.name == "flag" else (int(kind.lo), int(kind.hi))
    lo, hi = read_bounds(decl.over, typer) if decl.over is not None else (least, most)
    if not least <= lo <= hi <= most and decl.over is not None:
        message, label = f"{lo}..{hi} exceeds the range of `{field.name}`", f"its values are {least}..{most}"
        fix = f"write a range within `{least}..{most}`, or omit `over` to use all of it"
        raise typer.fail("PD402", message, decl.over.span, label, fix, secondary=declared)
    if lo == hi:
        place, label = (decl.over or decl.field).span, "the color cannot change here"
        fix = "give a range of at least two values, or remove `color_by`"
        raise typer.fail("PD402", f"a range of the single value {lo}", place, label, fix)
    return ColorRamp(field.name, decl.start or element.color, decl.end, lo, hi, kind.name == "real")


# Values of parameters from commands, tasks, studies and programs


def set_params(ruleset: Ruleset, values: Mapping[str, Any], reporter: Reporter) -> Ruleset:
    """The ruleset with other parameter values, checked against their kinds."""
    if not isinstance(values, Mapping):
        raise TypeError(f"params takes a mapping from names to values, found {type(values).__name__}")
    known = {param.name: param for param in ruleset.params}
    checked_values: dict[str, Value] = {}
    for name, value in values.items():
        if name not in known:
            names = ", ".join(sorted(known)) or "none"
            close = [f"did you mean `{other}`?" for other in known if other.endswith(f".{name}")]
            helps = close[:1] or suggest(name, known, "parameters") or (f"parameters: {names}",)
            reporter.error("PD309", f"unknown parameter `{name}`", None, helps=helps)
            continue
        kind = known[name].kind
        number = param_value(kind, value)
        if number is None:
            helps = (f"write {describe_kind(kind)}",)
            reporter.error("PD402", f"parameter `{name}` cannot be `{value}`", None, helps=helps)
        else:
            checked_values[name] = number
    return ruleset.with_params(checked_values)


def describe_kind(kind: Kind) -> str:
    """The values of a kind, in words for messages."""
    wanted = f"{'an integer' if kind.name == 'int' else 'a number'} from {kind.lo:g} to {kind.hi:g}"
    return {"flag": "`yes` or `no`", "chance": "a chance from 0% to 100%"}.get(kind.name, wanted)


def param_value(kind: Kind, value: Any) -> Value | None:
    """Convert a text (``"5%"``, ``"yes"``) or a number to a value of a kind; None if it is not one."""
    text = value.strip() if isinstance(value, str) else ""
    if not text.isascii():  # unlike Python, rules do not allow digits of other scripts
        return None
    try:
        number = float(text[:-1]) / 100 if text.endswith("%") else float(FLAG_WORDS.get(text, value))
    except (TypeError, ValueError, OverflowError):
        return None
    lo, hi = stored_range(kind)
    if not lo <= number <= hi:
        return None
    if kind.name not in ("int", "flag"):
        return number
    return int(number) if number == int(number) else None
