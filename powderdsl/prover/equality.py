"""Proofs that two rulesets do the same with every world, pass by pass, from any well-formed world."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import takewhile

from powderdsl.compiler import lower
from powderdsl.ir.bits import NotBits, lower_pass
from powderdsl.ir.ops import REAL, PassGraph, Program
from powderdsl.ir.text import structure
from powderdsl.model.state import Slot, fresh_values, slots
from powderdsl.model.types import Ruleset
from powderdsl.prover.induction import HERE, MAX_WHOLE, Transition, growing_ranges
from powderdsl.prover.net import FALSE, Literal
from powderdsl.prover.solver import OutOfWork
from powderdsl.prover.symbolic import (
    MAX_SIZE,
    Before,
    Budget,
    Formulas,
    Layout,
    Renaming,
    Symbols,
    Undecided,
    World,
    Written,
    layouts,
)


@dataclass(frozen=True)
class Difference:
    """A question whose answer is a world on which some passes differ, in some slots; its model is that of `transition`."""

    transition: Transition
    passes: tuple[tuple[int, ...], tuple[int, ...]]
    """The numbers of the passes of each ruleset."""


@dataclass(frozen=True)
class Side:
    """One of the two rulesets. `names` are the other's names of parameters and streams by its own."""

    ruleset: Ruleset
    program: Program
    names: Renaming

    @classmethod
    def of(cls, ruleset: Ruleset, names: Renaming | None = None) -> Side:
        return cls(ruleset, lower(ruleset), names or Renaming())


def _shared_world(before: Before, own: Mapping[str, Layout], shared: Mapping[str, Layout]) -> World:
    """A world of variables, with the ranges that both sides share, as one side reads it."""
    signs = {
        plane: shared[name].planes[-1] if shared[name].signed else ""
        for name, row in own.items()
        for plane in row.planes[len(shared[name].planes) :]
    }
    """By plane that only this side has: the plane of the sign, if there is one."""
    return Written(before, signs, lambda sign, y, x: before.bit(sign, y, x) if sign else FALSE)


def why_incomparable(first: Ruleset, second: Ruleset) -> str | None:
    """The reason why the worlds of two rulesets are of different kinds, or None: elements, slots and values of fresh
    cells."""

    def state(slot: Slot, ruleset: Ruleset) -> object:
        usual = fresh_values(ruleset, slot)
        return slot.kind.name, slot.resets, slot.of, [usual[element.id] for element in ruleset.elements]

    if [(e.id, e.name) for e in first.elements] != [(e.id, e.name) for e in second.elements]:
        return "they have different elements"
    states = [{slot.name: state(slot, ruleset) for slot in slots(ruleset)} for ruleset in (first, second)]
    if states[0].keys() != states[1].keys():
        return "their cells have different fields"
    for name, value in states[0].items():
        if value != states[1][name]:
            return f"`{name}` has another kind, or another value in fresh cells"
    if first.side_multiple != second.side_multiple:
        return "their worlds have different sides"
    return None


def narrowed(first: Ruleset, second: Ruleset) -> list[str]:
    """The slots that hold fewer values in the second of two rulesets with the same slots."""
    kinds = {slot.name: slot.kind for slot in slots(first)}
    return [s.name for s in slots(second) if s.kind.lo > kinds[s.name].lo or s.kind.hi < kinds[s.name].hi]


def has_own_parameters(first: Side, second: Side) -> bool:
    """Return True unless both have the same parameters, with the same defaults."""
    known = second.names.params
    mine = {p.name: (p.kind, p.default) for p in first.ruleset.params}
    return mine != {known.get(p.name, p.name): (p.kind, p.default) for p in second.ruleset.params}


def differs(first: Side, second: Side, budget: Budget) -> Difference | None:
    """Return None if two rulesets with the same state are proven equal, else the first difference of passes. Where
    their parameters differ, each ruleset uses its own. Raises Undecided and NotBits."""
    draws = {s.name: s.bits for s in first.ruleset.streams}
    if any(draws.get(second.names.stream(s.name), s.bits) != s.bits for s in second.ruleset.streams):
        raise Undecided("draws of different sizes")
    fixed = has_own_parameters(first, second)
    try:
        groups = _groups(first, second, fixed)
        differences = (_differ(first, second, numbers, budget, fixed) for numbers in groups)
        difference = next((difference for difference in differences if difference), None)
        if (
            difference and all(difference.passes) and difference.passes[0][0]
        ):  # the difference shows in the values at the start of a step
            until = tuple(range(difference.passes[0][-1] + 1)), tuple(range(difference.passes[1][-1] + 1))
            with suppress(Undecided, OutOfWork, NotBits):
                shown = _differ(first, second, until, Budget.of(1), fixed, MAX_WHOLE)
                difference = replace(shown, passes=difference.passes) if shown else difference
        return difference
    except OutOfWork:
        raise Undecided("the proof takes too long") from None


