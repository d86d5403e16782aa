"""Finds what broke a claim: rules of the last step, and added packs outside the claim's scope."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import Span
from powderdsl.model.check import without
from powderdsl.model.composition.added_packs import Cause, Difference
from powderdsl.model.declarations import PackDecl
from powderdsl.model.state import slots
from powderdsl.model.text import one_line
from powderdsl.model.types import Pass, Ruleset
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.pack_tests.runner import ExampleResult, start_of
from powderdsl.testing.properties.breaks import Agreement, Alike, Tested, breaks, is_paired
from powderdsl.testing.properties.outcomes import Counterexample, Property
from powderdsl.testing.properties.running import (
    MARK,
    Oracle,
    Runner,
    marked,
    reference_states,
    rule_spans,
)

MOST = 8
"""Added packs that are left out in turn, to see which of them matter."""


def culprits(claim: Tested, ruleset: Ruleset, sample: Start, steps: int) -> tuple[Span, ...]:
    """The lines of rules without which the claim would not have been broken there; several if only together.

    Empty if no rule can be named: the backends disagree, or only many worlds show it.
    """
    if isinstance(claim, Agreement | Alike):
        return ()

    def broken(last: tuple[Pass, ...]) -> bool:
        return bool(breaks(claim, Oracle(ruleset, last), sample, steps).first.any())

    for last in _turning(ruleset.passes, broken):
        *rest, pass_ = last
        moment = pass_.moments[-1]
        lines = tuple(dict.fromkeys(rule.span for rule in moment.rules))
        alone = []
        for line in lines:
            kept = tuple(rule for rule in moment.rules if rule.span != line)
            part = replace(pass_, moments=(*pass_.moments[:-1], replace(moment, rules=kept)))
            if not broken((*rest, part)):
                alone.append(line)
        return tuple(alone) or lines
    return ()


def _turning(
    passes: tuple[Pass, ...], broken: Callable[[tuple[Pass, ...]], bool]
) -> Iterator[tuple[Pass, ...]]:
    """The beginnings of the step, each up to a substep, after which the claim is broken and was not before; last first."""
    was = [broken(passes[:count]) for count in range(len(passes) + 1)]
    for count in range(len(passes), 0, -1):
        if not was[count] or was[count - 1]:
            continue
        pass_ = passes[count - 1]
        parts = [replace(pass_, moments=pass_.moments[:end]) for end in range(1, len(pass_.moments) + 1)]
        for part in reversed(parts):
            if broken((*passes[: count - 1], part)) and not broken(
                (*passes[: count - 1], replace(part, moments=part.moments[:-1]))
            ):
                yield (*passes[: count - 1], part)


# Added packs


def translated(sample: Start, ruleset: Ruleset, target: Ruleset) -> Start | None:
    """The same worlds under rules with other packs; None if those lack an element. Fields that they lack are left out."""
    numbers = {element.qualified: element.id for element in target.elements}
    table = np.full(256, -1, np.int64)
    for element in ruleset.elements:
        table[element.id] = numbers.get(element.qualified, -1)
    kinds = {slot.name: slot.kind.name for slot in slots(target)}
    fields = {name: values for name, values in sample.fields.items() if name in kinds}
    named = {name: values for name, values in fields.items() if kinds[name] == "element"}
    if any((table[values] < 0).any() for values in (sample.ids, *named.values())):
        return None
    fields |= {name: table[values].astype(values.dtype) for name, values in named.items()}
    there = {param.name for param in target.params}
    params = {name: values for name, values in sample.params.items() if name in there}
    return replace(sample, ids=table[sample.ids].astype(np.uint8), fields=fields, params=params)


def difference(prop: Property, ruleset: Ruleset, found: Counterexample) -> Difference:
    """The added packs that break an invariant which holds in its scope, and how they do it."""
    packs = added = ruleset.added_to(prop.scope)
    causes = _rules(ruleset, found.culprits, added)
    states = found.before, found.after
    there = {int(number) for state in states for number in np.unique(state["element"])}
    if not causes:  # only packs that matter: rules of others may have happened too
        packs = tuple(pack for pack in added[:MOST] if not _still(prop, ruleset, found, pack)) or added
        if not is_paired(prop.claim):
            last = reference_states(marked(ruleset), found.sample, found.steps)[-1]
            causes = _rules(ruleset, _happened(ruleset, last), packs)
    if not causes:
        held = [found.sample.fields.get(slot.name) for slot in slots(ruleset) if slot.kind.name == "element"]
        held_ids = {int(number) for values in held if values is not None for number in np.unique(values)}
        causes = [
            Cause(element.pack, element.span, f"brings `{element.name}`")
            for element in ruleset.elements
            if element.id in there | held_ids and element.pack in packs
        ]
    if causes:
        named = {cause.pack for cause in causes}
        return Difference(tuple(pack for pack in added if pack in named), tuple(causes))
    near = frozenset(element.name for element in ruleset.elements if element.id in there)
    return Difference(packs, tuple(cause for pack in packs for cause in doings(pack, ruleset, near)[:3]))


def difference_of_test(result: ExampleResult, runner: Runner) -> Difference | None:
    """How added packs change a test: by their rules that happen, or else by what they change in other packs."""
    if not result.added:
        return None
    ruleset, example, sim = runner.ruleset, result.example, runner.sim
    world = sim.step(start_of(example, sim, result.seed), steps=max(result.step, 1))
    causes = _rules(ruleset, _happened(ruleset, world.state), result.added)
    drawn = {char for rows in (example.given, example.expect or (), result.after) for char in "".join(rows)}
    near = frozenset(name for char, name in example.legend if char in drawn)
    for pack in result.added:
        if pack not in {cause.pack for cause in causes}:
            causes += doings(pack, ruleset, near)[:3]
    return Difference(result.added, tuple(causes))


def _happened(ruleset: Ruleset, state: Mapping[str, Any]) -> list[Span]:
    """The lines that happened on the way to a state, by its marks."""
    return [span for number, span in enumerate(rule_spans(ruleset)) if state[f"{MARK}{number}"].any()]


def _rules(ruleset: Ruleset, lines: Iterable[Span], packs: tuple[str, ...]) -> list[Cause]:
    """Those of some lines of rules that are of some packs."""
    owners = {
        rule.span: pass_.pack for pass_ in ruleset.passes for moment in pass_.moments for rule in moment.rules
    }
    mine = [span for span in lines if owners.get(span) in packs]
    return [Cause(owners[span], span, one_line(span), True) for span in mine]


def _still(prop: Property, ruleset: Ruleset, found: Counterexample, pack: str) -> bool:
    """Whether the world still breaks the invariant without a pack."""
    fewer = without(ruleset, pack)
    if fewer is None:
        return True
    # The elements of other rules may have other ids: the claim is that of the same line there.
    claim = next((invariant.claim for invariant in fewer.invariants if invariant.span == prop.span), None)
    sample = translated(found.sample, ruleset, fewer)
    if claim is None or sample is None:
        return False
    return bool(breaks(claim, Oracle(fewer, fewer.passes), sample, found.steps).first.any())


def doings(pack: str, ruleset: Ruleset, near: frozenset[str] = frozenset()) -> list[Cause]:
    """Changes that a pack makes to others, besides its rules: to some elements, or else all of them."""
    changes = list(_changes(pack, ruleset))
    close = [cause for name, cause in changes if name in near]
    return close or [cause for name, cause in changes if name] or [cause for _, cause in changes]


def _changes(pack: str, ruleset: Ruleset) -> Iterator[tuple[str, Cause]]:
    """The other pack's element that it does something to, or nothing; and what it does."""
    assert ruleset.declared is not None
    decl: PackDecl = next(one for one in ruleset.declared.packs if one.name.text == pack)
    for also in decl.also:
        name = also.name.word
        if ruleset.element(name) is not None:
            given = [f"the tag `{tag.word}`" for tag in also.tags] + [
                f"`{key.word}`" for key, _ in also.values
            ]
            yield name, Cause(pack, also.name.span, f"gives `{name}` {' and '.join(given)}")
    for element in decl.elements:
        if element.override:
            yield element.name.text, Cause(pack, element.name.span, f"replaces `{element.name.text}`")
    for prop in decl.properties:
        for key, _ in prop.values:
            yield key.word, Cause(pack, key.span, f"gives `{key.word}` a value of `{prop.name.text}`")
    for pass_ in decl.passes:
        yield "", Cause(pack, pass_.name.span, f"has the pass `{pass_.name.text}`")
    for element in decl.elements:
        yield "", Cause(pack, element.name.span, f"brings `{element.name.text}`")
