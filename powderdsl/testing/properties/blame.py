"""Finds what broke a claim: rules of the last step, and added packs outside the claim's scope."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import Span
from powderdsl.model.check import without_pack
from powderdsl.model.composition.added_packs import Cause, ScopeDifference
from powderdsl.model.declarations import PackDecl
from powderdsl.model.state import slots
from powderdsl.model.text import one_line
from powderdsl.model.types import Pass, Ruleset, Substep, substeps
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.pack_tests.runner import MOST, ExampleResult, start_of
from powderdsl.testing.properties.breaks import Agreement, Alike, Tested, breaks, is_paired
from powderdsl.testing.properties.outcomes import Counterexample, Property
from powderdsl.testing.properties.running import MARK, Oracle, Runner, rule_spans, with_line_marks


def culprits(claim: Tested, ruleset: Ruleset, sample: Start, steps: int) -> tuple[Span, ...]:
    """The lines of rules without which the claim would not have been broken there; several if only together.

    They stand in the last substep before which the step had not broken it. Empty if no rule can be named: the backends
    disagree, or only many worlds show it.
    """
    passes = ruleset.passes

    def broken(last: tuple[Pass, ...]) -> bool:
        return bool(breaks(claim, Oracle(ruleset, last), sample, steps).first.any())

    if isinstance(claim, Agreement | Alike) or not broken(passes):
        return ()
    *rest, pass_ = passes[: _turning(len(passes), lambda count: broken(passes[:count]))]

    def cut(substeps: Sequence[Substep]) -> tuple[Pass, ...]:
        return (*rest, replace(pass_, substeps=tuple(substeps)))

    count = _turning(len(pass_.substeps), lambda count: broken(cut(pass_.substeps[:count])))
    *before, substep = pass_.substeps[:count]
    lines = tuple(dict.fromkeys(rule.span for rule in substep.rules))
    rules = {line: tuple(rule for rule in substep.rules if rule.span != line) for line in lines}
    alone = [line for line in lines if not broken(cut([*before, replace(substep, rules=rules[line])]))]
    return tuple(alone) or lines


def _turning(count: int, broken: Callable[[int], bool]) -> int:
    """The number of parts, the first and at most all `count`, from which on the claim is broken."""
    while count > 1 and broken(count - 1):
        count -= 1
    return count


# Added packs


def translated(sample: Start, ruleset: Ruleset, target: Ruleset) -> Start | None:
    """These worlds under rules with other packs, without fields that those lack; None if those lack an element."""
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


def difference(prop: Property, ruleset: Ruleset, counterexample: Counterexample) -> ScopeDifference:
    """The added packs that break an invariant which holds in its scope, and how they do it."""
    packs = added = ruleset.added_to(prop.scope)
    causes = _rules(ruleset, counterexample.culprits, added)
    if not causes:  # only packs that matter: rules of others may have happened too
        packs = (
            tuple(pack for pack in added[:MOST] if not _still(prop, ruleset, counterexample, pack)) or added
        )
        if not is_paired(prop.claim):
            last = Oracle(with_line_marks(ruleset)).states(counterexample.sample, counterexample.steps)[-1]
            causes = _rules(ruleset, _lines_that_happened(ruleset, last), packs)
    fields = (
        counterexample.sample.fields.get(slot.name) for slot in slots(ruleset) if slot.kind.name == "element"
    )
    grids = (
        counterexample.before["element"],
        counterexample.after["element"],
        *(cells for cells in fields if cells is not None),
    )
    there = {int(number) for cells in grids for number in np.unique(cells)}
    near = frozenset(element.name for element in ruleset.elements if element.id in there)
    causes = causes or [cause for pack in packs for cause in pack_changes(pack, ruleset, near)]
    named = {cause.pack for cause in causes}
    return ScopeDifference(tuple(pack for pack in packs if pack in named) or packs, tuple(causes))


def difference_of_test(result: ExampleResult, runner: Runner) -> ScopeDifference | None:
    """Explain how added packs change a test: by their own rules, or else by their changes to other packs."""
    if not result.added:
        return None
    ruleset, example, sim = runner.ruleset, result.example, runner.sim
    start, steps = start_of(example, sim, result.seed), max(result.step, 1)
    world = sim.step(start, steps=steps, params=dict(example.params))
    causes = _rules(ruleset, _lines_that_happened(ruleset, world.state), result.added)
    drawn = {char for rows in (example.given, example.expect or (), result.after) for char in "".join(rows)}
    near = frozenset(name for char, name in example.legend if char in drawn)
    named = {cause.pack for cause in causes}
    causes += [
        cause for pack in result.added if pack not in named for cause in pack_changes(pack, ruleset, near)
    ]
    return ScopeDifference(result.added, tuple(causes))


def _lines_that_happened(ruleset: Ruleset, state: Mapping[str, Any]) -> list[Span]:
    """The lines that happened on the way to a state, by its marks."""
    return [span for number, span in enumerate(rule_spans(ruleset)) if state[f"{MARK}{number}"].any()]


def _rules(ruleset: Ruleset, lines: Iterable[Span], packs: tuple[str, ...]) -> list[Cause]:
    """The lines among these that rules of some packs have."""
    owners = {rule.span: pass_.pack for pass_, part in substeps(ruleset.passes) for rule in part.rules}
    mine = [span for span in lines if owners.get(span) in packs]
    return [Cause(owners[span], span, one_line(span), True) for span in mine]


def _still(prop: Property, ruleset: Ruleset, counterexample: Counterexample, pack: str) -> bool:
    """True if the world still breaks the invariant without a pack."""
    fewer = without_pack(ruleset, pack)
    if fewer is None:
        return True
    # The elements of other rules may have other ids: the claim is that of the same line there.
    claim = next((invariant.claim for invariant in fewer.invariants if invariant.span == prop.span), None)
    sample = translated(counterexample.sample, ruleset, fewer)
    if claim is None or sample is None:
        return False
    return bool(breaks(claim, Oracle(fewer), sample, counterexample.steps).first.any())


def pack_changes(pack: str, ruleset: Ruleset, near: frozenset[str]) -> list[Cause]:
    """Up to three changes that a pack makes, besides its rules: to some elements, or else to others, or else passes."""
    changes = list(_changes(pack, ruleset))
    close = [cause for name, cause in changes if name in near]
    return (close or [cause for name, cause in changes if name] or [cause for _, cause in changes])[:3]


def _changes(pack: str, ruleset: Ruleset) -> Iterator[tuple[str, Cause]]:
    """The changes that a pack makes, each after the name of the changed element, if any."""
    decl: PackDecl = next(pack_decl for pack_decl in ruleset.declared.packs if pack_decl.name.text == pack)
    for element in decl.elements:
        name, does = element.name.text, "replaces" if element.override else "brings"
        yield name, Cause(pack, element.name.span, f"{does} `{name}`")
    for also in decl.also:
        if ruleset.element(also.name.word) is not None:
            additions = [f"the tag `{tag.word}`" for tag in also.tags]
            additions += [f"`{key.word}`" for key, _ in also.values]
            name = also.name.word
            yield name, Cause(pack, also.name.span, f"gives `{name}` {' and '.join(additions)}")
    for prop in decl.properties:
        for key, _ in prop.values:
            yield key.word, Cause(pack, key.span, f"gives `{key.word}` a value of `{prop.name.text}`")
    for pass_ in decl.passes:
        yield "", Cause(pack, pass_.name.span, f"has the pass `{pass_.name.text}`")