Numbers = tuple[tuple[int, ...], tuple[int, ...]]


def _groups(first: Side, second: Side, fixed: bool) -> list[Numbers]:
    """The passes to compare, except identical ones that read the same values: one by one if all have the same names."""
    a, b = first.program.passes, second.program.passes
    words = *second.names.params.items(), *second.names.streams.items()
    wholes = [replace(side.program, name="", passes=()) for side in (first, second)]
    alike = not fixed and wholes[0] == wholes[1] and all(name == word for name, word in words)

    def same(pair: tuple[PassGraph, PassGraph]) -> bool:
        return structure(pair[0], places=False) == structure(pair[1], places=False)

    groups: list[Numbers] = [((i,), (i,)) for i in range(len(a))]
    if [pass_.name for pass_ in a] != [pass_.name for pass_ in b]:
        start = sum(1 for _ in takewhile(same, zip(a, b, strict=False)))
        end = sum(1 for _ in takewhile(same, zip(a[start:][::-1], b[start:][::-1], strict=False)))
        middle = tuple(range(start, len(a) - end)), tuple(range(start, len(b) - end))
        groups = [*groups[:start], middle, *(((len(a) - i,), (len(b) - i,)) for i in range(1, end + 1))]
    return [(i, j) for i, j in groups if not (alike and i and j and same((a[i[0]], b[j[0]])))]


def _differ(
    first: Side, second: Side, numbers: Numbers, budget: Budget, fixed: bool, limit: int = MAX_SIZE
) -> Difference | None:
    sides = (first, second)
    own = [layouts(side.ruleset, side.program) for side in sides]
    shared = {name: _narrower(row, own[1][name]) for name, row in own[0].items()}
    symbols = Symbols(first.ruleset, first.program, budget, limit, shared)
    before = Before(symbols)
    afters: list[World] = []
    planes: dict[str, bool] = {}
    for side, slots_, passes in zip(sides, own, numbers, strict=True):
        world = _shared_world(before, slots_, shared)
        params = {p.name: p.default for p in side.ruleset.params} if fixed else None
        for number in passes:
            outputs = lower_pass(side.program, side.program.passes[number]).outputs
            planes |= {plane: node.type == REAL for plane, node in outputs}
            world = Formulas(world, symbols, replace(side.names, fixed=params)).after(outputs)
        afters.append(world)
    ranges = [growing_ranges(side.program) for side in sides]
    known = {}
    if all(numbers):
        first_ranges, theirs = (ranges[i][numbers[i][0]] for i in (0, 1))
        known = {
            name: (max(lo, theirs[name][0]), min(hi, theirs[name][1]))
            for name, (lo, hi) in first_ranges.items()
            if name in theirs
        }
    transition = Transition("passes", symbols, (before,), before, afters[0], known)
    net = symbols.net
    wrong = []
    for plane, is_real in planes.items():
        if is_real:
            terms = (world.real(plane, *HERE) for world in afters)
            wrong.append(transition.questions.equal_floats(*terms) ^ 1)
    for name in shared:
        rows = [row[name] for row in own]
        if any(plane in planes for row in rows for plane in row.planes):
            count = max(len(row.planes) for row in rows) + 1
            wrong += map(
                net.xor, *(_extended(world, row, count) for world, row in zip(afters, rows, strict=True))
            )
    return Difference(transition, numbers) if transition.can_be([net.any(wrong)]) else None


def _extended(world: World, row: Layout, count: int) -> list[Literal]:
    """The bits of a number in this many planes."""
    bits = row.bits(world, *HERE)
    return bits + [bits[-1] if row.signed else 0] * (count - len(bits))


def _narrower(a: Layout, b: Layout) -> Layout:
    """The values that both rows contain."""
    lo, hi = max(a.lo, b.lo), min(a.hi, b.hi)
    if lo > hi:
        raise Undecided("ranges that share no number")
    fewer = a if len(a.planes) <= len(b.planes) else b
    if lo >= 0 and fewer.signed and not (a.signed and b.signed):
        fewer = a if not a.signed else b
    return replace(fewer, lo=lo, hi=hi)
