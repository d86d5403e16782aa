"""Definitions that nothing uses, sets without elements; what rules produce and override."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from powderdsl.diagnostics import Reporter, Span
from powderdsl.model.composition.claim_scopes import words_of
from powderdsl.model.composition.compose import Composition
from powderdsl.model.declarations import PackDecl
from powderdsl.model.expressions.operators import ELEMENT_HERE, member
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.logic.satisfy import HERE, Facts, satisfiable, substeps, writes_of
from powderdsl.model.types import Assign, Moment, Move, Pass, Transform


def report_unused(composition: Composition, typer: Typer, produced: frozenset[int]) -> None:
    """Report definitions that no rule uses (warnings), and what the loaded packs lack (notes)."""
    reporter = typer.reporter
    values = [str(value) for prop in typer.symbols.properties.values() for value in prop.values]
    for qualified, param in composition.params.items():
        if qualified not in typer.used and qualified not in values:
            _unused("parameter", qualified, param.span, reporter)
    for name, named_set in composition.sets.items():
        if name not in typer.used:
            _unused("set", name, named_set.span, reporter)
        elif not typer.set_of(typer.symbols.constants[name], named_set.span).ids:
            reporter.report(
                "PD505", f"the set `{name}` is empty", named_set.decl.members.span, "no element of the loaded packs is in it",
                helps=["load a pack with such elements, or widen the set"],
            )  # fmt: skip
    for name, kernel in composition.kernels.items():
        if name not in typer.used:
            _unused("kernel", name, kernel.span, reporter)
    _report_unwritten(composition, reporter)
    for element in composition.elements.values():
        if element.id not in produced:
            label = "it only comes from the start world, or by painting"
            reporter.report("PD504", f"no rule produces `{element.name}`", element.span, label)


def _unused(what: str, name: str, span: Span, reporter: Reporter) -> None:
    message = f"the {what} `{name}` is never used"
    reporter.report("PD507", message, span, "no rule reads it", helps=["remove it"])


def _report_unwritten(composition: Composition, reporter: Reporter) -> None:
    """Report fields and values under `let` whose names stand in no rule, not even in one that is inactive.

    Tasks and programs may read a field that a ruleset lists as a channel. Streams and tags are left out: packs declare
    them for others.
    """
    names = composition.names
    words = {names.of(pack.name.text, word) for pack in composition.packs for word in pack_words(pack)}
    for ruleset in composition.lineage:
        words |= {word for line in ruleset.invariants for word in words_of(line)}
        words |= {scalar.word.partition(".")[0] for scalar in ruleset.matrix}
    for name, field in composition.fields.items():
        if name not in words and field.decl.name.text not in words:
            _unused("field", name, field.span, reporter)
    for block in (block for pack in composition.packs for one in pack.passes for block in one.block.walk()):
        inner = [line for one in block.walk() if one is not block for line in one.lines]
        later = {word for line in (*block.lines[len(block.lets) :], *inner) for word in words_of(line)}
        for scalar, value in reversed(block.lets):
            if scalar.text not in later:
                _unused("value", scalar.text, scalar.span, reporter)
            later |= set(words_of(value))


def pack_words(pack: PackDecl) -> Iterator[str]:
    """Every name in a pack's rules, sets, invariants, tests and color ramps."""
    yield from (one.ramp.field.word.rpartition(".")[2] for one in pack.entries if one.ramp)
    for lines in (
        pack.lines,
        pack.invariants,
        [one.members for one in pack.sets],
        [line for test in pack.tests for line in test.always],
        [decl.of for decl in pack.fields if decl.of is not None],
    ):
        for line in lines:
            yield from words_of(line)


# What rules produce and override


def overridden_ids(passes: tuple[Pass, ...], names: Iterable[str], facts: Facts) -> dict[str, frozenset[int]]:
    """For each of these properties the ids whose cells may hold their own value: the ids that some rule assigns it to.

    A value of its own may fulfill the condition of another such rule, so this continues until nothing is added.
    """
    found: dict[str, frozenset[int]] = {name: frozenset() for name in names}
    while True:
        more = {name: found[name] | _overridden_ids(passes, name, facts) for name in found}
        if more == found:
            return found
        found = more
        stored = {name: replace(facts.properties[name], stored=ids) for name, ids in found.items()}
        facts = replace(facts, properties={**facts.properties, **stored})


def _overridden_ids(passes: tuple[Pass, ...], name: str, facts: Facts) -> frozenset[int]:
    """The ids that some rule assigns a property to, if cells hold values of their own as `facts` say."""
    found: set[int] = set()
    for _, moment, lets in substeps(passes):
        for assign in (write for rule in moment.rules for write in writes_of(rule) if write.field == name):
            if assign.mask is None or assign.offset != HERE:
                return frozenset(facts.ids)
            for number in facts.ids:
                here = (member(ELEMENT_HERE, (number,)), HERE)
                if number not in found and satisfiable(facts, [here, (assign.mask, HERE)], lets):
                    found.add(number)
    return frozenset(found)


def without_dead_overrides(passes: tuple[Pass, ...], dead: frozenset[str]) -> tuple[Pass, ...]:
    """The passes without assignments to properties that no cell can come to override: there is no place for them."""

    def kept(moment: Moment) -> Moment:
        rules = tuple(r for r in moment.rules if not (isinstance(r, Assign) and r.field in dead))
        return replace(moment, rules=rules)

    return tuple(replace(pass_, moments=tuple(kept(moment) for moment in pass_.moments)) for pass_ in passes)


def produced_ids(passes: tuple[Pass, ...], facts: Facts) -> frozenset[int]:
    """The ids that some rule may bring about."""
    found: set[int] = set()
    for _, moment, _ in substeps(passes):
        for rule in moment.rules:
            target = (
                rule.target
                if isinstance(rule, Transform)
                else rule.leaving
                if isinstance(rule, Move)
                else None
            )
            if target is not None:
                found |= {target.value} if target.op == "const" else set(facts.ids)
    return frozenset(found)
