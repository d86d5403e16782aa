"""Declarations -> checked model. One straight function; each step reports all it can."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from powderdsl.diagnostics import CompileError, Reporter, Span, suggest
from powderdsl.model.added_conflicts import AddedPacks
from powderdsl.model.composition.compose import Composition, compose
from powderdsl.model.composition.contested import given_values, report_contested
from powderdsl.model.composition.layout import matrix_channels, state_order
from powderdsl.model.composition.optional_names import report_misspelled
from powderdsl.model.composition.palette import Palette
from powderdsl.model.declarations import PackDecl, RulesetDecl, TypedDecl
from powderdsl.model.elaborate import Elaborated, Elaborator
from powderdsl.model.examples import check_assigned, check_examples
from powderdsl.model.expressions.operands import Broken, Poisoned, Scope, SetOf, Unresolved
from powderdsl.model.expressions.symbols import (
    Symbols,
    base_symbols,
    check_param_names,
    clamped,
    default_of,
    field_from,
    not_a_value,
    number_value,
    read_kind,
)
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.fields.values import add_field_values, unknown_element_key
from powderdsl.model.invariants import check_invariants
from powderdsl.model.logic.conflicts import check_logic
from powderdsl.model.logic.needless import (
    report_lost_writes,
    report_needless,
    report_undecided,
    report_undrawn,
    silent_rules,
)
from powderdsl.model.logic.satisfy import Facts
from powderdsl.model.logic.unused import overridden_ids, produced_ids, report_unused, without_dead_overrides
from powderdsl.model.ramps import element_ramps
from powderdsl.model.types import (
    CHANCE,
    FLAG,
    ColorRamp,
    Declared,
    Element,
    Kernel,
    Kind,
    Param,
    Property,
    Ruleset,
    Stream,
    Value,
)
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar


def resolve_names(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Palette | None = None,
) -> tuple[Typer, list[tuple[str, int, Span]]]:
    """What checks expressions against all names of some packs, and where elements' own values stand.

    Raises CompileError where names clash.
    """
    composition = compose(packs, ruleset, reporter, palette)
    reporter.raise_if_errors()  # with names that clash or packs that lack, rules would only be misread
    symbols = base_symbols(composition)
    typer = Typer(symbols, reporter)
    typer.set_definitions = {
        name: (named.pack, named.decl.members) for name, named in composition.sets.items()
    }
    check_param_names(symbols, reporter)
    _shaped_kernels(symbols, typer)
    _params(symbols, typer)
    _properties(symbols, typer)
    _fields(symbols, typer)
    add_field_values(symbols, typer)
    given = _property_values(symbols, typer)
    _sets(typer)
    return typer, given


def check(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Palette | None = None,
    elsewhere: Callable[[], Mapping[str, str]] = dict,
    *,
    alone: bool = False,
) -> Ruleset:
    """The checked model of some packs. Raises CompileError; warnings and notes stay with the reporter.

    Args:
        palette: ids that were recorded earlier, see `model/composition/palette.py`.
        elsewhere: words that packs define which are not loaded, with the pack.
        alone: no pack counts as added to others: rules that meet are errors.
    """
    typer, given = resolve_names(packs, ruleset, reporter, palette)
    symbols, composition = typer.symbols, typer.symbols.composition
    elaborated = Elaborator(typer).run(composition.passes)
    examples = check_examples(composition, typer)
    invariants = check_invariants(composition, typer, partial(_typer_of, packs))
    ramps = element_ramps(typer)
    typer.unknown.report()
    reporter.raise_if_errors()
    report_contested(composition, reporter)
    report_misspelled(packs, ruleset, elsewhere, reporter)

    elements = tuple(
        _tagged(element, composition, ramps.get(name)) for name, element in composition.elements.items()
    )
    passes = tuple(elaborated.passes)
    facts = _facts(symbols)
    stored = overridden_ids(passes, sorted(elaborated.overridden), facts)
    symbols.properties = {
        name: replace(p, stored=stored.get(name, frozenset())) for name, p in symbols.properties.items()
    }
    ids = {name: element.id for name, element in composition.elements.items()}
    check_assigned(examples, ids, symbols.properties, reporter)
    facts = _facts(symbols)
    passes, undecided = check_logic(
        passes,
        facts,
        elaborated,
        reporter,
        None if alone else AddedPacks(composition, partial(_alone, packs)),
    )
    report_unused(composition, typer, produced_ids(passes, facts))
    matrix = matrix_channels(composition, symbols, passes, reporter)
    reporter.raise_if_errors()
    undecided += report_needless(passes, facts, reporter)
    undecided += report_lost_writes(passes, symbols.fields, facts, silent_rules(reporter), reporter)
    found = Ruleset(
        name=composition.name,
        about=composition.about,
        packs=tuple(pack.name.text for pack in packs),
        elements=elements,
        slots=composition.slots,
        properties=tuple(symbols.properties.values()),
        fields=tuple(symbols.fields.values()),
        streams=_streams(symbols, elaborated, reporter),
        params=tuple(symbols.params.values()),
        passes=without_dead_overrides(passes, frozenset(name for name, ids in stored.items() if not ids)),
        matrix=matrix,
        side_multiple=composition.side_multiple,
        order=state_order(composition, symbols, passes),
        tests=examples,
        invariants=invariants,
        declared=Declared(tuple(packs), ruleset),
    )
    undecided += report_undrawn(found, given, facts, reporter)
    report_undecided(undecided, reporter)
    return found


def _typer_of(packs: Sequence[PackDecl], names: tuple[str, ...]) -> Typer | None:
    """What checks expressions where only some of these packs are loaded."""
    try:
        return resolve_names([pack for pack in packs if pack.name.text in names], None, Reporter())[0]
    except CompileError:
        return None


def _alone(packs: Sequence[PackDecl], names: tuple[str, ...], reporter: Reporter) -> Ruleset:
    """The model of some of these packs by themselves. Raises CompileError."""
    return check([pack for pack in packs if pack.name.text in names], None, reporter, alone=True)


def _facts(symbols: Symbols) -> Facts:
    limited = {name: f.of for name, f in symbols.fields.items() if f.of is not None}
    defaults: dict[str, object] = {name: symbols.fields[name].default for name in limited}
    names = {element.id: name for name, element in symbols.composition.elements.items()}
    return Facts(symbols.ids, symbols.properties, limited, defaults, symbols.composition.side_multiple, names)


def _shaped_kernels(symbols: Symbols, typer: Typer) -> None:
    """Kernels that are declared by a shape and its radius."""
    for name, named in symbols.composition.kernels.items():
        shape = named.decl.shape
        if shape is None:
            continue
        try:
            found = typer.evaluate(shape, Scope(named.pack, {}))
            if not isinstance(found, Kernel):
                fix = "such as `box(5)`, or rows of weights"
                raise typer.wrong(found, "a shape with its radius", shape.span, fix)
            symbols.constants[name] = replace(found, name=name, wrap=named.decl.wrap)
        except (Poisoned, Unresolved):
            symbols.constants.setdefault(name, Broken())


def _params(symbols: Symbols, typer: Typer) -> None:
    for qualified, named in symbols.composition.params.items():
        decl = named.decl
        try:
            kind = read_kind(decl.type, typer) if decl.type else None
            if decl.default is None:
                continue
            if kind is None:
                kind = _kind_of_literal(decl, typer)
            if kind.name not in ("chance", "int", "real", "flag"):
                raise typer.fail(
                    "PD401",
                    f"a parameter cannot be a {kind}",
                    decl.name.span,
                    "",
                    "kinds: chance, LOW..HIGH, real(LOW..HIGH), flag",
                )
            value = typer.constant(decl.default, kind, Scope(named.pack, {}))
        except Poisoned:
            continue
        symbols.params[qualified] = Param(qualified, kind, value, decl.about, decl.name.span)
    for key, syntax in _ruleset_params(symbols.composition):
        param = symbols.params.get(key.text)
        if param is None:
            typer.reporter.error(
                "PD309",
                f"unknown parameter `{key.text}`",
                key.span,
                "no loaded pack has it",
                helps=suggest(key.text, symbols.params, "parameters"),
            )
            continue
        try:
            symbols.params[key.text] = replace(
                param, default=typer.constant(syntax, param.kind, Scope("", {}))
            )
        except Poisoned:
            continue


def _ruleset_params(composition: Composition) -> Iterator[tuple[Scalar, Syntax]]:
    """The values that rulesets give to parameters, those of a base first; none for packs that are left out."""
    loaded = {pack.name.text for pack in composition.packs}
    for ruleset in composition.ruleset.lineage if composition.ruleset else ():
        for key, syntax in ruleset.params:
            pack = key.text.partition(".")[0]
            inherited = any(pack in one.members for one in ruleset.lineage)
            if pack in loaded or not inherited:
                yield key, syntax


def _kind_of_literal(decl: TypedDecl, typer: Typer) -> Kind:
    """`rate: 2%` is a chance, `wet: yes` a flag; other numbers must say their range."""
    assert decl.default is not None
    if decl.default.kind == "percent":
        return CHANCE
    if decl.default.kind in ("yes", "no"):
        return FLAG
    raise typer.fail(
        "PD401",
        f"the parameter `{decl.name.text}` does not say its kind",
        decl.default.span,
        "neither a percentage nor `yes` or `no`",
        _kind_help(decl.name.text, decl.default.span.text),
    )


def _kind_help(name: str, value: str) -> str:
    chance = f"`{100 * float(value):g}%`, or " if re.fullmatch(r"0?\.[0-9]+", value) else ""
    if re.fullmatch(r"[0-9]{1,2}", value):
        chance = f"`{value}%`, or "
    bounds = "real(0..1)" if "." in value else "0..9"
    return f"write {chance}`{name}: {{type: {bounds}, default: {value}}}`"


def _properties(symbols: Symbols, typer: Typer) -> None:
    for name, named in symbols.composition.properties.items():
        try:
            if named.decl.type is None:
                continue
            kind = read_kind(named.decl.type, typer)
            if kind.name in ("real", "vec2", "element", "direction"):
                raise typer.fail(
                    "PD401",
                    f"a property cannot be a {kind}",
                    named.decl.type.span,
                    "",
                    "kinds of properties: LOW..HIGH, flag, chance",
                )
        except Poisoned:
            continue
        word = named.decl.name.text
        symbols.properties[name] = Property(
            name, kind, (), frozenset(), named.pack, named.decl.name.span, word if word != name else ""
        )


def _property_values(symbols: Symbols, typer: Typer) -> list[tuple[str, int, Span]]:
    """Fill in the properties' values; where elements' own values stand: property, id, place."""
    composition = symbols.composition
    given: dict[tuple[str, str], tuple[Syntax, str]] = {}
    for pack, name, element, key, syntax in given_values(composition):
        if name in composition.properties:
            given[(name, element)] = (syntax, pack)
        elif name not in composition.fields and not key.text.endswith("?"):
            typer.reporter.error(
                "PD108",
                f"unknown property `{name}`",
                key.span,
                "no loaded pack declares it",
                helps=[
                    *suggest(
                        name,
                        [
                            *composition.properties,
                            *composition.fields,
                            "id",
                            "color",
                            "color_by",
                            "glyph",
                            "about",
                            "tags",
                        ],
                        "properties",
                    ),
                    f"if its pack may be absent, write `{name}?`",
                ],
            )
    for name, named in composition.properties.items():
        for key, _ in named.decl.values:
            word = key.text.removesuffix("?")
            if composition.element(word, named.pack) is None and not key.text.endswith("?"):
                unknown_element_key(key, "property", f"the property `{name}`", symbols, typer)
        if name in symbols.properties:
            prop = symbols.properties[name]
            symbols.properties[name] = replace(
                prop, values=_values(prop, named.decl, named.pack, given, symbols, typer)
            )
    ids = {name: element.id for name, element in composition.elements.items()}
    return [(name, ids[of], value[0].span) for (name, of), value in given.items() if of in ids]


def _values(
    prop: Property,
    decl: TypedDecl,
    pack: str,
    given: dict[tuple[str, str], tuple[Syntax, str]],
    symbols: Symbols,
    typer: Typer,
) -> tuple[Value | str, ...]:
    """A property's values by id. A value may name a parameter, which stays changeable."""

    def value(syntax: Syntax, owner: str) -> Value | str:
        if syntax.kind == "name" and typer.find(syntax.text, syntax.span, Scope(owner, {})) is None:
            not_a_value(prop, syntax, typer)
            return default_of(prop.kind)
        try:
            expr = typer.of_kind(typer.evaluate(syntax, Scope(owner, {})), prop.kind, syntax.span)
        except (Poisoned, Unresolved):
            return default_of(prop.kind)
        if expr.op == "param":
            if (
                expr.kind.name != prop.kind.name
                or not prop.kind.lo <= expr.kind.lo <= expr.kind.hi <= prop.kind.hi
            ):
                typer.fail(
                    "PD402", f"the parameter may leave {prop.kind}", syntax.span, f"it is {expr.kind}",
                    f"declare it as {prop.kind}")  # fmt: skip
            return str(expr.value)
        if expr.op != "const":
            typer.fail("PD405", "expected a constant or a parameter", syntax.span, "depends on the world")
            return default_of(prop.kind)
        return number_value(expr, prop.kind)

    default = value(decl.default, pack) if decl.default else default_of(prop.kind)
    values: list[Value | str] = [default] * symbols.composition.slots
    for name, element in symbols.composition.elements.items():
        if (prop.name, name) in given:
            values[element.id] = value(*given[(prop.name, name)])
    return tuple(values)


