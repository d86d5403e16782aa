"""Declarations -> checked model. One straight function; each step reports all it can."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from powderdsl.diagnostics import CompileError, Reporter, Span
from powderdsl.model.added_conflicts import AddedPacks
from powderdsl.model.composition.compose import compose
from powderdsl.model.composition.contested import report_contested, report_misspelled
from powderdsl.model.composition.layout import matrix_channels, state_order
from powderdsl.model.composition.palette import Palette
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.definitions import define_symbols, element_ramps
from powderdsl.model.elaborate import Elaborated, Elaborator
from powderdsl.model.examples import check_assigned, check_examples
from powderdsl.model.expressions.symbols import (
    Symbols,
    base_symbols,
)
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.invariants import check_invariants
from powderdsl.model.logic.conflicts import check_logic
from powderdsl.model.logic.needless import (
    overridden_ids,
    produced_ids,
    report_needless,
    report_undecided,
    report_undrawn,
    report_unused,
    without_dead_overrides,
)
from powderdsl.model.logic.satisfy import Facts
from powderdsl.model.types import (
    Declared,
    Ruleset,
    Stream,
)


def resolve_names(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Palette | None = None,
) -> tuple[Typer, list[tuple[str, int, Span]]]:
    """A typer that knows all names of some packs, and the locations of elements' own property values.

    Raises CompileError where names clash.
    """
    composition = compose(packs, ruleset, reporter, palette)
    reporter.raise_if_errors()  # with clashing names or missing packs, rules would only be misread
    typer = Typer(base_symbols(composition), reporter)
    return typer, define_symbols(typer)


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
    examples = check_examples(typer)
    invariants = check_invariants(composition, typer, partial(_typer_of, packs))
    ramps = element_ramps(typer)
    typer.unknown.report()
    reporter.raise_if_errors()
    report_contested(composition, reporter)
    report_misspelled(packs, ruleset, elsewhere, reporter)

    elements = tuple(
        replace(
            element,
            tags=frozenset(tag for tag, ids in composition.tags.items() if element.id in ids),
            ramp=ramps.get(name),
        )
        for name, element in composition.elements.items()
    )
    passes = tuple(elaborated.passes)
    facts = _facts(symbols)
    stored = overridden_ids(passes, sorted(elaborated.overridden), facts)
    symbols.properties = {
        name: replace(p, stored=stored.get(name, frozenset())) for name, p in symbols.properties.items()
    }
    check_assigned(examples, symbols, reporter)
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
    undecided += report_needless(passes, symbols.fields, facts, reporter)
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
    """A typer that knows only some of these packs; None if they cannot be composed."""
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


def _streams(symbols: Symbols, elaborated: Elaborated, reporter: Reporter) -> tuple[Stream, ...]:
    streams = [*symbols.streams.values(), *elaborated.streams.values()]
    by_ident: dict[int, str] = {}
    for stream in streams:
        other = by_ident.setdefault(stream.ident, stream.name)
        if other != stream.name:
            message = f"streams `{other}` and `{stream.name}` would draw the same numbers"
            reporter.error("PD302", message, None, helps=["rename one of them"])
    return tuple(streams)
