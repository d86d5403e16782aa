"""Declarations -> checked model. One straight function; each step reports all it can.

Some packs of a composition are also checked alone, as their authors knew them, without added packs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, Span
from powderdsl.model.composition.added_packs import AddedPacks, Difference, pack_words
from powderdsl.model.composition.compose import Composition, Palette, compose, lay_out, title
from powderdsl.model.composition.names import needs_of, report_misspelled, words_of
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.definitions import define_symbols, element_ramps
from powderdsl.model.elaborate import Elaborator
from powderdsl.model.examples import check_assigned, check_examples
from powderdsl.model.expressions.symbols import add_constants, report_undeclared_needs, report_unknown_names
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
from powderdsl.model.text import place_of
from powderdsl.model.types import Declared, Ruleset, Stream

OF_COMPOSITIONS = ("PD315", "PD316")
"""Warnings about a combination of packs: misspelled optional names, and values that another pack replaces."""


MISREAD = ("PD109", "PD302", "PD303", "PD305", "PD306", "PD307", "PD310", "PD311", "PD508")
"""Errors after which rules would only be misread: names that clash, packs and elements that are missing."""


def resolve_names(
    packs: Sequence[PackDecl], ruleset: RulesetDecl | None, reporter: Reporter, palette: Palette | None = None
) -> tuple[Typer, list[tuple[str, int, Span]]]:
    """A typer that knows all names of some packs, and the locations of elements' own property values.

    Raises CompileError where names clash.
    """
    composition = compose(packs, ruleset, reporter, palette)
    if any(diagnostic.code in MISREAD for diagnostic in reporter.diagnostics):
        reporter.raise_if_errors()
    add_constants(composition)
    typer = Typer(composition, reporter)
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
        palette: ids that were recorded earlier, see `model/composition/compose.py`.
        elsewhere: words that packs define which are not loaded, with the pack.
        alone: no pack counts as added to others: rules that meet are errors.
    """
    typer, element_values = resolve_names(packs, ruleset, reporter, palette)
    composition = typer.symbols
    elaborated = Elaborator(typer)
    elaborated.run(composition.passes)
    report_undeclared_needs(typer)  # tests and invariants only speak of what is loaded
    examples = check_examples(typer)
    check_alone = partial(_check_some, Declared(tuple(packs), None), alone=True)
    invariants = check_invariants(composition, typer, check_alone)
    ramps = element_ramps(typer)
    report_unknown_names(typer)
    reporter.raise_if_errors()
    report_misspelled(packs, composition.ruleset, elsewhere, reporter)

    elements = tuple(replace(element, ramp=ramps.get(name)) for name, element in composition.elements.items())
    passes = tuple(elaborated.passes)
    names, properties, fields = composition.names_by_id, composition.properties, composition.fields
    facts = Facts(tuple(names), properties, fields, composition.side_multiple, names)
    stored = overridden_ids(passes, sorted(elaborated.overridden), facts)
    for name, ids in stored.items():
        properties[name] = replace(properties[name], stored=ids)
    check_assigned(examples, composition, reporter)
    added = None if alone else AddedPacks(composition, check_alone)
    passes, undecided = check_logic(passes, facts, elaborated, reporter, added)
    report_unused(composition, typer, produced_ids(passes, facts))
    order, matrix = lay_out(composition, passes, reporter)
    reporter.raise_if_errors()
    undecided += report_needless(passes, composition.fields, facts, reporter)
    checked = Ruleset(
        name=title(composition.packs, composition.ruleset),
        about=ruleset.about if ruleset else (packs[0].about if len(packs) == 1 else ""),
        packs=tuple(composition.packs),
        elements=elements,
        slots=composition.slots,
        properties=tuple(composition.properties.values()),
        fields=tuple(composition.fields.values()),
        streams=_streams(composition, elaborated, reporter),
        params=tuple(composition.params.values()),
        passes=without_dead_overrides(passes, frozenset(name for name, ids in stored.items() if not ids)),
        matrix=matrix,
        side_multiple=composition.side_multiple,
        order=order,
        tests=examples,
        invariants=invariants,
        declared=Declared(tuple(packs), ruleset),
    )
    undecided += report_undrawn(checked, element_values, facts, reporter)
    report_undecided(undecided, reporter)
    return checked