def _fields(symbols: Symbols, typer: Typer) -> None:
    for name, named in symbols.composition.fields.items():
        decl = named.decl
        scope = Scope(named.pack, {})
        try:
            if decl.type is None:
                continue
            kind = read_kind(decl.type, typer)
            if kind.name == "chance":
                raise typer.fail(
                    "PD401", "a field cannot be a chance", decl.type.span, "", "use `real(0..1)`"
                )
            default = (
                typer.constant(decl.default, kind, scope)
                if decl.default
                else default_of(kind, symbols.first_id)
            )
            of = None
            if decl.of is not None:
                of = frozenset(typer.set_of(typer.evaluate(decl.of, scope), decl.of.span).ids)
                if decl.at != "element":
                    raise typer.fail(
                        "PD401",
                        "`of` needs `at: element`",
                        decl.of.span,
                        "a field of a place belongs to no element",
                    )
        except Poisoned:
            continue
        symbols.fields[name] = field_from(named, kind, clamped(default, kind), of)


def _sets(typer: Typer) -> None:
    for name, (_, syntax) in typer.set_definitions.items():
        try:
            if name not in typer.symbols.constants:
                typer.resolve_set(name, syntax.span)
        except Poisoned:
            typer.symbols.constants.setdefault(name, Broken())
        except Unresolved:
            typer.symbols.constants.setdefault(name, SetOf(()))
    typer.used.clear()


def _tagged(element: Element, composition: Composition, ramp: ColorRamp | None) -> Element:
    tags = frozenset(tag for tag, ids in composition.tags.items() if element.id in ids)
    return replace(element, tags=tags, ramp=ramp)


def _streams(symbols: Symbols, elaborated: Elaborated, reporter: Reporter) -> tuple[Stream, ...]:
    streams = [*symbols.streams.values(), *elaborated.streams.values()]
    by_ident: dict[int, str] = {}
    for stream in streams:
        other = by_ident.setdefault(stream.ident, stream.name)
        if other != stream.name:
            reporter.error(
                "PD302",
                f"streams `{other}` and `{stream.name}` would draw the same numbers",
                None,
                helps=["rename one of them"],
            )
    return tuple(streams)
