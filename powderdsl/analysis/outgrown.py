"""Warnings about a pack that are there only because others are loaded that its author did not know: they are notes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from powderdsl.diagnostics import Diagnostic, Reporter, Severity
from powderdsl.model.composition.claim_scopes import words_of
from powderdsl.model.composition.compose import compose
from powderdsl.model.declarations import PackDecl
from powderdsl.model.restrict import Difference, remarks_alone
from powderdsl.model.text import place_of
from powderdsl.model.types import Ruleset
from powderdsl.syntax.ast import Syntax

OF_COMPOSITIONS = ("PD315", "PD316")
"""Warnings for whoever puts packs together: what is misspelled beside all known words, which of two values is lost."""


def with_outgrown(ruleset: Ruleset, remarks: tuple[Diagnostic, ...]) -> tuple[Diagnostic, ...]:
    """The same remarks, where warnings that nobody would get without the added packs are notes (PD515)."""
    warnings = [
        one
        for one in remarks
        if one.severity is Severity.WARNING and one.primary.span and one.code not in OF_COMPOSITIONS
    ]
    if not warnings or ruleset.declared is None or len(ruleset.packs) < 2:
        return remarks
    composition = compose(ruleset.declared.packs, ruleset.declared.ruleset, Reporter())
    notes: dict[Diagnostic, Diagnostic] = {}
    scopes = {
        pack.source: composition.scopes.of_pack(pack.name.text, _words(pack)) for pack in composition.packs
    }
    for author in composition.lineage:
        scopes[author.source] = composition.scopes.of_ruleset(author, _of(author.invariants))
    for source, scope in scopes.items():
        own = [one for one in warnings if one.primary.span and one.primary.span.source == source]
        added = ruleset.added_to(scope) if own else ()
        alone = remarks_alone(ruleset, scope) if added else None
        if alone is not None:
            known = {(one.code, one.primary.span) for one in alone}
            words = Difference(added, ()).with_packs
            for one in own:
                if one.primary.span and (one.code, one.primary.span) not in known:
                    message = f"{words}, {one.message}: {place_of(one.primary.span)}"
                    notes[one] = replace(one, code="PD515", message=message, helps=())
    return tuple(notes.get(one, one) for one in remarks)


def _words(pack: PackDecl) -> Iterator[str]:
    """The words of a pack's own rules and elements, by which it shows what it knows."""
    yield from _of(pack.lines)
    yield from _of(one.members for one in pack.sets)
    yield from (also.name.word for also in pack.also)
    for entry in pack.entries:
        yield from (key.word for key, _ in entry.values)
        yield from (tag.word for tag in entry.tags)


def _of(lines: Iterable[Syntax]) -> Iterator[str]:
    for line in lines:
        yield from words_of(line)
