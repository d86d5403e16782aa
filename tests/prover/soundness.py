"""Random claims about rulesets, and worlds that try to break those that are proven."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import cycle

import numpy as np

from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.ir.bits import NotBits
from powderdsl.model import reference
from powderdsl.model.declarations import PackDecl, read_file
from powderdsl.model.expressions.operators import ELEMENT_HERE, member
from powderdsl.model.state import slots
from powderdsl.model.types import (
    FLAG,
    Bounded,
    Claim,
    Expr,
    Local,
    Never,
    Ruleset,
    Symmetric,
    Total,
    Unchanging,
    writes_of,
)
from powderdsl.prover.equality import Side, differs, why_incomparable
from powderdsl.prover.solver import OutOfWork
from powderdsl.prover.symbolic import Budget, Undecided, deep_recursion
from powderdsl.prover.verdicts import judgments
from powderdsl.system.settings import fingerprint
from powderdsl.testing.generators.cases import Choices, Start, full_state
from powderdsl.testing.mutation.judging import Original
from powderdsl.testing.mutation.operators import Mutant
from powderdsl.testing.properties.breaks import breaks
from powderdsl.testing.properties.running import (
    Oracle,
    Runs,
    context,
    first_difference,
    random_samples,
)
from tests.fuzz.rulemaker import random_ruleset, random_ruleset_text

OpenClaim = tuple[Claim, frozenset[int]]
"""A claim about worlds that start without some elements."""

STEPS = (3, 1, 6, 2)
REPAIRS = 4
"""How often cells that fulfill what a claim forbids are replaced in a start world."""


def random_claims(ruleset: Ruleset, choices: Choices, count: int) -> list[OpenClaim]:
    """Different claims of all kinds, true or false."""
    known = [element.id for element in ruleset.elements]
    conditions = list(dict.fromkeys(_conditions(ruleset)))
    numbers = [
        (slot.name, int(slot.kind.lo), int(slot.kind.hi))
        for slot in slots(ruleset)
        if slot.kind.name == "int" and slot.kind.hi > slot.kind.lo
    ]
    claims: dict[OpenClaim, None] = {}
    for _ in range(count):
        some = frozenset(choices.some(known, 1, max(len(known) - 1, 1)))
        here = member(ELEMENT_HERE, tuple(sorted(some)))
        claim: Claim
        match choices.pick(
            ("count", "count", "never", "never", "often", "stays", "changes", "reach", "turn")
        ):
            case "count":
                claim = Total(here, choices.pick(("constant", "never rises", "never falls")), some)
            case "never":
                condition = choices.pick(conditions) if conditions else here
                parts = [here, choices.pick(conditions)] if conditions and choices.maybe(50) else []
                claim = Never(Expr("and", FLAG, (*parts,)) if parts else condition, 1)
            case "often":
                condition = choices.pick(conditions) if conditions else here
                claim = Never(Expr("and", FLAG, (here, condition)), choices.integer(2, 3))
            case "stays" if numbers:
                name, lo, hi = choices.pick(numbers)
                ends = sorted(choices.integer(lo, hi) for _ in range(2))
                claim = Bounded(name, *choices.pick([(lo, ends[1]), (ends[0], hi), (ends[0], ends[1])]))
            case "reach":
                claim = Local(choices.integer(0, 8))
            case "turn":
                claim = Symmetric(choices.pick(("mirrored", "rotated")))
            case _:
                claim = Unchanging(some)
        gone = frozenset(choices.some(known, 1, max(len(known) - 1, 1))) if choices.maybe(40) else frozenset()
        if len(gone) < len(known):
            claims[claim, gone] = None
    return list(claims)


def _conditions(ruleset: Ruleset) -> Iterator[Expr]:
    """The parts of conditions of rules that a claim may name, and their parts."""
    named = {slot.name for slot in slots(ruleset)}
    for pass_ in ruleset.passes:
        for substep in pass_.substeps:
            written = [
                expr for rule in substep.rules for expr in (rule.mask, *(w.mask for w in writes_of(rule)))
            ]
            for expr in (part for whole in written for part in whole.walk()):
                parts = list(expr.walk())
                is_open = any(part.op in ("let", "draw", "pick") for part in parts)
                is_scratch = any(part.op == "field" and part.value not in named for part in parts)
                if expr.kind == FLAG and expr.op != "const" and not is_open and not is_scratch:
                    yield expr


def proven(ruleset: Ruleset, claims: list[OpenClaim], seconds: float) -> list[OpenClaim]:
    """Those of some claims that are proven."""
    found = judgments(ruleset, claims, seconds)
    return [claim for claim, judgment in zip(claims, found, strict=True) if judgment.is_proven]


def breaking_world(
    ruleset: Ruleset, open_claim: OpenClaim, worlds: int, seed: int = 0, runs: Runs | None = None
) -> tuple[Start, int] | None:
    """A world that breaks a claim, with the number of steps; None if none of some random ones does."""
    claim, gone = open_claim
    for sample, steps in zip(random_samples(ruleset, seed, worlds), cycle(STEPS), strict=False):
        start = repaired(ruleset, claim, sample.without(gone, ruleset), gone)
        start = start.without(gone, ruleset)
        steps = claim.steps if isinstance(claim, Never) and claim.steps > 1 else steps
        first = breaks(claim, runs or Oracle(ruleset), start, steps).first
        if first.any():
            world = int(np.nonzero(first)[0][0])
            return start.one(world), int(first[world])
    return None


def repaired(ruleset: Ruleset, claim: Claim, sample: Start, gone: frozenset[int]) -> Start:
    """Worlds in which what a claim forbids holds in few cells or none: those that begin with it test nothing."""
    if isinstance(claim, Bounded) and claim.field in sample.fields:
        values = sample.fields[claim.field]
        return replace(
            sample,
            fields={**sample.fields, claim.field: np.clip(values, claim.lo, claim.hi).astype(values.dtype)},
        )
    if not isinstance(claim, Never) or claim.steps > 1:
        return sample
    known = np.array([element.id for element in ruleset.elements if element.id not in gone], np.uint8)
    for number in range(REPAIRS):
        wrong = reference.evaluate(claim.condition, context(ruleset, full_state(ruleset, sample), sample, 0))
        if not wrong.any():
            break
        others = known[(np.searchsorted(known, sample.ids) + 1 + number) % len(known)]
        ids = np.where(wrong, others, sample.ids).astype(np.uint8)
        sample = replace(sample, ids=ids, fields={} if number == REPAIRS - 1 else sample.fields)
    return sample


def random_original(seed: int) -> Original | None:
    """The random ruleset of a seed as a composition whose mutants can be made; None if it is refused."""
    ruleset = random_ruleset(seed)
    pack = read_file(Source(f"seed{seed}.yaml", random_ruleset_text(seed)), Reporter())
    if ruleset is None or not isinstance(pack, PackDecl):
        return None
    return Original(pack.name.text, (), [pack], None, ruleset, Counter())


def equal_mutants(
    original: Original, mutants: Sequence[Mutant], seconds: float
) -> Iterator[tuple[Mutant, Ruleset]]:
    """The mutants that are other models, but are proven to do the same."""
    for mutant in mutants:
        with suppress(CompileError, NotBits, OutOfWork, Undecided), deep_recursion():
            mutated = original.mutated(mutant)
            if mutated is None or fingerprint(mutated[0]) == fingerprint(original.ruleset):
                continue
            sides = Side.of(original.ruleset), Side.of(mutated[0])
            is_comparable = why_incomparable(*(side.ruleset for side in sides)) is None
            if is_comparable and differs(*sides, Budget.of(seconds)) is None:
                yield mutant, mutated[0]


def differing_world(first: Ruleset, second: Ruleset, worlds: int, seed: int = 0) -> tuple[Start, int] | None:
    """A world with the usual parameters on which two rulesets with the same state differ, and after how many steps.

    Its numbers lie in the ranges of both.
    """
    kinds = [{slot.name: slot.kind for slot in slots(ruleset)} for ruleset in (first, second)]
    bounds = {
        name: (max(kind.lo, kinds[1][name].lo), min(kind.hi, kinds[1][name].hi))
        for name, kind in kinds[0].items()
        if kind.name in ("int", "real", "vec2")
    }
    for sample, steps in zip(random_samples(first, seed, worlds), cycle(STEPS), strict=False):
        fields = {
            name: np.clip(values, *bounds[name]).astype(values.dtype) if name in bounds else values
            for name, values in sample.fields.items()
        }
        start = replace(sample, fields=fields, params={})
        when = first_difference(*(Oracle(ruleset).states(start, steps) for ruleset in (first, second)))
        if when.any():
            world = int(np.nonzero(when)[0][0])
            return start.one(world), int(when[world])
    return None