def _streams(symbols: Composition, elaborated: Elaborator, reporter: Reporter) -> tuple[Stream, ...]:
    streams = [*symbols.streams.values(), *elaborated.streams.values()]
    by_ident: dict[int, str] = {}
    for stream in streams:
        other = by_ident.setdefault(stream.ident, stream.name)
        if other != stream.name:
            message = f"streams `{other}` and `{stream.name}` would draw the same numbers"
            reporter.error("PD302", message, None, helps=["rename one of them"])
    return tuple(streams)


# Some packs alone


def select_packs(ruleset: Ruleset, packs: Collection[str]) -> Ruleset | None:
    """The model of some of a ruleset's packs, with its parameters; None if they are not a ruleset of their own."""
    model = _check_some(ruleset.declared, packs, Reporter())
    if model is None:
        return None
    names = {param.name for param in model.params}
    return model.with_params({p.name: p.default for p in ruleset.params if p.name in names})


def without_pack(ruleset: Ruleset, pack: str) -> Ruleset | None:
    """The model without one pack and the packs that need it; None if the rest is not a ruleset."""
    assert ruleset.declared is not None
    needs = needs_of({decl.name.text: decl for decl in ruleset.declared.packs})
    return select_packs(ruleset, [name for name in needs if pack not in needs[name]])


def _check_some(
    declared: Declared | None, packs: Collection[str], reporter: Reporter, *, alone: bool = False
) -> Ruleset | None:
    """The model of some packs; None after reporting why they are not a ruleset of their own."""
    if declared is None:
        return None
    gone = {pack.name.text for pack in declared.packs} - set(packs)
    chosen = [pack for pack in declared.packs if pack.name.text not in gone]
    try:
        return check(chosen, _without_packs(declared.ruleset, gone), reporter, alone=alone)
    except CompileError:
        return None


def _without_packs(decl: RulesetDecl | None, gone: set[str]) -> RulesetDecl | None:
    """A ruleset without names of missing packs: no channels, and no invariants if one of its own packs is missing."""
    if decl is None:
        return None
    invariants = decl.invariants if gone.isdisjoint(decl.members) else ()
    beside = tuple(bare for other in decl.beside if (bare := _without_packs(other, gone)))
    base = _without_packs(decl.base, gone)
    return replace(decl, matrix=(), slots=None, invariants=invariants, base=base, beside=beside)


def demote_outgrown(ruleset: Ruleset, remarks: tuple[Diagnostic, ...]) -> tuple[Diagnostic, ...]:
    """The remarks, with warnings that only added packs cause turned into notes (PD515)."""
    warnings = {
        remark: span
        for remark in remarks
        if remark.severity is Severity.WARNING
        and (span := remark.primary.span)
        and remark.code not in OF_COMPOSITIONS
    }
    if not warnings or ruleset.declared is None or len(ruleset.packs) < 2:
        return remarks
    composition = compose(ruleset.declared.packs, ruleset.declared.ruleset, Reporter())
    notes: dict[Diagnostic, Diagnostic] = {}
    authors: list[PackDecl | RulesetDecl] = [*composition.packs.values(), *composition.ruleset.lineage]
    for author in authors:
        own = {remark: span for remark, span in warnings.items() if span.source == author.source}
        if not own:
            continue
        words = _known_words(author)
        scope = composition.scope(author.name.text if isinstance(author, PackDecl) else author, words)
        added, reporter = ruleset.added_to(scope), Reporter()
        if not added or _check_some(ruleset.declared, scope, reporter) is None:
            continue
        alone = {(remark.code, remark.primary.span) for remark in reporter.diagnostics}
        for remark, span in own.items():
            if (remark.code, span) not in alone:
                message = f"{Difference(added).with_packs}, {remark.message}: {place_of(span)}"
                notes[remark] = replace(remark, code="PD515", message=message, helps=())
    return tuple(notes.get(remark, remark) for remark in remarks)


def _known_words(author: PackDecl | RulesetDecl) -> list[str]:
    """The words that a pack's rules and elements, or a ruleset's invariants, use: they show which packs it knows."""
    if isinstance(author, RulesetDecl):
        return [word for line in author.invariants for word in words_of(line)]
    words = [*pack_words(author), *(also.name.word for also in author.also)]
    for entry in author.entries:
        words += [scalar.word for scalar in (*(key for key, _ in entry.values), *entry.tags)]
    return words
